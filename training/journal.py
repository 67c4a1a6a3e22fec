"""The truth about a run: one JSON object a line, appended by rank 0, read by whoever shows or mirrors it.

Training is a pure function of its recipe, so a resumed run would write the same lines again for the steps since its
checkpoint; the journal drops those, and there are neither gaps nor duplicates.
"""

import errno
import json
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from datagen.errors import StorageError


class Journal:
    """Append-only writer of RUN/metrics.jsonl; a line is with the operating system once ``write`` returns."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        _drop_torn_line(path)
        self._path, self._last = path, max((row["step"] for row in read_journal(path)), default=-1)
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 - open for the whole run

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Append one line; steps that are in the journal already are dropped.

        Raises
        ------
        StorageError
            The disk is full; what was written of the line is dropped when the journal is opened again.
        """
        if step <= self._last:
            return
        line = json.dumps({"step": step, "time": time.time(), **values}).encode() + b"\n"
        try:
            if self._file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise self._unwritten(error) from error
        self._last = step

    def sync(self) -> None:
        """Wait until the disk has every line; before a checkpoint, lest a power failure leaves a gap before it.

        Raises
        ------
        StorageError
            The disk is full or out of order.
        """
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._unwritten(error) from error

    def _unwritten(self, error: OSError) -> StorageError:
        return StorageError(f"could not write {self._path}: {error.strerror}. Run again once there is room")

    @property
    def next_step(self) -> int:
        """The first step that is not in the journal."""
        return self._last + 1

    def close(self) -> None:
        self._file.close()


def read_journal(path: Path) -> list[dict[str, Any]]:
    """All whole lines of a journal; an empty list where there is none."""
    return [row for _, row in journal_from(path, 0)]


def journal_from(path: Path, offset: int) -> Iterator[tuple[int, dict[str, Any]]]:
    """Whole lines from byte ``offset`` on, each with the offset just behind it."""
    if not path.exists():
        return
    with open(path, "rb") as file:
        file.seek(offset)
        for line in file:
            if not line.endswith(b"\n"):
                return
            offset += len(line)
            yield offset, json.loads(line)


def _drop_torn_line(path: Path) -> None:
    if path.exists():
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            with open(path, "r+b") as file:
                file.truncate(whole)


def coefficient_metrics(network: object) -> dict[str, float]:
    """Alpha and beta of every FFAdaIN (the adaptive coefficients) as ``alpha/block1.norm1`` and so on.

    Empty for a network without ``adaptive_coefficients()``. A wrapper such as DistributedDataParallel is looked into.
    """
    inner = getattr(network, "module", network)
    if not hasattr(inner, "adaptive_coefficients"):
        return {}
    named = ((*name.rpartition("."), value) for name, value in inner.adaptive_coefficients().items())
    return {f"{kind}/{place}" if place else kind: float(value) for place, _, kind, value in named}
