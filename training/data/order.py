"""In which order a training shows its examples: a function of (seed, epoch, index), whatever the machine."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import RecipeError

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
