"""The truth about a run: one JSON object a line, appended by rank 0, read by whoever shows or mirrors it.

Training is a pure function of its recipe, so a resumed run would write the same lines again for the steps since its
checkpoint; the journal drops those, and there are neither gaps nor duplicates.
"""

import errno
import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, Strict, TypeAdapter, ValidationError

from datagen.common.errors import storage_errors
from datagen.common.files import open_regular, resolve_within, warn_once

_Whole = Annotated[int, Field(strict=True, gt=-(2**63), lt=2**63)]
_ROW: TypeAdapter[dict[str, Any]] = TypeAdapter(dict[str, _Whole | Annotated[float, Strict()]])
_MOST_STEPS, _LAST_SECOND = 2**53, 253_402_300_800  # the year 9999
_LONGEST_LINE = 2**20  # bytes


class Journal:
    """Append-only writer of RUN/metrics.jsonl; a line is with the operating system once ``write`` returns."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        resolve_within(path.parent, path.name)  # a link to what is not there yet, too
        _drop_torn_line(path)
        self._path, self._last = path, max((row["step"] for _, row in journal_from(path, 0)), default=-1)
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
        with self._writing():
            if self._file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._last = step

    def sync(self) -> None:
        """Wait until the disk has every line; before a checkpoint, lest a power failure leaves a gap before it.

        Raises
        ------
        StorageError
            The disk is full or out of order.
        """
        with self._writing():
            os.fsync(self._file.fileno())

    def _writing(self) -> AbstractContextManager[None]:
        return storage_errors(self._path, advice="Run again once there is room")

    @property
    def next_step(self) -> int:
        """The first step that is not in the journal."""
        return self._last + 1

    def close(self) -> None:
        self._file.close()


def read_journal(path: Path) -> list[dict[str, Any]]:
    """All whole lines of a journal; an empty list where there is none.

    Raises
    ------
    UnsafeFileError
        It leads out of its folder, or is not a regular file.
    """
    return [row for _, row in journal_from(path, 0)]


def journal_from(path: Path, offset: int) -> Iterator[tuple[int, dict[str, Any]]]:
    """Whole lines from byte ``offset`` on, each with the offset just after it; garbage is left out, with a warning.

    Raises
    ------
    UnsafeFileError
        It leads out of its folder, or is not a regular file.
    """
    if not path.exists():
        return
    with open_regular(resolve_within(path.parent, path.name)) as file:
        file.seek(offset)
        while (line := file.readline(_LONGEST_LINE)).endswith(b"\n"):
            offset += len(line)
            row = _row(line)
            if row is not None:
                yield offset, row
            else:
                warn_once(f"{path} holds lines that are no rows of a journal; they are left out")
        if len(line) == _LONGEST_LINE:
            warn_once(f"{path} is no journal from byte {offset:,} on, which is left out")


def _row(line: bytes) -> dict[str, Any] | None:
    """Return a line's row: numbers by name, among them ``step`` and, where it was noted, ``time``."""
    try:
        row = _ROW.validate_json(line)
    except ValidationError:
        return None
    is_dated = 0 <= row.get("time", 0) < _LAST_SECOND
    return row if isinstance(row.get("step"), int) and 0 <= row["step"] < _MOST_STEPS and is_dated else None


def _drop_torn_line(path: Path) -> None:
    """Cut off what is after the last line's end."""
    if not path.exists():
        return
    with open_regular(resolve_within(path.parent, path.name)) as file:
        whole = 0
        while (line := file.readline(_LONGEST_LINE)).endswith(b"\n"):
            whole += len(line)
        size = file.seek(0, os.SEEK_END)
    if whole < size:
        os.truncate(path, whole)


def coefficient_metrics(network: object) -> dict[str, float]:
    """Alpha and beta of every FFAdaIN (the adaptive coefficients) as ``modulation/alpha/block1.norm1`` and so on.

    Charts of MLflow stand in the order of these names: evaluation, loss, modulation.

    Empty for a network without ``adaptive_coefficients()``. A wrapper such as DistributedDataParallel is looked into.
    """
    inner = getattr(network, "module", network)
    if not hasattr(inner, "adaptive_coefficients"):
        return {}
    named = ((*name.rpartition("."), value) for name, value in inner.adaptive_coefficients().items())
    return {"/".join(filter(None, ("modulation", kind, place))): float(value) for place, _, kind, value in named}
