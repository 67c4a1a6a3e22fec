"""What a dataset's rigs say of a batch: which part each vertex belongs to, and how the parts are turned.

Parts are joined as the network has them: bones that one pose joint turns are one part, as the fingers of a hand are.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.errors import RecipeError
from datagen.mesh.geometry import edges_of
from datagen.mesh.rig import Rig, skinned
from datagen.store import Dataset
from training.data.batch import Batch
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.data.row_random import Purpose, RowRandom
from training.data.surface_points import SurfacePoints, Triangles, points_of
from training.data.triples import Triples
from training.networks.execution import sent
from training.networks.layers import rigid_parts
from training.networks.layers.rigid_parts import ancestors, moved_joints
from training.networks.layers.surface import Surface, joined, surface_of
from training.objectives.parts import Posed

_OF_SOURCES = Purpose.AS_SOURCE_POINTS, Purpose.SOURCE_POINTS
_OF_TARGETS = Purpose.AS_TARGET_POINTS, Purpose.TARGET_POINTS

_DENSE = 1024
"""Vertices of a mesh of which a subset is drawn by area, where there are more; as many as were sampled when the weights
that come along were trained."""
_SURFACES = 64
"""In so many poses surfaces are found, of all kinds of bodies together; of more kinds in one pose each."""


class RigTable:
    """The rigs of some identities and the rotations of all poses, on a device.

    Parameters
    ----------
    joints
        Joints that turn the network's parts, each with its parent's name (:class:`training.networks.parts.Parts`).

    Raises
    ------
    RecipeError
        The dataset's poses do not turn one of the joints.
    DatasetError
        The dataset is damaged.
    """

    def __init__(self, bodies: BodiesAtRest, joints: Mapping[str, str | None], *, device: torch.device | str) -> None:
        dataset, self._names = bodies.dataset, tuple(joints)
        parents = [-1 if parent is None else self._names.index(parent) for parent in joints.values()]
        self._parents = torch.tensor([part if own < 0 else own for part, own in enumerate(parents)], device=device)
        self._above = ancestors(parents).to(device)
        self._poses: tuple[str, ...] = tuple(dataset.attributes["joints"])
        unknown = sorted(set(self._names) - set(self._poses))
        if unknown:
            raise RecipeError(
                f"training.network.joints names {unknown[0]!r}, which no pose of {dataset.url} turns; its joints are "
                f"{', '.join(self._poses)}. Name those that the bodies have: --set training.network.joints=..."
            )
        self._world = torch.from_numpy(bodies.world.astype(np.float32)).to(device)
        self._chosen = torch.tensor([self._poses.index(name) for name in self._names], device=device)
        self._device, self._row = torch.device(device), dict[int, int]()
        weights, rest, at = list[Tensor](), list[Tensor](), list[NDArray[np.float32]]()
        first_of, triangles = list[int](), list[Triangles]()
        kinds, known = list[int](), dict[bytes, int]()
        for identity, rig, vertices in zip(bodies.identities, bodies.rigs, bodies.vertices, strict=True):
            its_weights, its_rest, its_joints = self._in_the_poses_rest(rig, vertices)
            kind = known.setdefault(its_weights.tobytes(), len(known))
            if kind == len(weights):
                weights.append(torch.from_numpy(its_weights).to(device))
                first_of.append(identity)
                triangles.append(Triangles(its_rest, dataset.faces(identity), device=self._device))
            kinds.append(kind)
            rest.append(torch.from_numpy(its_rest).to(device))
            at.append(its_joints)
            self._row[identity] = len(rest) - 1
        self._kinds, self._triangles = kinds, triangles
        self._weights, self._rest = torch.cat(weights), torch.cat(rest)
        self._areas = torch.cat([its.areas for its in triangles])
        self._of_weights = np.cumsum([0, *map(len, weights[:-1])])[kinds]
        self._of_rest = np.cumsum([0, *map(len, rest[:-1])])
        self._counts = np.array([len(its) for its in rest])
        fewest = min(len(dataset.grid.poses_of(identity)) for identity in first_of)
        self._poses_seen = max(1, min(_SURFACES // len(first_of), fewest))
        surfaces = [surface for identity in first_of for surface in _surfaces(dataset, identity, self._poses_seen)]
        self._surfaces = joined(surfaces).to(device)
        self._present = torch.stack([(weights[kind] > 0).any(dim=0).float() for kind in kinds])
        self._joints = torch.from_numpy(np.stack(at)).to(device)

    def posed(self, triples: Triples, batch: Batch) -> Batch:
        """The batch of rows (source identity, source pose, target identity, target pose), with what the rigs say."""
        of_source, of_target = batch.points or (None, None)
        poses = sent(torch.from_numpy(triples[:, [1, 3]].astype(np.int64)), self._device)
        of_sources, of_targets = batch.turns or self._world[poses].unbind(1)
        sources = self._of(triples[:, 0], of_sources, batch.source, batch.source_rows, of_source)
        targets = self._of(triples[:, 2], of_targets, batch.target, batch.target_rows, of_target)
        surfaces = (
            self._surface(triples[:, :2], batch.source, batch.source_rows, of_source),
            self._surface(triples[:, 2:], batch.target, batch.target_rows, of_target),
        )
        return replace(batch, posed=(sources, targets), surfaces=surfaces)

    def areas(self, triples: Triples, batch: Batch) -> tuple[Tensor | None, Tensor | None]:
        """How likely vertices of the sources [b, n] and of the targets are to be drawn, in any unit.

        By the share of the area at rest around each, of the first identity with the same weights: of dense meshes a
        network's sample leaves out most in faces and hands, too. All alike in meshes of no more than 1,024
        vertices, and of points, which lie evenly. None: so are all meshes.
        """
        source, target = batch.points or (None, None)
        return (
            self._areas_of(triples[:, 0], batch.source, batch.source_rows, source),
            self._areas_of(triples[:, 2], batch.target, batch.target_rows, target),
        )

    def _areas_of(
        self, identities: NDArray[np.integer], vertices: Tensor, rows: Tensor | None, points: SurfacePoints | None
    ) -> Tensor | None:
        own = self._rows(identities)
        dense = (self._counts[own] > _DENSE) & ~np.array(points.drawn if points else [False] * len(own))
        if not dense.any():
            return None
        about = np.stack([self._of_weights[own], self._counts[own] - 1, dense])
        first, last, by_area = sent(torch.from_numpy(about), self._device)[..., None].unbind(0)
        rows = torch.arange(vertices.shape[1], device=self._device).minimum(last) if rows is None else rows
        areas = self._areas.index_select(0, (rows + first).flatten()).view(rows.shape)
        return torch.where(by_area > 0, areas, 1.0)

    def _rows(self, identities: NDArray[np.integer]) -> NDArray[np.int64]:
        return np.array([self._row[int(identity)] for identity in identities])

    def of_points(self, triples: Triples, batch: Batch, chance: float, random: RowRandom) -> Batch:
        """The batch, each source and each target (with its truth) with this chance as points of its surface."""
        drawn = [
            points_of(
                [self._triangles[self._kinds[row]] for row in self._rows(identities)],
                counts or (meshes.shape[1],) * len(meshes),
                meshes.shape[1],
                chance,
                random,
                purposes,
            )
            for identities, meshes, counts, purposes in (
                (triples[:, 0], batch.source, batch.source_counts, _OF_SOURCES),
                (triples[:, 2], batch.target, batch.target_counts, _OF_TARGETS),
            )
        ]
        source, target = drawn
        return replace(
            batch,
            source=source.of(batch.source),
            target=target.of(batch.target),
            truth=target.of(batch.truth),
            points=(source, target),
        )

    def _surface(
        self,
        meshes: NDArray[np.integer],
        vertices: Tensor,
        rows: Tensor | None,
        points: SurfacePoints | None,
    ) -> Surface:
        """The surfaces of meshes (identity, pose), as in one of the poses: a pose hardly changes what is near."""
        kinds = np.array([self._kinds[row] for row in self._rows(meshes[:, 0])])
        numbers = sent(torch.from_numpy(kinds * self._poses_seen + meshes[:, 1] % self._poses_seen), self._device)
        cells, near = (each.index_select(0, numbers) for each in self._surfaces)
        if points is not None:
            cells = cells.gather(1, points.corners[..., 0])
        return Surface(cells[:, : vertices.shape[1]], near) if rows is None else Surface(cells, near).at(rows)

    def _of(
        self,
        identities: NDArray[np.integer],
        world: Tensor,
        vertices: Tensor,
        rows: Tensor | None,
        points: SurfacePoints | None,
    ) -> Posed:
        """How meshes of these identities are posed.

        Parameters
        ----------
        world
            World rotations [b, joint, 3, 3] of the pose joints.
        vertices
            [b, n, 3] in each mesh' box: those that the step takes.
        rows
            [b, n], their numbers in the mesh, or among its points; None: all.
        points
            Of the meshes, where they are made of some in the place of vertices.
        """
        own = self._rows(identities)
        about = np.stack([own, self._of_weights[own], self._of_rest[own], self._counts[own] - 1])
        numbers, of_weights, of_rest, last = sent(torch.from_numpy(about), self._device).unbind(0)
        if rows is None:
            rows = torch.arange(vertices.shape[1], device=self._device).minimum(last[:, None])
        if points is not None:
            points = points.at(rows) if any(points.drawn) else None
        used = rows if points is None else points.corners.flatten(1)
        turns = world.index_select(1, self._chosen)
        joints, present = self._joints.index_select(0, numbers), self._present.index_select(0, numbers)
        moved = moved_joints(joints, turns, self._parents, self._above)
        weights, rest = (
            table.index_select(0, (used + first[:, None]).flatten()).view(*used.shape, -1)
            for table, first in ((self._weights, of_weights), (self._rest, of_rest))
        )
        posed = rigid_parts.skinned(rest, weights, turns, joints, moved)
        if points is not None:
            weights, rest, posed = (points.mixed(each) for each in (weights, rest, posed))
        return Posed(weights, rest, joints, *_carried(posed, vertices, turns, moved), present)

    def _in_the_poses_rest(
        self, rig: Rig, rest: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Weights [vertex, part] and, in the poses' rest pose and box units, vertices and joints of a body at rest."""
        still = rig.transforms(np.broadcast_to(np.eye(3), (1, len(self._poses), 3, 3)))
        vertices = skinned(rest, rig.weights, still)[0]
        joints = (still[0, :, :, :3] @ rig.joints[..., None])[..., 0] + still[0, :, :, 3]
        owner = self._owners(rig)
        weights = np.zeros((len(rig.weights), len(self._names)), np.float32)
        np.add.at(weights.T, owner, rig.weights.T)
        at = np.stack([self._place(part, joints, rig) for part in range(len(self._names))])
        half = (vertices.max(axis=0) - vertices.min(axis=0)).max() / 2
        root = at[0]
        return weights, ((vertices - root) / half).astype(np.float32), ((at - root) / half).astype(np.float32)

    def _owners(self, rig: Rig) -> NDArray[np.int64]:
        """The network's part [part] that each part of a rig belongs to: its joint's, or that of the part above it."""
        known = {self._poses.index(name): part for part, name in enumerate(self._names)}
        owners = list[int]()
        for driver, parent in zip(rig.drivers, rig.parents, strict=True):
            owners.append(known.get(driver, owners[parent] if parent >= 0 else 0))
        return np.array(owners)

    def _place(self, part: int, joints: NDArray[np.float64], rig: Rig) -> NDArray[np.float64]:
        """Where the joint [3] of a part rests; of one that the body lacks, where that above it does."""
        drivers = np.array([self._poses[driver] if driver >= 0 else "" for driver in rig.drivers])
        while part != int(self._parents[part]) and not (drivers == self._names[part]).any():
            part = int(self._parents[part])
        own = joints[drivers == self._names[part]]
        return (own if len(own) else joints[:1]).mean(axis=0)


def _surfaces(dataset: Dataset, identity: int, count: int) -> Iterator[Surface]:
    """The surfaces of an identity in so many of its poses.

    Which vertices share a cell differs from pose to pose: told those of one pose alone, a network learns the cells by
    heart, and reads bodies less well that are told their own (docs/results/parts-experiments.md).
    """
    poses, edges = dataset.grid.poses_of(identity), edges_of(dataset.faces(identity))
    for vertices in dataset.vertices(identity, [poses[place * len(poses) // count] for place in range(count)]):
        yield surface_of(vertices, edges)


def _carried(posed: Tensor, vertices: Tensor, turns: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations and joints in the axes and the box of vertices [b, n, 3], which are those posed [b, n, 3] elsewhere.

    The two differ by a turn, a scale and a shift, which are found from the vertices themselves.
    """
    middle, there = posed.mean(dim=1, keepdim=True), vertices.mean(dim=1, keepdim=True)
    one, other = posed - middle, vertices - there
    turn = rigid_parts.nearest_rotations(other.mT @ one)
    scale = ((one @ turn.mT) * other).sum((1, 2)) / one.square().sum((1, 2)).clamp_min(1e-12)
    moved = (joints - middle) @ turn.mT * scale[:, None, None] + there
    return turn[:, None] @ turns, moved
