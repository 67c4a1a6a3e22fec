"""The processes that train together: who is who, agreeing, averaging, joining, stopping."""

import contextlib
import datetime
import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
import torch.distributed as dist
from filelock import Timeout
from torch import Tensor

from datagen.common.errors import StorageError, TrainingError
from datagen.common.files import lock_within
from training.recipes.training import TrainingRecipe

_Answer = TypeVar("_Answer")
STOP_FILE = "stop"
LOCK_SECONDS = float(
    os.environ.get("DSFFNET_LOCK_SECONDS", "30")
)  # how long to wait for the ranks of a killed driver to be gone


@dataclass(frozen=True)
class Ranks:
    """Where this process stands among those that train together."""

    rank: int
    count: int
    local: int
    here: int = 1

    @classmethod
    def from_environment(cls) -> "Ranks":
        """As torchrun and Ray Train say it; one process alone where they do not. ``here``: ranks of this machine."""
        rank, count, local = (
            int(os.environ.get(name, default))
            for name, default in (("RANK", "0"), ("WORLD_SIZE", "1"), ("LOCAL_RANK", "0"))
        )
        return cls(rank, count, local, int(os.environ.get("LOCAL_WORLD_SIZE", count)))


def device_of(recipe: TrainingRecipe, ranks: Ranks) -> torch.device:
    """The device of this rank; TrainingError if the recipe wants CUDA and there is none."""
    if recipe.device == "cpu" or (recipe.device == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise TrainingError("training.device is 'cuda', but torch sees no CUDA device. Set training.device=cpu")
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
    """Means over the ranks of what each has; of losses these are the means over the batch.

    A rank whose share of the batch is larger or smaller than the mean has weighted its losses by it before (``share``
    of :meth:`training.engine.train_step.Learner.step`). The gradient norm and the learning rate are the same
    everywhere.
    """
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
    gc.collect()  # a model in a cycle of references would hold the group beyond its end
    dist.barrier()
    dist.destroy_process_group()


def is_of_the_group(error: BaseException) -> bool:
    """Whether an error is the process group's: of Gloo, of NCCL, or of the store where the ranks meet."""
    return isinstance(error, dist.DistError) or (isinstance(error, RuntimeError) and "gloo/" in str(error).lower())


@contextlib.contextmanager
def alone_in(run: Path, ranks: Ranks) -> Iterator[None]:
    """One training a run: rank 0 holds a lock that the operating system drops if the process dies.

    Raises
    ------
    TrainingError
        On every rank, if another process has it.
    """
    lock = lock_within(run, ".lock")

    def acquire() -> None:
        run.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=LOCK_SECONDS)
        except Timeout as error:
            raise TrainingError(
                f"another process is training in {run}. Wait for it, or stop it, then run again"
            ) from error

    decided_by_first(ranks, acquire)
    try:
        yield
    finally:
        lock.release()


def agreed(ranks: Ranks, do: Callable[[], _Answer], *, what: str) -> _Answer:
    """The answer of ``do``, which must talk to no other rank; where it fails on one rank, every rank raises.

    Parameters
    ----------
    what
        What is done, in words, for the ranks that did not fail.
    """
    answer: Any = None
    failure: Exception | None = None
    try:
        answer = do()
    except Exception as error:  # whatever it is, the others must not wait in their next exchange
        failure = _as_storage_error(error)
    if any_rank([failure is not None], ranks)[0]:
        raise failure or TrainingError(f"another rank could not {what}; see what it says", secondary=True)
    return cast(_Answer, answer)


def gathered(value: _Answer, ranks: Ranks) -> list[_Answer]:
    """The values of all ranks, in their order."""
    if ranks.count == 1:
        return [value]
    values: list[Any] = [None] * ranks.count
    dist.all_gather_object(values, value)
    return values


def _as_storage_error(error: Exception) -> Exception:
    """An error of the file system as one of storage; any other as it is."""
    if not isinstance(error, OSError):
        return error
    failure = StorageError(
        f"{error.filename or 'a file of the run'}: {error.strerror or error}. Repair it and run again"
    )
    failure.__cause__ = error
    return failure


def decided_by_first(ranks: Ranks, decide: Callable[[], _Answer]) -> _Answer:
    """What rank 0 decides, on every rank; where it cannot, every rank raises."""
    answer: list[Any] = [None, None]
    failure: Exception | None = None
    if ranks.rank == 0:
        try:
            answer[0] = decide()
        except Exception as error:  # whatever it is, the others must not wait for an answer
            failure = _as_storage_error(error)
            answer[1] = str(failure)
    if ranks.count > 1:
        dist.broadcast_object_list(answer, src=0)
    if failure:
        raise failure
    if answer[1] is not None:
        raise TrainingError(answer[1], secondary=True)
    return answer[0]


def forget_old_stop(run: Path, ranks: Ranks, *, before: float) -> None:
    """Rank 0 removes a RUN/stop that is older than this training, or than a clock that was put back.

    ``before`` is in seconds since the epoch.

    Not for a launcher that keeps the file itself: there it may be meant for ranks that were not up yet.
    """

    def remove() -> None:
        with contextlib.suppress(FileNotFoundError):
            if not before <= (run / STOP_FILE).stat().st_mtime <= time.time():
                (run / STOP_FILE).unlink()

    decided_by_first(ranks, remove)


@contextlib.contextmanager
def on_sigterm(told: Callable[[], object]) -> Iterator[None]:
    """Call ``told`` at SIGTERM while the block runs; in a thread, which cannot handle signals, change nothing."""
    if threading.current_thread() is not threading.main_thread():  # Ray Train runs ranks in one
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda *_: told())
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class StopRequest:
    """Whether this training was told to stop: by SIGTERM to this process, or by the file RUN/stop (for Ray's ranks)."""

    def __init__(self, run: Path) -> None:
        self._file, self._signalled, self._looked = run / STOP_FILE, threading.Event(), 0.0
        self._heeding = on_sigterm(self._signalled.set)

    def __enter__(self) -> "StopRequest":
        self._heeding.__enter__()
        return self

    def __exit__(self, *reason: Any) -> None:
        self._heeding.__exit__(*reason)

    def made(self) -> bool:
        """Whether to stop after this step; looks for the file once a second."""
        if time.monotonic() - self._looked > 1.0:
            self._looked = time.monotonic()
            if self._file.exists():
                self._signalled.set()
        return self._signalled.is_set()


def random_state() -> dict[str, Tensor]:
    """Return torch's random states of this process: CPU, and CUDA where it is in use."""
    state = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def restore_random_state(states: Sequence[Mapping[str, Tensor]], rank: int) -> None:
    """Give this rank the random state it had; a rank that was not there keeps the one that it was seeded with."""
    if rank < len(states):
        torch.set_rng_state(states[rank]["cpu"])
        if "cuda" in states[rank] and torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
            torch.cuda.set_rng_state(states[rank]["cuda"])
