"""What a person sees while something runs: bars on a terminal, a line now and then elsewhere."""

import shutil
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

from training.tracking.journal import journal_from
from training.tracking.progress import Progress
from training.tracking.system_metrics import sampling
from training.tracking.threads import background

__all__ = ["bar", "following", "sampling"]

Item = TypeVar("Item")
_QUIET_SECONDS = 20.0  # between lines where the output is not a terminal
_BAR_COLUMNS = 24  # of a terminal's width, beside the words about a training


def bar(items: Iterable[Item] | None = None, *, total: int, what: str, unit: str, initial: int = 0) -> "tqdm[Item]":
    """A progress bar with rate and time left."""
    quiet = not sys.stderr.isatty()
    return tqdm(
        items,
        total=total,
        desc=f"{what:9}",
        unit=unit,
        initial=initial,
        mininterval=_QUIET_SECONDS if quiet else 0.2,
        maxinterval=_QUIET_SECONDS if quiet else 10,
        ncols=110 if quiet else None,
        dynamic_ncols=not quiet,
        file=_Lines() if quiet else sys.stderr,
        ascii=quiet,
    )


class _Lines:
    """A stream that turns a bar's redrawing into lines of a log."""

    def write(self, text: str) -> None:
        line = text.strip("\r\n ")
        if line:
            sys.stderr.write(line + "\n")

    def flush(self) -> None:
        sys.stderr.flush()


@contextmanager
def following(journal: Path, *, steps: int, steps_per_epoch: int | None = None) -> Iterator[None]:
    """Show how a training's journal grows while the block runs.

    What the journal holds already is the past: it is shown, but the time left comes from what is added.
    """
    follower = _Follower(journal, Progress(steps=steps, steps_per_epoch=steps_per_epoch), steps)
    with background(follower.run, name="progress"):
        yield


class _Follower:
    def __init__(self, journal: Path, progress: Progress, steps: int) -> None:
        self._journal, self._progress, self._offset = journal, progress, 0
        self._read(past=True)
        self._display = _TerminalBar(steps) if sys.stderr.isatty() else _LogLines()

    def run(self, stop: threading.Event) -> None:
        while True:
            ending = stop.is_set()
            if self._read() or ending:
                self._display.show(self._progress, last=ending)
            if ending:
                return
            stop.wait(0.5)

    def _read(self, *, past: bool = False) -> bool:
        before = self._offset
        for after, row in journal_from(self._journal, before):
            self._progress.add(row, past=past)
            self._offset = after
        return self._offset > before


class _LogLines:
    """A line at intervals, and one at the end; no control characters."""

    def __init__(self) -> None:
        self._said, self._when = "", 0.0

    def show(self, progress: Progress, *, last: bool) -> None:
        line = progress.line()
        if line and line != self._said and (last or time.monotonic() - self._when >= _QUIET_SECONDS):
            print(f"train: {line}", file=sys.stderr, flush=True)
            self._said, self._when = line, time.monotonic()


class _TerminalBar:
    """A bar, and as many of the words beside it as the terminal has room for."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._shown: tqdm[None] | None = None

    def show(self, progress: Progress, *, last: bool) -> None:
        if progress.step is not None:
            self._shown = self._shown or tqdm(
                total=self._steps,
                bar_format="train {percentage:3.0f}%|{bar}| {desc}",
                dynamic_ncols=True,
                file=sys.stderr,
            )
            words = progress.line(width=shutil.get_terminal_size().columns - _BAR_COLUMNS)
            self._shown.set_description_str(words, refresh=False)
            self._shown.n = progress.step
            self._shown.refresh()
        if last and self._shown is not None:
            self._shown.close()
