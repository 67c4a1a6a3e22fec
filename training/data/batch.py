"""One batch of triples as the networks and losses take it, of one vertex count or of many."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.errors import DatasetError
from datagen.mesh.geometry import edges_of
from datagen.store import Dataset
from training.data.surface_points import SurfacePoints
from training.data.triples import Triples
from training.data.vertex_layout import normalised, read_each
from training.networks.layers.surface import Surface, joined, surface_of
from training.objectives.losses import INCIDENCES, PackedEdges, incidence_of, join_incidences, loss_edges
from training.objectives.parts import Posed

Counts = tuple[int, ...]
EdgeSum = Literal["edges", "faces"]


@dataclass(frozen=True)
class Batch:
    """The three meshes of each triple, float32 in the normalised box of each mesh, and the edges of the targets.

    Attributes
    ----------
    source, target, truth
        ``[b, n, 3]``; n_source may differ from n_target. Rows after a mesh's count are zero.
    edges
        ``[e, 2]`` int64 indices of vertices where all targets have one topology; else `PackedEdges`.
    source_counts, target_counts
        Vertices of each mesh, for :class:`training.networks.padded_batches.MixedCounts`; None: all n. The truth has the
        target's.
    source_rows, target_rows
        ``[b, n]``, numbers of the vertices that were taken of each mesh, or of its points; None: all.
    posed
        Of a network that learns from rigs: how the sources are posed, and the targets.
    surfaces
        What is near along the surfaces of the sources, and of the targets, for a network that asks; None: not known.
    points
        Of which points of their surfaces the sources and the targets are made, in the place of vertices; None: of none.
    turns
        World rotations [b, joint, 3, 3] of the pose joints of the sources, and of the targets, where some are in other
        poses than their triples name; None: none are.
    """

    source: Tensor
    target: Tensor
    truth: Tensor
    edges: Tensor | PackedEdges
    source_counts: Counts | None = None
    target_counts: Counts | None = None
    source_rows: Tensor | None = None
    target_rows: Tensor | None = None
    posed: tuple[Posed, Posed] | None = None
    surfaces: tuple[Surface, Surface] | None = None
    points: tuple[SurfacePoints, SurfacePoints] | None = None
    turns: tuple[Tensor, Tensor] | None = None

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> "Batch":
        """The same on another device."""
        meshes = (self.source, self.target, self.truth)
        source, target, truth = (mesh.to(device, non_blocking=non_blocking) for mesh in meshes)
        edges = self.edges.to(device, non_blocking=non_blocking)
        of_source, of_target = (
            rows if rows is None else rows.to(device) for rows in (self.source_rows, self.target_rows)
        )
        posed = self.posed and (self.posed[0].to(device), self.posed[1].to(device))
        surfaces = self.surfaces and (self.surfaces[0].to(device), self.surfaces[1].to(device))
        points = self.points and (self.points[0].to(device), self.points[1].to(device))
        turns = self.turns and (self.turns[0].to(device), self.turns[1].to(device))
        counts = self.source_counts, self.target_counts
        return Batch(source, target, truth, edges, *counts, of_source, of_target, posed, surfaces, points, turns)

    def __len__(self) -> int:
        return len(self.source)

    def in_dtype(self, dtype: torch.dtype) -> "Batch":
        """The same with vertices in another floating type."""
        meshes = {name: getattr(self, name).to(dtype) for name in ("source", "target", "truth")}
        posed = self.posed and (self.posed[0].in_dtype(dtype), self.posed[1].in_dtype(dtype))
        return replace(self, **meshes, posed=posed)

    def part(self, start: int, stop: int) -> "Batch":
        """Its triples from ``start`` to ``stop``, for a network to be run on: without what a step learns from."""
        edges = self.edges
        if isinstance(edges, PackedEdges):
            edges = edges.part(start, stop, rows=self.target.shape[1])
        at = slice(start, stop)
        source_counts, target_counts = (counts and counts[at] for counts in (self.source_counts, self.target_counts))
        surfaces = self.surfaces and (self.surfaces[0].of(at), self.surfaces[1].of(at))
        meshes = self.source[at], self.target[at], self.truth[at]
        return Batch(*meshes, edges, source_counts, target_counts, surfaces=surfaces)


class EdgeTable:
    """Edges of some identities, each topology's once, on a device.

    Parameters
    ----------
    of
        See :func:`training.objectives.losses.loss_edges`.
    """

    def __init__(
        self, dataset: Dataset, identities: Sequence[int], *, device: torch.device | str, of: EdgeSum = "edges"
    ) -> None:
        self._topology: dict[int, int] = {}
        self._edges: list[Tensor] = []
        self._counts: list[int] = []
        known: dict[bytes, int] = {}
        for identity in identities:
            faces = dataset.faces(identity)
            number = known.setdefault(faces.tobytes(), len(known))
            if number == len(self._edges):
                self._edges.append(torch.from_numpy(loss_edges(faces, of)).to(device))
                self._counts.append(dataset.vertex_count(identity))
            self._topology[int(identity)] = number

    def of(self, identities: NDArray[np.integer], *, rows: int) -> Tensor | PackedEdges:
        """Edges of a batch of targets, padded to ``rows`` vertices each."""
        numbers = [self._topology[int(identity)] for identity in identities]
        if len(set(numbers)) == 1:
            return self._edges[numbers[0]]
        return _packed([self._edges[number] for number in numbers], [self._counts[number] for number in numbers], rows)


def _packed(edges: Sequence[Tensor], counts: Sequence[int], rows: int) -> PackedEdges:
    """Edges [e, 2] of meshes of so many vertices, each padded to ``rows``; nothing waits for a GPU.

    How they touch is put together from what is known of each topology: sorting a batch's edges anew would take longer.
    """
    pairs = torch.cat([own + rows * mesh for mesh, own in enumerate(edges)])
    meshes = torch.cat([torch.full_like(own[:, 0], mesh) for mesh, own in enumerate(edges)])
    parts = [incidence_of(own, count) for own, count in zip(edges, counts, strict=True)]
    INCIDENCES[pairs] = join_incidences(pairs, parts, rows)
    return PackedEdges(pairs, meshes)


def counts_of(counts: NDArray[np.integer]) -> Counts | None:
    """Counts of a batch's meshes, None where they are equal."""
    return None if (counts == counts[0]).all() else tuple(int(count) for count in counts)


def read_batch(dataset: Dataset, triples: Triples, *, padded: bool = False, surfaces: bool = False) -> Batch:
    """The normalised meshes of rows (source identity, source pose, target identity, target pose), and only those.

    For a few triples of a large dataset; :func:`training.data.vertex_bank.open_bank` is for many.

    Parameters
    ----------
    padded
        Pad meshes of different counts; the caller then minds ``source_counts`` and ``target_counts``.
    surfaces
        Find what is near along them, for a network that takes it (`training.networks.NETWORKS`): milliseconds a mesh.

    Raises
    ------
    DatasetError
        A shard is missing or damaged, or vertex counts differ and were not to be padded.
    """
    source_identity, source_pose, target_identity, target_pose = triples.T
    source, source_counts = _read(dataset, source_identity, source_pose, padded=padded)
    target, target_counts = _read(dataset, target_identity, target_pose, padded=padded)
    truth, _ = _read(dataset, target_identity, source_pose, padded=padded)
    table = EdgeTable(dataset, np.unique(target_identity).tolist(), device="cpu")
    edges = table.of(target_identity, rows=target.shape[1])
    batch = Batch(source, target, truth, edges, source_counts, target_counts)
    if not surfaces:
        return batch
    found = _surfaces(dataset, source_identity, source), _surfaces(dataset, target_identity, target)
    return replace(batch, surfaces=found)


def _surfaces(dataset: Dataset, identities: NDArray[np.integer], meshes: Tensor) -> Surface:
    edges = {int(identity): edges_of(dataset.faces(int(identity))) for identity in np.unique(identities)}
    pairs = zip(identities.tolist(), meshes, strict=True)
    return joined([surface_of(mesh[: dataset.vertex_count(own)].numpy(), edges[own]) for own, mesh in pairs])


def _read(
    dataset: Dataset, identities: NDArray[np.integer], poses: NDArray[np.integer], *, padded: bool
) -> tuple[Tensor, Counts | None]:
    counts = np.array([dataset.vertex_count(int(identity)) for identity in identities])
    if counts_of(counts) and not padded:
        raise DatasetError(
            f"{dataset.url} mixes vertex counts ({counts.min()} to {counts.max()}), which this step cannot take. "
            "Use a dataset of one body"
        )
    meshes = np.zeros((len(counts), counts.max(), 3), np.float32)
    read = read_each(dataset, identities.tolist(), poses.tolist())
    for mesh, vertices in zip(meshes, read, strict=True):
        mesh[: len(vertices)] = normalised(vertices[None])[0]
    return torch.from_numpy(meshes), counts_of(counts)
