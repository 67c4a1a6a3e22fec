"""Identities x poses -> splits -> arrays of vertices -> shards -> evaluation triples. Pure; no input or output.

The grid of the DSFFNet paper (section 4.1): training identities are made in the seen poses only, evaluation
identities in the seen and the unseen ones. The identities of a split that share a topology are one array of vertices
[identity, pose, vertex, 3]; a shard is a block of some identities in some poses of it.

A grid grows in steps: what a step appends is numbered after everything before it, and its identities and poses begin at
new shards, so that no shard that exists is ever written again. Places up to the next shard are holes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.common.seeding import Stream, generator
from datagen.recipe import DatasetRecipe, Growth

PoseType = Literal["seen", "unseen"]
Split = Literal["training", "evaluation"]
POSE_TYPES: tuple[PoseType, ...] = ("seen", "unseen")
SPLITS: tuple[Split, ...] = ("training", "evaluation")
HOLE = -1
"""The number at a place along the identities or poses of an array that holds no mesh."""
MOST_MESHES, LARGEST_SHARD = 4096, 2**26
"""Bytes of the vertices of a shard, unless a single mesh has more."""
Place = tuple[int, int, int, int]
"""Of a shard: number of its split, topology, place along the identities and along the poses, counted in shards."""


def shard_path(place: Place) -> str:
    """Path of a shard's object within a dataset."""
    split, topology, row, column = place
    return f"grid/{SPLITS[split]}/{topology}/vertices/c/{row}/{column}/0/0"


@dataclass(frozen=True)
class Shard:
    """A block of an array of vertices: each of ``identities`` in each of ``poses``, both by number.

    Attributes
    ----------
    vertices
        Of each mesh.
    room
        How many identities and poses a full shard of the array has.
    """

    place: Place
    identities: tuple[int, ...]
    poses: range
    vertices: int
    room: tuple[int, int]

    @property
    def path(self) -> str:
        """Path of its object within a dataset."""
        return shard_path(self.place)

    @property
    def rows(self) -> int:
        """How many meshes it holds."""
        return len(self.identities) * len(self.poses)


@dataclass(frozen=True)
class Grid:
    """The identity x pose grid that a recipe describes."""

    recipe: DatasetRecipe

    @cached_property
    def steps(self) -> list[Growth]:
        """What each step adds; the first is the recipe's own grid."""
        recipe = self.recipe
        base = Growth(
            training=recipe.identities.training,
            evaluation=recipe.identities.evaluation,
            seen=recipe.poses.seen,
            unseen=recipe.poses.unseen,
        )
        return [base, *recipe.growth]

    @cached_property
    def _splits(self) -> NDArray[np.intp]:
        """The number of the split [identity] of each."""
        return _repeated([count for step in self.steps for count in (step.training, step.evaluation)])

    @cached_property
    def _pose_types(self) -> NDArray[np.intp]:
        """The number of the type [pose] of each."""
        return _repeated([count for step in self.steps for count in (step.seen, step.unseen)])

    @property
    def identity_count(self) -> int:
        return sum(step.training + step.evaluation for step in self.steps)

    @property
    def pose_count(self) -> int:
        return sum(step.seen + step.unseen for step in self.steps)

    def split(self, identity: int) -> Split:
        """Which split identity number ``identity`` belongs to."""
        return SPLITS[self._splits[identity]]

    def identities(self, split: Split) -> list[int]:
        """Identity numbers of a split."""
        return np.flatnonzero(self._splits == SPLITS.index(split)).tolist()

    def pose_type(self, pose: int) -> PoseType:
        """Whether pose number ``pose`` occurs in training."""
        return POSE_TYPES[self._pose_types[pose]]

    def poses(self, pose_type: PoseType) -> NDArray[np.int64]:
        """Pose numbers of a type, in order."""
        return np.flatnonzero(self._pose_types == POSE_TYPES.index(pose_type))

    def poses_of(self, identity: int) -> NDArray[np.int64]:
        """Pose numbers that this identity is made in, ascending."""
        return self._poses_in[self.split(identity)]

    @cached_property
    def _poses_in(self) -> dict[Split, NDArray[np.int64]]:
        return {split: np.concatenate([np.arange(*span) for span in self.pose_spans(split)]) for split in SPLITS}

    def identity_spans(self, split: Split) -> list[tuple[int, int]]:
        """Identity numbers [first, end) of a split that each step adds."""
        counts = [count for step in self.steps for count in (step.training, step.evaluation)]
        return self._spans(counts)[SPLITS.index(split) :: 2]

    def pose_spans(self, split: Split) -> list[tuple[int, int]]:
        """Pose numbers [first, end) that each step adds to the identities of a split."""
        starts = [first for first, _ in self._spans([step.seen + step.unseen for step in self.steps])]
        return [(first, first + count) for first, count in zip(starts, self._added(split), strict=True)]

    @staticmethod
    def _spans(counts: list[int]) -> list[tuple[int, int]]:
        ends = [0]
        for count in counts:
            ends.append(ends[-1] + count)
        return list(pairwise(ends))

    def shard_shape(self, split: Split, *, identities: int, vertices: float) -> tuple[int, int]:
        """Identities and poses of a full shard of an array that begins with so many ``identities``.

        No more meshes than the recipe says, than ``MOST_MESHES``, than ``LARGEST_SHARD`` holds, and than there were at
        first; several identities only where all first poses of one do not fill a shard.
        """
        wanted = min(self.recipe.store.poses_per_shard, MOST_MESHES)
        most = max(1, min(wanted, int(LARGEST_SHARD // max(1, 12 * vertices))))
        poses = min(most, self._added(split)[0])
        return max(1, min(most // poses, identities)), poses

    @property
    def shard_count(self) -> int:
        """How many shards there are if identities share a topology of small meshes.

        Like the other counts it lists nothing, however large the grid.
        """
        return sum(self._shards_in(split) for split in SPLITS)

    def _shards_in(self, split: Split) -> int:
        members = [count for step in self.steps if (count := getattr(step, split))]
        if not members:
            return 0
        identities, poses = self.shard_shape(split, identities=members[0], vertices=0)
        return sum(-(-count // identities) for count in members) * sum(-(-n // poses) for n in self._added(split))

    @property
    def mesh_count(self) -> int:
        return sum(self._identity_count(split) * sum(self._added(split)) for split in SPLITS)

    def _identity_count(self, split: Split) -> int:
        return sum(getattr(step, split) for step in self.steps)

    def _added(self, split: Split) -> list[int]:
        """How many poses each step gives to the identities of a split."""
        return [step.seen + (step.unseen if split == "evaluation" else 0) for step in self.steps]

    def evaluation_triples(self, pose_type: PoseType) -> NDArray[np.int32]:
        """The fixed evaluation list: rows of (source identity, source pose, target identity, target pose).

        Ground truth is (target identity, source pose). Identities are evaluation identities, source and target
        differ in identity and in pose, and the source pose is of the asked type; the target's pose is any other
        pose. Every step that appends evaluation cells appends a list over all that there was then. A list is empty
        where two such identities or poses do not exist.
        """
        lists = [self._triples_of(step, pose_type) for step in range(len(self.steps))]
        return np.concatenate(lists).astype(np.int32)

    def possible_triples(self, pose_type: PoseType) -> int:
        """How many different evaluation triples of a pose type there are to draw from."""
        identities = self._identity_count("evaluation")
        return max(0, identities * (identities - 1) * len(self.poses(pose_type)) * (self.pose_count - 1))

    def _triples_of(self, step: int, pose_type: PoseType) -> NDArray[np.int64]:
        added = self.steps[step]
        until = Grid(self.recipe.model_copy(update={"growth": self.recipe.growth[:step]}))
        identities, poses = np.array(until.identities("evaluation"), np.int64), until.poses(pose_type)
        nothing_new = not (added.evaluation or added.seen or added.unseen)
        if nothing_new or len(identities) < 2 or not len(poses) or until.pose_count < 2:
            return np.empty((0, 4), np.int64)
        number = 2 * step + (0 if pose_type == "seen" else 1)
        random = generator(self.recipe.triples.seed, Stream.EVALUATION_TRIPLES, number)
        count = self.recipe.triples.count
        target = random.integers(0, len(identities), count)
        source = (target + random.integers(1, len(identities), count)) % len(identities)
        source_pose = poses[random.integers(0, len(poses), count)]
        target_pose = (source_pose + random.integers(1, until.pose_count, count)) % until.pose_count
        return np.stack([identities[source], source_pose, identities[target], target_pose], axis=1)


@dataclass(frozen=True)
class GridArray:
    """One array of vertices: the identities of a split that share a topology, in all poses of the split.

    Attributes
    ----------
    vertices
        Of each mesh.
    identities, poses
        The numbers [identity] and [pose] int32 along the two axes; ``HOLE`` where there are no meshes.
    room
        How many identities and poses a full shard has.
    """

    split: Split
    topology: int
    vertices: int
    identities: NDArray[np.int32]
    poses: NDArray[np.int32]
    room: tuple[int, int]

    @property
    def path(self) -> str:
        """Path of its group within a dataset."""
        return f"grid/{self.split}/{self.topology}"

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of the array: (identity, pose, vertex, 3)."""
        return len(self.identities), len(self.poses), self.vertices, 3

    @cached_property
    def columns(self) -> dict[int, int]:
        """The place of each pose along the second axis."""
        return {pose: column for column, pose in enumerate(self.poses.tolist()) if pose != HOLE}

    def place(self, row: int, column: int) -> Place:
        """The place of the shard that is ``row`` shards along the identities and ``column`` along the poses."""
        return SPLITS.index(self.split), self.topology, row, column

    def shards(self, wanted: NDArray[np.bool_] | None = None) -> Iterator[Shard]:
        """All shards or the ``wanted`` [shard], in the order of their places; one never holds meshes of two steps."""
        height, width = self.room
        held = [_without_holes(self.poses[start : start + width]) for start in range(0, len(self.poses), width)]
        spans = [range(poses[0], poses[-1] + 1) for poses in held]
        which = np.ones(self.shard_count, bool) if wanted is None else wanted
        for row, columns in enumerate(which.reshape(-1, len(spans))):
            if columns.any():
                members = tuple(_without_holes(self.identities[row * height : (row + 1) * height]))
                for column in np.flatnonzero(columns).tolist():
                    yield Shard(self.place(row, column), members, spans[column], self.vertices, self.room)

    def places(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The place [shard, 4] and the number of meshes [shard] of its shards; it makes no list of these."""
        (height, width), split = self.room, SPLITS.index(self.split)
        rows, columns = _filled(self.identities, height), _filled(self.poses, width)
        row, column = np.indices((len(rows), len(columns))).reshape(2, -1)
        places = np.stack([np.full_like(row, split), np.full_like(row, self.topology), row, column], axis=1)
        return places.astype(np.int32), np.outer(rows, columns).ravel().astype(np.int32)

    @property
    def shard_count(self) -> int:
        """How many shards it has."""
        height, width = self.room
        return -(-len(self.identities) // height) * -(-len(self.poses) // width)


class GridArrays:
    """The arrays of vertices that hold the meshes of a grid.

    Parameters
    ----------
    grid
        Which meshes there are.
    topologies
        The topology of each identity [identity].
    vertices
        The vertices of a mesh of each topology [topology].
    """

    def __init__(self, grid: Grid, topologies: Sequence[int] | NDArray[np.integer], vertices: Sequence[int]) -> None:
        self.grid, self.vertices = grid, tuple(vertices)
        self.topologies: NDArray[np.int32] = np.array(topologies, np.int32)
        members: dict[tuple[int, int], list[NDArray[np.int64]]] = {}
        for number, split in enumerate(SPLITS):
            for first, end in grid.identity_spans(split):
                for topology, identities in _by_value(self.topologies[first:end]):
                    members.setdefault((number, topology), []).append(first + identities)
        self.arrays = [
            self._array(SPLITS[split], topology, steps) for (split, topology), steps in sorted(members.items())
        ]

    def _array(self, split: Split, topology: int, identities: list[NDArray[np.int64]]) -> GridArray:
        vertices = self.vertices[topology]
        height, width = self.grid.shard_shape(split, identities=len(identities[0]), vertices=vertices)
        poses = [np.arange(*span) for span in self.grid.pose_spans(split)]
        return GridArray(
            split, topology, vertices, _with_holes(identities, height), _with_holes(poses, width), (height, width)
        )

    @cached_property
    def _rows(self) -> dict[int, tuple[GridArray, int]]:
        places = ((array, row) for array in self.arrays for row in np.flatnonzero(array.identities != HOLE).tolist())
        return {int(array.identities[row]): (array, row) for array, row in places}

    def row_of(self, identity: int) -> tuple[GridArray, int]:
        """The array that holds an identity, and its place along the first axis (KeyError where there is none)."""
        return self._rows[identity]

    def strips(self, split: Split) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The row of shards of each identity [identity] of a split, and the column of each pose [pose], from 0.

        Where arrays differ in the poses of a shard, the columns are those of the widest.
        """
        members = [self.row_of(identity) for identity in self.grid.identities(split)]
        places = [(array.topology, row // array.room[0]) for array, row in members]
        widest = max((array for array, _ in members), key=lambda array: array.room[1])
        rows = np.unique(places, axis=0, return_inverse=True)[1].ravel()
        return rows, np.flatnonzero(widest.poses != HOLE) // widest.room[1]

    @property
    def shard_count(self) -> int:
        """How many shards there are; it lists none."""
        return sum(array.shard_count for array in self.arrays)

    def places(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The place [shard, 4] and the number of meshes [shard] of all shards, ordered by place."""
        found = [array.places() for array in self.arrays]
        return np.concatenate([places for places, _ in found]), np.concatenate([rows for _, rows in found])

    def shards(self, wanted: NDArray[np.bool_] | None = None) -> list[Shard]:
        """All shards or the ``wanted`` [shard] of them, ordered by place."""
        which = np.ones(self.shard_count, bool) if wanted is None else wanted
        each = np.split(which, np.cumsum([array.shard_count for array in self.arrays])[:-1])
        return [shard for array, some in zip(self.arrays, each, strict=True) for shard in array.shards(some)]


def _repeated(counts: Sequence[int]) -> NDArray[np.intp]:
    """0 and 1 in turns, as often as ``counts`` says, which has two numbers for each step."""
    return np.repeat(np.arange(len(counts)) % 2, counts)


def _by_value(values: NDArray[np.int32]) -> list[tuple[int, NDArray[np.int64]]]:
    """Each value that occurs, and where."""
    order = np.argsort(values, kind="stable")
    places = np.split(order, np.flatnonzero(np.diff(values[order])) + 1)
    return [(int(values[alike[0]]), alike) for alike in places if len(alike)]


def _with_holes(steps: Sequence[NDArray[np.int64]], size: int) -> NDArray[np.int32]:
    """The numbers that each step adds, each step's beginning at a multiple of ``size``."""
    padded = [np.concatenate([step, np.full(-len(step) % size, HOLE)]) for step in steps if len(step)]
    numbers = np.concatenate(padded)
    return numbers[: np.flatnonzero(numbers != HOLE)[-1] + 1].astype(np.int32)


def _filled(numbers: NDArray[np.int32], size: int) -> NDArray[np.int64]:
    """How many places of each run of ``size`` are no holes."""
    return np.add.reduceat(numbers != HOLE, np.arange(0, len(numbers), size), dtype=np.int64)


def _without_holes(numbers: NDArray[np.int32]) -> list[int]:
    return [number for number in numbers.tolist() if number != HOLE]
