"""What the trainer must be told of what it trains: what a batch is, what its losses are, and what is measured.

The rest is the same for whatever is learned: ranks, steps, checkpoints, the journal, when to stop. A task of its own is
a class with these members, and a line in :mod:`training.engine.tasks.registry`.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol, Self

import torch
from torch import nn

from training.data.cache_policy import Room
from training.data.order import BatchOrder, Items
from training.engine.distributed import Ranks


class Batch(Protocol):
    """Examples that a forward pass takes together."""

    def __len__(self) -> int:
        """How many examples."""

    def in_dtype(self, dtype: torch.dtype) -> Self:
        """The same with what is learned from in another floating type."""


Shares = Iterator[tuple[Sequence[Items], Sequence[Any]]]
"""Of each step the numbers of this rank's examples and its batches, both cut into parts where it accumulates."""


class Feed(Protocol):
    """The opened data of a rank."""

    where: str
    """In words, where they are kept and why there."""

    def batches(self, first_step: int) -> Shares:
        """This rank's share of every step from ``first_step`` on, without end, on its device."""


class Validation(ABC):
    """What is measured of a network while it learns, always on the same examples; the base of those that do."""

    decides: str
    """What tells which weights are best, measured as ``decides_seen`` and ``decides_unseen``: ``evaluation/pmd``."""

    @abstractmethod
    def measure(self, network: nn.Module) -> dict[str, float]:
        """``evaluation/NAME`` of each measure, of a network in evaluation mode."""

    def decisive(self, metrics: dict[str, float]) -> float:
        """The measure that decides which weights are best: the least. It is of unseen poses, where there are."""
        return metrics.get(f"{self.decides}_unseen", metrics.get(f"{self.decides}_seen", float("inf")))

    def draw(self, network: nn.Module, path: Path, *, title: str) -> None:  # noqa: B027  # most draw nothing
        """A picture of some examples; none where they cannot be drawn."""


class Named(Protocol):
    """Data that can be told apart: where they are, and which."""

    @property
    def url(self) -> str:
        """Where they are."""

    @property
    def uuid(self) -> str:
        """Which they are."""


class Task(Named, Protocol):
    """What is learned, from which data; a run is resumed on no other."""

    sha256: str

    @property
    def order(self) -> BatchOrder:
        """Of its examples."""

    def check(self, room: Room, ranks: int) -> None:
        """Refuse what cannot be trained, before anything large is opened.

        Raises
        ------
        DatasetError, RecipeError
            Its data do not tell what the recipe asks for; a step needs more than a device's room.
        """

    def network(self) -> nn.Module:
        """A new one, of the recipe's kind; its first weights are drawn from torch's generator."""

    def objective(self, network: nn.Module, device: torch.device) -> nn.Module:
        """What a step calls, as ``objective(batch, step=...)``; it holds the network.

        Returns ``{"total": ..., name: ...}``, of which the total has a gradient.
        """

    def feed(self, ranks: Ranks, device: torch.device) -> AbstractContextManager[Feed]:
        """The data of a rank, opened while the block runs; every rank calls this together."""

    def validation(self, device: torch.device, dtype: torch.dtype) -> Validation:
        """What rank 0 measures with."""
