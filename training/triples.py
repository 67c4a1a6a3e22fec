"""Which triples a training shows, and in which order: a function of (seed, epoch, index), whatever the machine.

A training triple is (source, target, truth): truth = (target's identity, source's pose); source and target differ in
identity and in pose (DSFFNet, section 4.1). One epoch shows every cell of the training grid once as truth.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.errors import DatasetError, RecipeError
from datagen.random import Stream, generator

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


@dataclass(frozen=True)
class TripleOrder:
    """The order of training triples of some identities and poses over a whole run, the same for any number of ranks.

    A batch is rows of one epoch that follow each other. The ranks take equal runs of it in their order, and a rank
    that accumulates cuts its run into equal parts, again in order: the triples of a step do not depend on either.
    """

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
            raise DatasetError(
                f"the training grid has {self.cells} cells, fewer than a batch of {self.batch}. "
                f"Use --set training.batch={self.cells} at most, or make more poses"
            )

    @property
    def cells(self) -> int:
        """Triples of an epoch, those that fill no whole batch at its end included."""
        return len(self.identities) * len(self.poses)

    @property
    def steps_per_epoch(self) -> int:
        """Whole batches of an epoch."""
        return self.cells // self.batch

    def batches(
        self, *, first_step: int, rank: int = 0, ranks: int = 1, parts: int = 1
    ) -> Iterator[list[NDArray[np.int64]]]:
        """This rank's share of every batch from ``first_step`` on, without end: ``parts`` equal arrays [triple, 4].

        Raises
        ------
        RecipeError
            The batch cannot be shared equally.
        """
        first, size = self._first_and_size(rank=rank, ranks=ranks, parts=parts)
        return self._shares(first_step, slice(first, first + parts * size), parts)

    def places(self, *, rank: int = 0, ranks: int = 1, parts: int = 1) -> list[int]:
        """Place in the whole batch of the first triple of each part of a rank's share; the same in every step."""
        first, size = self._first_and_size(rank=rank, ranks=ranks, parts=parts)
        return [first + part * size for part in range(parts)]

    def _first_and_size(self, *, rank: int, ranks: int, parts: int) -> tuple[int, int]:
        size, rest = divmod(self.batch, ranks * parts)
        if rest:
            raise RecipeError(
                f"training.batch {self.batch} cannot be shared equally by {ranks} ranks in {parts} parts each; "
                f"make it a multiple of {ranks * parts}"
            )
        return rank * parts * size, size

    def _shares(self, first_step: int, share: slice, parts: int) -> Iterator[list[NDArray[np.int64]]]:
        epoch, place = divmod(first_step, self.steps_per_epoch)
        while True:
            triples = self._numbered(epoch)
            for start in range(place * self.batch, self.steps_per_epoch * self.batch, self.batch):
                yield np.split(triples[start : start + self.batch][share], parts)
            epoch, place = epoch + 1, 0

    def _numbered(self, epoch: int) -> NDArray[np.int64]:
        """An epoch's triples, by the dataset's numbers of identities and poses."""
        identities, poses = np.asarray(self.identities), np.asarray(self.poses)
        triples = epoch_triples(identities=len(identities), poses=len(poses), seed=self.seed, epoch=epoch)
        source, source_pose, target, target_pose = triples.T
        return np.stack([identities[source], poses[source_pose], identities[target], poses[target_pose]], axis=1)
