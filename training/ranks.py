"""The processes that train together: who is who, agreeing, averaging, joining, stopping."""

import contextlib
import datetime
import os
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist
from filelock import FileLock, Timeout
from torch import Tensor

from datagen.errors import DsffnetError
from training.recipe import TrainingRecipe

LOCK_SECONDS = 30.0  # how long to wait for the ranks of a killed driver to be gone


class TrainingError(DsffnetError):
    """Training cannot go on: non-finite loss, too few CPUs, another process on the same run."""


@dataclass(frozen=True)
class Ranks:
    """Where this process stands among those that train together."""

    rank: int
    count: int
    local: int

    @classmethod
    def from_environment(cls) -> "Ranks":
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
        return cls(*(int(os.environ.get(name, default)) for name, default in zip(names, "010", strict=True)))


def device_of(recipe: TrainingRecipe, ranks: Ranks) -> torch.device:
    if recipe.device == "cpu" or (recipe.device == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise TrainingError("training.device is 'cuda', but torch sees no CUDA device. Use --set training.device=cpu")
    torch.cuda.set_device(ranks.local)
    return torch.device("cuda", ranks.local)


def any_rank(flags: list[bool], ranks: Ranks) -> list[bool]:
    """For each flag, whether it is raised on any rank; every rank gets the same answer."""
    if ranks.count == 1:
        return flags
    device = torch.device("cuda", ranks.local) if dist.get_backend() == "nccl" else "cpu"
    shared = torch.tensor(flags, dtype=torch.float32, device=device)
    dist.all_reduce(shared, op=dist.ReduceOp.MAX)
    return [bool(flag) for flag in shared.tolist()]


def mean_over_ranks(values: dict[str, Tensor | float], ranks: Ranks) -> dict[str, float]:
    """Means over the ranks, whose shares of a batch are equal; the means over the batch, that is."""
    shared = torch.tensor([float(value) for value in values.values()], dtype=torch.float64)
    if ranks.count > 1:
        if dist.get_backend() == "nccl":
            shared = shared.to(torch.device("cuda", ranks.local))
        dist.all_reduce(shared)
        shared /= ranks.count
    return dict(zip(values, shared.tolist(), strict=True))


@contextlib.contextmanager
def process_group(ranks: Ranks, recipe: TrainingRecipe) -> Iterator[None]:
    """Join the process group, unless a launcher (Ray Train) has done so; leave it only after a clean end."""
    if ranks.count == 1 or dist.is_initialized():
        yield
        return
    backend = "nccl" if torch.cuda.is_available() and recipe.device != "cpu" else "gloo"
    dist.init_process_group(backend, timeout=datetime.timedelta(seconds=recipe.timeout))
    yield
    dist.barrier()
    dist.destroy_process_group()


@contextlib.contextmanager
def alone_in(run: Path, ranks: Ranks) -> Iterator[None]:
    """One training a run: rank 0 holds a lock that the operating system drops if the process dies."""
    if ranks.rank != 0:
        yield
        return
    run.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(run / ".lock").acquire(timeout=LOCK_SECONDS):
            yield
    except Timeout as error:
        raise TrainingError(f"another process is training in {run}. Wait for it, or stop it, then run again") from error


def stop_on_sigterm() -> threading.Event:
    """An event that SIGTERM sets, where this thread may install a handler (Ray Train's workers may not)."""
    stop = threading.Event()
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
    return stop
