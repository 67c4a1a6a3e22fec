"""Torch's random states of all ranks, for checkpoints; NumPy's are not used, see :mod:`datagen.random`."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor


def random_states(ranks: int = 1) -> list[dict[str, Tensor]]:
    """Torch's random states (CPU, and CUDA where it is in use) of every rank; all ranks must call this together."""
    own = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        own["cuda"] = torch.cuda.get_rng_state()
    if ranks == 1:
        return [own]
    states: list[Any] = [None] * ranks
    dist.all_gather_object(states, own)
    return states


def restore_random_state(states: Sequence[Mapping[str, Tensor]], rank: int) -> None:
    """Give this rank the random state it had; a rank that was not there keeps the one that it was seeded with."""
    if rank < len(states):
        torch.set_rng_state(states[rank]["cpu"])
        if "cuda" in states[rank] and torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
            torch.cuda.set_rng_state(states[rank]["cuda"])
