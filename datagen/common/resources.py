"""What this machine has left: memory (of its container, if it runs in one) and disk; and errors that say it ran out."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from datagen.common.errors import OutOfMemory, reason_of

_CGROUP = Path("/sys/fs/cgroup")
_UNITS = (("EB", 1e18), ("PB", 1e15), ("TB", 1e12), ("GB", 1e9), ("MB", 1e6))
_WORDS = ("can't allocate memory", "not enough memory", "out of memory", "CUBLAS_STATUS_ALLOC_FAILED")
"""What torch's RuntimeErrors say of it, in lower case but for the last."""


def bytes_text(size: float) -> str:
    """Return a number of bytes as a person reads it."""
    if size == float("inf"):
        return "more than any number of bytes"
    for unit, factor in _UNITS:
        if size >= factor:
            return f"{size / factor:,.1f} {unit}"
    return f"{size / 1e3:,.1f} kB"


def free_memory() -> int:
    """Return the bytes of memory that are free on this machine, or within the limit of its container."""
    return min(int(psutil.virtual_memory().available), container_memory())


def container_memory(cgroup: Path = _CGROUP) -> int:
    """Bytes left within a container's limit (Linux, cgroup v2); files that it has read can be dropped, so are free."""
    try:
        limit, used = (int((cgroup / name).read_text(encoding="utf-8")) for name in ("memory.max", "memory.current"))
        stated = (cgroup / "memory.stat").read_text(encoding="utf-8")
        lines = (line.split() for line in stated.splitlines())
        droppable = sum(int(value) for name, value in lines if name in ("active_file", "inactive_file"))
    except (OSError, ValueError):  # no such file, or the limit is: max
        return 2**63
    return max(0, limit - used + droppable)


def free_disk(folder: Path) -> int:
    """Return the bytes that are free on the disk on which a folder lies or will lie."""
    whole = Path(os.path.realpath(folder))
    there = next(place for place in (whole, *whole.parents) if os.path.exists(place))  # Path's raises if not permitted
    return shutil.disk_usage(there).free


def ran_out_of_memory(error: BaseException) -> bool:
    """Return whether an error says that memory ran out: Python's and NumPy's MemoryError, torch's of either device."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and any(word in str(error) for word in _WORDS)


@contextmanager
def memory_errors(advice: str) -> Iterator[None]:
    """While the block runs, turn errors that say that memory ran out into one that says what to lower.

    Raises
    ------
    OutOfMemory
        It did; the message ends with ``advice``.
    """
    try:
        yield
    except Exception as error:
        if not ran_out_of_memory(error):
            raise
        raise OutOfMemory(f"memory ran out ({reason_of(error)}). {advice}") from error
