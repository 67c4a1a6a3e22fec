"""Frames of subjects in the order that a training shows them, and what is drawn for each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import DatasetError
from datagen.common.seeding import Stream, generator
from training.data.order import BatchOrder
from training.engine.distributed import Ranks
from training.engine.tasks.protocol import Shares
from training.recipes.training import TrainingRecipe


@dataclass(frozen=True)
class FrameOrder(BatchOrder):
    """Rows (subject, frame) of the frames that each subject shows; every epoch shows all of them once, mixed."""

    frames: Sequence[Sequence[int]]

    def __post_init__(self) -> None:
        if self.steps_per_epoch == 0:
            raise DatasetError(
                f"there are {self.cells} frames to learn from, fewer than a batch of {self.batch}: make the batch "
                "smaller, or more poses"
            )

    @property
    def cells(self) -> int:
        return sum(len(its) for its in self.frames)

    def epoch(self, number: int) -> NDArray[np.int64]:
        rows = np.array([(subject, frame) for subject, its in enumerate(self.frames) for frame in its], np.int64)
        return generator(self.seed, Stream.TRAINING_TRIPLES, number).permutation(rows)


BatchOf = Callable[[list[tuple[int, int]], int, int], Any]
"""The examples of rows (subject, frame) in a step; the first of them has a place, the last argument, in the batch."""


class FrameFeed:
    """This rank's share of every step's frames; see :class:`training.engine.tasks.protocol.Feed`."""

    where = "memory"

    def __init__(self, recipe: TrainingRecipe, order: FrameOrder, ranks: Ranks, batch_of: BatchOf) -> None:
        self._order, self._batch_of = order, batch_of
        self._mine = {"rank": ranks.rank, "ranks": ranks.count, "parts": recipe.accumulate}

    def batches(self, first_step: int) -> Shares:
        """See :class:`training.engine.tasks.protocol.Feed`."""
        places = self._order.places(**self._mine)
        for step, share in enumerate(self._order.batches(first_step=first_step, **self._mine), first_step):
            parts = zip(share, places, strict=True)
            yield share, [self._batch_of(rows.tolist(), step, first) for rows, first in parts]


def drawn(seed: int, step: int, place: int, *, of: int, count: int) -> NDArray[np.int64]:
    """Numbers [count] of what an example takes of ``of`` points, a function of (seed, step, place in the batch)."""
    return generator(seed, Stream.AUGMENTATION, step * _PLACES + place).choice(of, count, replace=count > of)


_PLACES = 2**20
