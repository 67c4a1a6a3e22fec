"""Dataset -> decoded bank of normalised meshes -> batches of triples, a function of (seed, epoch, index).

A training triple is (source, target, truth): truth = (target's identity, source's pose); source and target differ in
identity and in pose (DSFFNet, section 4.1). One epoch shows every cell of the training grid once as truth.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.errors import DatasetError
from datagen.mesh import bounding_box, edges_of
from datagen.random import Stream, generator
from datagen.store import Dataset


@dataclass(frozen=True)
class Batch:
    """Normalised vertices [batch, vertex, 3] of the three meshes of each triple."""

    source: Tensor
    target: Tensor
    truth: Tensor

    def to(self, device: torch.device) -> "Batch":
        """The same on another device."""
        return Batch(self.source.to(device), self.target.to(device), self.truth.to(device))


def read_batch(dataset: Dataset, triples: NDArray[np.integer]) -> Batch:
    """The normalised meshes of rows (source identity, source pose, target identity, target pose), and only those.

    For a few triples of a large dataset; :class:`VertexBank` is for many.
    """
    source_identity, source_pose, target_identity, target_pose = triples.T
    return Batch(
        source=_read(dataset, source_identity, source_pose),
        target=_read(dataset, target_identity, target_pose),
        truth=_read(dataset, target_identity, source_pose),
    )


def _read(dataset: Dataset, identities: NDArray[np.integer], poses: NDArray[np.integer]) -> Tensor:
    meshes = [dataset.vertices(int(identity), int(pose)) for identity, pose in zip(identities, poses, strict=True)]
    if len({len(mesh) for mesh in meshes}) > 1:
        raise DatasetError(f"{dataset.url} mixes vertex counts, which one batch cannot hold")
    return torch.from_numpy(np.stack([bounding_box(mesh).normalise(mesh) for mesh in meshes]).astype(np.float32))


class VertexBank:
    """Every mesh of some identities, each normalised to its own bounding box, decoded once and kept on one device.

    Meshes are float32 [vertex, 3] in [-1, 1]. All identities must share one topology.
    """

    def __init__(self, dataset: Dataset, identities: Sequence[int], *, device: torch.device | str = "cpu") -> None:
        faces = {dataset.faces(identity).tobytes() for identity in identities}
        if len(faces) > 1:
            raise DatasetError(
                f"{dataset.url} mixes {len(faces)} topologies; batches need one. Train on identities of one topology"
            )
        self.faces = dataset.faces(identities[0])
        self.edges = torch.from_numpy(edges_of(self.faces)).to(device)
        self._places: dict[int, NDArray[np.int64]] = {}
        meshes, rows = [], 0
        for identity in identities:
            vertices = dataset.vertices(identity)
            self._places[identity] = np.full(dataset.grid.pose_count, -1)
            self._places[identity][dataset.grid.poses_of(identity)] = np.arange(rows, rows + len(vertices))
            rows += len(vertices)
            meshes.append(torch.from_numpy(bounding_box(vertices).normalise(vertices).astype(np.float32)))
        self._meshes = torch.cat(meshes).to(device)

    def __len__(self) -> int:
        return len(self._meshes)

    def gather(self, identities: NDArray[np.integer], poses: NDArray[np.integer]) -> Tensor:
        """Normalised vertices [batch, vertex, 3] of the cells (identity, pose)."""
        cells = zip(identities, poses, strict=True)
        rows = np.array([self._places[int(identity)][pose] for identity, pose in cells])
        return self._meshes[torch.from_numpy(rows).to(self._meshes.device)]

    def batch(self, triples: NDArray[np.integer]) -> Batch:
        """The meshes of rows (source identity, source pose, target identity, target pose)."""
        source_identity, source_pose, target_identity, target_pose = triples.T
        return Batch(
            source=self.gather(source_identity, source_pose),
            target=self.gather(target_identity, target_pose),
            truth=self.gather(target_identity, source_pose),
        )


def epoch_triples(*, identities: int, poses: int, seed: int, epoch: int) -> NDArray[np.int64]:
    """All triples of an epoch in their order: rows (source identity, source pose, target identity, target pose).

    A pure function of its arguments; identities are numbered within the training split. Row order is a random
    permutation of the grid's cells, each cell (target identity, source pose) being the truth once.
    """
    random = generator(seed, Stream.TRAINING_TRIPLES, epoch)
    target, source_pose = np.divmod(random.permutation(identities * poses), poses)
    source = (target + random.integers(1, identities, len(target))) % identities
    target_pose = (source_pose + random.integers(1, poses, len(target))) % poses
    return np.stack([source, source_pose, target, target_pose], axis=1)


@dataclass(frozen=True)
class TripleOrder:
    """The order of training triples of some identities and poses over a whole run, the same for any number of ranks."""

    identities: Sequence[int]
    poses: Sequence[int] | NDArray[np.integer]
    batch: int
    seed: int

    def __post_init__(self) -> None:
        if len(self.identities) < 2 or len(self.poses) < 2:
            raise DatasetError(
                f"a training triple needs two identities and two poses, but the training split has "
                f"{len(self.identities)} identities in {len(self.poses)} poses. Make a larger one: "
                "--set data.identities.training=... data.poses.seen=..."
            )
        if self.steps_per_epoch == 0:
            raise DatasetError(f"the training grid has {self.cells} cells, fewer than a batch of {self.batch}")

    @property
    def cells(self) -> int:
        return len(self.identities) * len(self.poses)

    @property
    def steps_per_epoch(self) -> int:
        return self.cells // self.batch

    def batches(self, *, first_step: int, rank: int = 0, ranks: int = 1) -> Iterator[NDArray[np.int64]]:
        """This rank's share of every batch from ``first_step`` on, without end."""
        numbers, poses = np.asarray(self.identities), np.asarray(self.poses)
        share = self.batch // ranks
        step = first_step
        while True:
            epoch = step // self.steps_per_epoch
            triples = epoch_triples(identities=len(numbers), poses=len(poses), seed=self.seed, epoch=epoch)
            triples[:, [0, 2]] = numbers[triples[:, [0, 2]]]
            triples[:, [1, 3]] = poses[triples[:, [1, 3]]]
            for place in range(step % self.steps_per_epoch, self.steps_per_epoch):
                start = place * self.batch + rank * share
                yield triples[start : start + share]
                step += 1
