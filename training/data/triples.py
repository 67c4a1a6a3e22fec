"""Which triples a training shows, and in which order."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import DatasetError
from datagen.common.seeding import Stream, generator
from datagen.store import Dataset
from training.data.order import BatchOrder
from training.recipes.training import TrainingRecipe

Triples = NDArray[np.integer]
"""Rows [triple, 4] of (source identity, source pose, target identity, target pose)."""


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


def order_of(recipe: TrainingRecipe, dataset: Dataset) -> "TripleOrder":
    """The order of triples of a training by this recipe on this dataset: training identities in seen poses.

    Raises
    ------
    DatasetError
        See :class:`TripleOrder`.
    """
    return TripleOrder(dataset.identities("training"), dataset.grid.poses("seen"), batch=recipe.batch, seed=recipe.seed)


def last_step_of(recipe: TrainingRecipe, dataset: Dataset) -> int:
    """The step at which a training of this recipe on this dataset ends, unless early stopping ends it before."""
    return recipe.last_step(order_of(recipe, dataset).steps_per_epoch)


@dataclass(frozen=True)
class TripleOrder(BatchOrder):
    """The order of training triples of some identities and poses."""

    identities: Sequence[int]
    poses: Sequence[int] | NDArray[np.integer]

    def __post_init__(self) -> None:
        if len(self.identities) < 2 or len(self.poses) < 2:
            raise DatasetError(
                f"a training triple needs two identities and two poses, but the training split has "
                f"{len(self.identities)} identities in {len(self.poses)} poses. Make a larger one: "
                "--set data.identities.training=... data.poses.seen=..."
            )
        if self.steps_per_epoch == 0:
            raise DatasetError(
                f"the training grid has {self.cells} cells, fewer than a batch of {self.batch}. "
                f"Use --set training.batch={self.cells} at most, or make more poses"
            )

    @property
    def cells(self) -> int:
        return len(self.identities) * len(self.poses)

    def epoch(self, number: int) -> NDArray[np.int64]:
        """An epoch's triples, by the dataset's numbers of identities and poses."""
        identities, poses = np.asarray(self.identities), np.asarray(self.poses)
        triples = epoch_triples(identities=len(identities), poses=len(poses), seed=self.seed, epoch=number)
        source, source_pose, target, target_pose = triples.T
        return np.stack([identities[source], poses[source_pose], identities[target], poses[target_pose]], axis=1)
