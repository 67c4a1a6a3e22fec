"""Identities x poses -> splits -> rows -> shards -> evaluation triples. Pure; no input or output.

The grid of the DSFFNet paper (section 4.1): training identities are made in the seen poses only, evaluation
identities in the seen and the unseen ones. A shard is a run of rows of one identity's array.

A grid grows in steps: what a step appends is numbered after everything before it, and its poses begin at a new shard,
so that no shard that exists is ever written again. Rows between a step's last pose and the next shard are holes.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
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
"""The pose number of a row that holds no mesh."""


@dataclass(frozen=True, order=True)
class Shard:
    """Rows ``[start, stop)`` of one identity's array; ``number`` is its place along the row axis."""

    identity: int
    number: int
    start: int
    stop: int

    @property
    def rows(self) -> int:
        return self.stop - self.start


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
    def _splits(self) -> list[Split]:
        found: list[Split] = []
        for step in self.steps:
            found.extend("training" for _ in range(step.training))
            found.extend("evaluation" for _ in range(step.evaluation))
        return found

    @cached_property
    def _pose_types(self) -> list[PoseType]:
        found: list[PoseType] = []
        for step in self.steps:
            found.extend("seen" for _ in range(step.seen))
            found.extend("unseen" for _ in range(step.unseen))
        return found

    @property
    def identity_count(self) -> int:
        return sum(step.training + step.evaluation for step in self.steps)

    @property
    def pose_count(self) -> int:
        return sum(step.seen + step.unseen for step in self.steps)

    def split(self, identity: int) -> Split:
        """Which split identity number ``identity`` belongs to."""
        return self._splits[identity]

    def identities(self, split: Split) -> list[int]:
        """Identity numbers of a split."""
        return [number for number, its in enumerate(self._splits) if its == split]

    def pose_type(self, pose: int) -> PoseType:
        """Whether pose number ``pose`` occurs in training."""
        return self._pose_types[pose]

    def poses(self, pose_type: PoseType) -> NDArray[np.int64]:
        """Pose numbers of a type, in order."""
        return np.flatnonzero([its == pose_type for its in self._pose_types])

    def poses_of(self, identity: int) -> NDArray[np.int64]:
        """Pose numbers that this identity is made in, in the order of its rows."""
        rows = self.rows_of(identity)
        return rows[rows != HOLE]

    def rows_of(self, identity: int) -> NDArray[np.int64]:
        """The pose number of each row [row] of an identity's array; ``HOLE`` where a row holds no mesh."""
        return self._rows[self.split(identity)]

    def row_of(self, identity: int, pose: int) -> int:
        """The row that holds a pose of an identity (KeyError where there is none)."""
        return self._row_numbers[self.split(identity)][pose]

    @cached_property
    def _row_numbers(self) -> dict[Split, dict[int, int]]:
        return {
            split: {int(pose): row for row, pose in enumerate(rows) if pose != HOLE}
            for split, rows in self._rows.items()
        }

    @cached_property
    def _rows(self) -> dict[Split, NDArray[np.int64]]:
        return {split: self._rows_in(split) for split in SPLITS}

    def _rows_in(self, split: Split) -> NDArray[np.int64]:
        rows: NDArray[np.int64] = np.empty(0, np.int64)
        first = 0
        for step, count in zip(self.steps, self._added(split), strict=True):
            if count:
                holes = np.full(-len(rows) % self.rows_per_shard(split), HOLE, np.int64)
                rows = np.concatenate([rows, holes, np.arange(first, first + count)])
            first += step.seen + step.unseen
        return rows

    def rows_per_shard(self, split: Split) -> int:
        """Rows of a full shard: as the recipe says, but no more than the identities of a split had at first."""
        return min(self.recipe.store.poses_per_shard, self._added(split)[0])

    def shards_of(self, identity: int) -> Iterator[Shard]:
        """Shards of one identity, in order; a shard never holds poses of two steps."""
        rows, size = self.rows_of(identity), self.rows_per_shard(self.split(identity))
        for number, start in enumerate(range(0, len(rows), size)):
            filled = int((rows[start : start + size] != HOLE).sum())
            yield Shard(identity, number, start, start + filled)

    def shards(self) -> list[Shard]:
        """All shards, identity by identity."""
        return [shard for identity in range(self.identity_count) for shard in self.shards_of(identity)]

    @property
    def shard_count(self) -> int:
        """How many shards there are; like the other counts it lists nothing, however large the grid."""
        return sum(
            self._identity_count(split) * sum(-(-count // self.rows_per_shard(split)) for count in self._added(split))
            for split in SPLITS
        )

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
