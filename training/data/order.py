"""In which order a training shows its examples: a function of (seed, epoch, index), whatever the machine.

A training triple is (source, target, truth): truth = (target's identity, source's pose); source and target differ in
identity and in pose (DSFFNet, section 4.1). One epoch shows every cell of the training grid once as truth.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import DatasetError, RecipeError
from datagen.common.seeding import Stream, generator
from datagen.store import Dataset
from training.recipes.training import TrainingRecipe

Items = NDArray[np.integer]
"""Examples by their numbers, one a row [item, number of its parts]."""


@dataclass(frozen=True, kw_only=True)
class BatchOrder(ABC):
    """The order of a training's examples over a whole run, the same for any number of ranks.

    A batch is rows of one epoch that follow each other. The ranks take runs of it in their order, equal ones where
    they can, and a rank that accumulates cuts its run into parts: the examples of a step do not depend on either.
    """

    batch: int
    seed: int

    @property
    @abstractmethod
    def cells(self) -> int:
        """Examples of an epoch, those that fill no whole batch at its end included."""

    @abstractmethod
    def epoch(self, number: int) -> Items:
        """All examples [cells, ...] of an epoch in their order: a pure function of the order and the number."""

    @property
    def steps_per_epoch(self) -> int:
        """Whole batches of an epoch."""
        return self.cells // self.batch

    def batches(self, *, first_step: int, rank: int = 0, ranks: int = 1, parts: int = 1) -> Iterator[list[Items]]:
        """This rank's share of every batch from ``first_step`` on, without end: ``parts`` arrays of examples.

        Raises
        ------
        RecipeError
            The batch has fewer examples than there are ranks and parts.
        """
        return self._shares(first_step, self._cuts(rank=rank, ranks=ranks, parts=parts))

    def places(self, *, rank: int = 0, ranks: int = 1, parts: int = 1) -> list[int]:
        """Place in the whole batch of the first example of each part of a rank's share; the same in every step."""
        return [start for start, _ in self._cuts(rank=rank, ranks=ranks, parts=parts)]

    def share(self, *, rank: int = 0, ranks: int = 1) -> float:
        """How much more of a batch this rank has than the mean rank: 1 where the batch is shared equally."""
        ((start, stop),) = self._cuts(rank=rank, ranks=ranks, parts=1)
        return (stop - start) * ranks / self.batch

    def _cuts(self, *, rank: int, ranks: int, parts: int) -> list[tuple[int, int]]:
        """First place of each part, and the place after its last; sizes differ by one at most."""
        if self.batch < ranks * parts:
            raise RecipeError(
                f"training.batch {self.batch} is too small to be shared by {ranks} ranks in {parts} parts each; "
                f"make it {ranks * parts} or more"
            )
        mine = np.array_split(np.arange(self.batch), ranks)[rank]
        return [(int(part[0]), int(part[-1]) + 1) for part in np.array_split(mine, parts)]

    def _shares(self, first_step: int, cuts: list[tuple[int, int]]) -> Iterator[list[Items]]:
        epoch, place = divmod(first_step, self.steps_per_epoch)
        while True:
            items = self.epoch(epoch)
            for first in range(place * self.batch, self.steps_per_epoch * self.batch, self.batch):
                yield [items[first + start : first + stop] for start, stop in cuts]
            epoch, place = epoch + 1, 0


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
