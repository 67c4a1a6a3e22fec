"""Bodies in poses that no mesh of a dataset is in: each joint is turned as in another pose, and rigs pose the mesh."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.mesh.rig import NO_JOINT, Rig
from training.data.batch import Batch
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.data.row_random import Purpose, RowRandom
from training.data.triples import Triples
from training.networks.execution import sent
from training.networks.layers.rigid_parts import ancestors, skinned
from training.networks.parts import boxed

_AT_ONCE = 2**25
"""Skinning weights that are gathered at a time."""


class PosedBodies:
    """Bodies by their rigs, and how the joints turn in a dataset's poses, on a device.

    Rigs may have different parts; those of fewer are padded with parts that move no vertex.
    """

    def __init__(self, bodies: BodiesAtRest, *, device: torch.device | str) -> None:
        dataset, rigs = bodies.dataset, bodies.rigs
        self._device, seen = torch.device(device), dataset.grid.poses("seen")
        self._tree: list[int] = list(dataset.attributes["joint_parents"])
        self._world, self._local = self._floats(bodies.world), self._floats(_relative(bodies.world[seen], self._tree))
        groups = _turning_alike(dataset.rotations()[seen])
        self._groups, self._group = int(groups.max()) + 1, torch.from_numpy(groups).to(self._device)
        self._row = {identity: row for row, identity in enumerate(bodies.identities)}
        self._counts = np.array([len(its) for its in bodies.vertices])
        self._rest, self._of_rest = self._floats(np.concatenate(bodies.vertices)), np.cumsum([0, *self._counts[:-1]])
        parts = max(len(rig.names) for rig in rigs)
        self._joints = self._floats(np.stack([_padded(rig.joints, parts) for rig in rigs]))
        kinds, self._kinds = _kinds_of(rigs)
        self._weights = self._floats(np.concatenate([_wider(rig.weights, parts) for rig in kinds]))
        self._of_weights = np.cumsum([0, *(len(rig.weights) for rig in kinds[:-1])])[self._kinds]
        self._corrections = self._floats(np.stack([_padded(rig.corrections, parts) for rig in kinds]))
        self._drivers = self._numbers([[*rig.drivers, *[NO_JOINT] * (parts - len(rig.drivers))] for rig in kinds])
        trees = [[*rig.parents, *[NO_JOINT] * (parts - len(rig.parents))] for rig in kinds]
        self._above = torch.stack([ancestors(tree) for tree in trees]).to(self._device)
        self._parents = self._numbers([[part if own < 0 else own for part, own in enumerate(tree)] for tree in trees])

    def recombined(self, triples: Triples, batch: Batch, share: float, random: RowRandom) -> Batch:
        """The batch, this share of its triples, by chance, in poses that are put together anew.

        Each joint is turned, relative to its parent, as in a seen pose of its own; joints that turn alike in all poses
        are turned as in one. The three meshes are what the dataset's would be: bodies by linear blend skinning, in
        boxes of their own. ``turns`` of the batch says how all of its sources and targets are posed, where some are in
        other poses than before.

        Parameters
        ----------
        triples
            Those of the batch.
        """
        chosen = np.flatnonzero(random.on_host().uniform(Purpose.RECOMBINED).numpy() < share)
        if not len(chosen):
            return batch
        rows = sent(torch.from_numpy(chosen), self._device)
        poses = sent(torch.from_numpy(triples[:, [1, 3]].astype(np.int64)), self._device)
        drawn = random.below(Purpose.JOINT_POSES, len(self._local), 2, self._groups)
        anew = self._composed(drawn.index_select(0, rows)[:, :, self._group])
        of_source, of_target = anew.unbind(1)
        turns = self._world[poses].index_copy(0, rows, anew)

        def posed(meshes: Tensor, identities: NDArray[np.integer], its: Tensor) -> Tensor:
            at_once = max(1, _AT_ONCE // (meshes.shape[1] * self._joints.shape[1]))
            found = [
                self._meshes(identities[chosen[start : start + at_once]], some, rows=meshes.shape[1])
                for start, some in zip(range(0, len(chosen), at_once), torch.split(its, at_once), strict=True)
            ]
            return meshes.index_copy(0, rows, torch.cat(found).to(meshes.dtype))

        return replace(
            batch,
            source=posed(batch.source, triples[:, 0], of_source),
            target=posed(batch.target, triples[:, 2], of_target),
            truth=posed(batch.truth, triples[:, 2], of_source),
            turns=(turns[:, 0], turns[:, 1]),
        )

    def _composed(self, numbers: Tensor) -> Tensor:
        """World rotations [b, 2, joint, 3, 3] of joints turned as in the seen poses of these numbers [b, 2, joint]."""
        local = self._local[numbers, torch.arange(numbers.shape[2], device=numbers.device)]
        world = list[Tensor]()
        for joint, parent in enumerate(self._tree):
            own = local[:, :, joint]
            world.append(world[parent] @ own if parent >= 0 else own)
        return torch.stack(world, dim=2)

    def _meshes(self, identities: NDArray[np.integer], world: Tensor, *, rows: int) -> Tensor:
        """Vertices [k, rows, 3], boxed and padded, of bodies whose joints are turned so [k, joint, 3, 3]."""
        own = np.array([self._row[int(identity)] for identity in identities], np.int64)
        about = np.stack([own, self._kinds[own], self._of_rest[own], self._of_weights[own], self._counts[own]])
        numbers, kind, of_rest, of_weights, count = sent(torch.from_numpy(about), self._device).unbind(0)
        places = torch.arange(rows, device=self._device).expand(len(own), -1)
        inside = places < count[:, None]
        used = places.minimum(count[:, None] - 1)
        rest, weights = (
            table.index_select(0, (first[:, None] + used).flatten()).view(*used.shape, table.shape[1])
            for table, first in ((self._rest, of_rest), (self._weights, of_weights))
        )
        meshes, parents = torch.arange(len(own), device=self._device)[:, None], self._parents[kind]
        still = torch.eye(3, device=self._device).expand(len(own), 1, 3, 3)
        turns = torch.cat([world, still], dim=1)[meshes, self._drivers[kind]] @ self._corrections[kind]
        joints = self._joints.index_select(0, numbers)
        bones = (turns[meshes, parents] @ (joints - joints[meshes, parents])[..., None])[..., 0]
        is_root = parents == torch.arange(parents.shape[1], device=self._device)
        moved = self._above[kind] @ torch.where(is_root[..., None], joints, bones)
        return boxed(skinned(rest, weights, turns, joints, moved)) * inside[..., None]

    def _floats(self, values: NDArray[np.floating]) -> Tensor:
        return torch.from_numpy(values.astype(np.float32)).to(self._device)

    def _numbers(self, values: list[list[int]]) -> Tensor:
        return torch.tensor(values, device=self._device)


def _kinds_of(rigs: Sequence[Rig]) -> tuple[list[Rig], NDArray[np.int64]]:
    """One rig of each kind, whose bodies differ in shape alone, and the number of the kind of each."""
    kinds, known, numbers = list[Rig](), dict[tuple[object, ...], int](), list[int]()
    for rig in rigs:
        alike = rig.weights.tobytes(), rig.corrections.tobytes(), rig.drivers, rig.parents
        numbers.append(known.setdefault(alike, len(known)))
        if len(known) > len(kinds):
            kinds.append(rig)
    return kinds, np.array(numbers)


def _relative(world: NDArray[np.float64], parents: Sequence[int]) -> NDArray[np.float64]:
    """Rotations [pose, joint, 3, 3] of a tree's joints relative to their parents', from those in world axes."""
    above = [parent if parent >= 0 else NO_JOINT for parent in parents]
    still = np.broadcast_to(np.eye(3), (len(world), 1, 3, 3))
    return np.concatenate([world, still], axis=1)[:, above].swapaxes(2, 3) @ world


def _turning_alike(rotations: NDArray[np.float64]) -> NDArray[np.int64]:
    """Numbers [joint] of groups of joints, each of those that turn alike in all poses [pose, joint, 3]."""
    of_joints = rotations.swapaxes(0, 1).reshape(rotations.shape[1], -1)
    return np.unique(of_joints, axis=0, return_inverse=True)[1].reshape(-1)


def _wider(weights: NDArray[np.floating], parts: int) -> NDArray[np.floating]:
    """Weights [vertex, n] with columns of zeros after them [vertex, parts]."""
    return np.pad(weights, ((0, 0), (0, parts - weights.shape[1])))


def _padded(values: NDArray[np.floating], count: int) -> NDArray[np.floating]:
    """Values [n, ...] with zeros after them [count, ...]."""
    return np.concatenate([values, np.zeros((count - len(values), *values.shape[1:]), values.dtype)])
