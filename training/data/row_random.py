"""Random numbers of the rows of a batch, the same on every device and for any number of ranks and parts."""

from enum import IntEnum
from math import prod

import numpy as np
import torch
from torch import Tensor

from datagen.common.seeding import Stream
from training.networks.execution import sent


class Purpose(IntEnum):
    """What numbers are drawn for: those of different purposes have nothing to do with each other."""

    AS_SOURCE_POINTS = 0
    AS_TARGET_POINTS = 1
    SOURCE_POINTS = 2
    TARGET_POINTS = 3
    TURN = 4
    LEAN = 5
    HOLE = 6
    HOLE_MIDDLE = 7
    FEWER = 8
    SOURCE_SUBSET = 9
    SOURCE_AGAIN = 10
    TARGET_SUBSET = 11
    TARGET_AGAIN = 12
    EDGES = 13
    UNTOLD = 14
    PROPORTIONS = 15
    RESIZED = 16
    DEVIATION = 17
    NOISE = 18
    RECOMBINED = 19
    JOINT_POSES = 20


class RowRandom:
    """Numbers that are a function of (seed, step, place of the row in the whole batch, purpose, index).

    Each is a hash of these, so all rows of a batch are drawn together, wherever they are, and nothing waits for a GPU.
    They are the same on every device, normal ones but for rounding. Along the first axis of a shape a row's numbers
    begin alike however many are drawn. Keys of rows have 32 bits: in a long training a few rows share their numbers.

    Parameters
    ----------
    keys
        Of the rows [b, 1] int64 of 32 bits, in the memory of the CPU; :meth:`of_batch` makes them.
    device
        Where numbers are wanted.
    """

    def __init__(self, keys: Tensor, device: torch.device) -> None:
        self._on_host, self._keys = keys, sent(keys, device)

    @classmethod
    def of_batch(cls, seed: int, step: int, *, first: int, rows: int, device: torch.device | str) -> "RowRandom":
        """Those of a batch's rows.

        Parameters
        ----------
        seed, step
            Of the training; steps done before this one.
        first, rows
            The place of the first row in the whole batch, and how many rows there are.
        device
            Where numbers are wanted.
        """
        state = np.random.SeedSequence((seed, int(Stream.AUGMENTATION), step)).generate_state(2)
        one, other = (int(word) for word in state)
        places = torch.arange(first, first + rows)[:, None]
        return cls(_hashed(_hashed((places + one) & _MASK) ^ other), torch.device(device))

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def device(self) -> torch.device:
        """Where numbers are drawn."""
        return self._keys.device

    def on_host(self) -> "RowRandom":
        """The same numbers in the memory of the CPU, for what Python decides by them."""
        return RowRandom(self._on_host, torch.device("cpu"))

    def of(self, rows: Tensor) -> "RowRandom":
        """Those of some rows; their numbers [k] lie in the memory of the CPU."""
        return RowRandom(self._on_host[rows], self.device)

    def uniform(self, purpose: Purpose, *shape: int) -> Tensor:
        """Return [b, *shape] float32 in [0, 1), multiples of 2^-24."""
        return (self._bits(purpose, shape) >> 8).float() * 2.0**-24

    def normal(self, purpose: Purpose, *shape: int) -> Tensor:
        """Return [b, *shape] float32 of mean 0 and deviation 1 (Box and Muller 1958)."""
        radius, angle = self.uniform(purpose, *shape, 2).unbind(-1)
        return (-2 * (1 - radius).log()).sqrt() * (2 * np.pi * angle).cos()

    def below(self, purpose: Purpose, limits: Tensor | int, *shape: int) -> Tensor:
        """Return whole numbers [b, *shape], each of 0 to less than a limit, one for all or of each row [b]."""
        if isinstance(limits, Tensor):
            limits = limits.view(-1, *[1] * len(shape))
        return (self._bits(purpose, shape) * limits) >> 32

    def _bits(self, purpose: Purpose, shape: tuple[int, ...]) -> Tensor:
        """Whole numbers [b, *shape] of 32 random bits."""
        assert prod(shape) <= 1 << _SHORT, "the next purpose's numbers begin there"
        numbers = torch.arange(prod(shape), device=self.device)
        drawn = _hashed(_hashed(numbers + (int(purpose) << _SHORT)) ^ self._keys)
        return drawn.view(len(self), *shape)


_MASK = 2**32 - 1
_SHORT = 27  # bits of the index of a number; purposes lie above
_FACTORS = 0x21F0AAAD, 0x735A2D97


def _hashed(numbers: Tensor) -> Tensor:
    """Mix the 32 bits of int64 numbers, written over: a bijection of low bias (Wellons 2018, "Hash Prospector")."""
    numbers ^= numbers >> 16
    numbers *= _FACTORS[0]
    numbers &= _MASK
    numbers ^= numbers >> 15
    numbers *= _FACTORS[1]
    numbers &= _MASK
    numbers ^= numbers >> 15
    return numbers
