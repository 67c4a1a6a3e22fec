"""Identities x poses -> splits -> rows -> shards -> evaluation triples. Pure; no input or output.

The grid of the DSFFNet paper (section 4.1): training identities are made in the seen poses only, evaluation
identities in the seen and the unseen ones. Identity i < ``training`` is a training identity; pose p < ``seen``
is a seen pose. A shard is a run of consecutive poses of one identity.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.random import Stream, generator
from datagen.recipe import DatasetRecipe

PoseType = Literal["seen", "unseen"]
Split = Literal["training", "evaluation"]


@dataclass(frozen=True, order=True)
class Shard:
    """Rows ``[start, stop)`` of one identity's array; ``number`` is its place along the pose axis."""

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

    @property
    def identity_count(self) -> int:
        return self.recipe.identities.training + self.recipe.identities.evaluation

    @property
    def pose_count(self) -> int:
        return self.recipe.poses.seen + self.recipe.poses.unseen

    def split(self, identity: int) -> Split:
        """Which split identity number ``identity`` belongs to."""
        return "training" if identity < self.recipe.identities.training else "evaluation"

    def pose_type(self, pose: int) -> PoseType:
        """Whether pose number ``pose`` occurs in training."""
        return "seen" if pose < self.recipe.poses.seen else "unseen"

    def poses_of(self, identity: int) -> range:
        """Pose numbers that this identity is made in; row r of its array is ``poses_of(identity)[r]``."""
        return range(self.recipe.poses.seen if self.split(identity) == "training" else self.pose_count)

    def shards_of(self, identity: int) -> Iterator[Shard]:
        """Shards of one identity, in order."""
        size, rows = self.recipe.store.poses_per_shard, len(self.poses_of(identity))
        for number, start in enumerate(range(0, rows, size)):
            yield Shard(identity, number, start, min(start + size, rows))

    def shards(self) -> list[Shard]:
        """All shards, identity by identity."""
        return [shard for identity in range(self.identity_count) for shard in self.shards_of(identity)]

    @property
    def mesh_count(self) -> int:
        return sum(len(self.poses_of(identity)) for identity in range(self.identity_count))

    def evaluation_triples(self, pose_type: PoseType) -> NDArray[np.int32]:
        """The fixed evaluation list: rows of (source identity, source pose, target identity, target pose).

        Ground truth is (target identity, source pose). Identities are evaluation identities, source and target
        differ in identity and in pose, and the source pose is of the asked type; the target's pose is any other
        pose that the identity exists in.
        """
        recipe = self.recipe
        identities = recipe.identities.training + np.arange(recipe.identities.evaluation)
        low, high = (0, recipe.poses.seen) if pose_type == "seen" else (recipe.poses.seen, self.pose_count)
        if low == high:
            return np.empty((0, 4), np.int32)
        random = generator(recipe.triples.seed, Stream.EVALUATION_TRIPLES, 0 if pose_type == "seen" else 1)
        count = recipe.triples.count
        target = random.integers(0, len(identities), count)
        source = (target + random.integers(1, len(identities), count)) % len(identities)
        source_pose = random.integers(low, high, count)
        target_pose = (source_pose + random.integers(1, self.pose_count, count)) % self.pose_count
        columns = (identities[source], source_pose, identities[target], target_pose)
        return np.stack(columns, axis=1).astype(np.int32)
