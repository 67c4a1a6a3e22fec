"""What a person sees while something runs: bars on a terminal, a line now and then elsewhere; and system metrics."""

import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import psutil
from tqdm import tqdm

from training.journal import Journal, journal_from

Item = TypeVar("Item")
_QUIET_SECONDS = 20.0  # between lines where the output is not a terminal


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
def following(journal: Path, *, steps: int, system: Path) -> Iterator[None]:
    """Show a training's journal as a bar while the block runs, and sample the machine's load into ``system``."""
    stop = threading.Event()
    threads = [
        threading.Thread(target=_follow, args=(journal, steps, stop), daemon=True),
        threading.Thread(target=_sample, args=(system, stop), daemon=True),
    ]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


@contextmanager
def sampling(system: Path) -> Iterator[None]:
    """Sample the machine's load into ``system`` while the block runs."""
    stop = threading.Event()
    thread = threading.Thread(target=_sample, args=(system, stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _follow(journal: Path, steps: int, stop: threading.Event) -> None:
    offset, shown = 0, None
    latest: dict[str, Any] = {}
    while True:
        ending = stop.is_set()
        for behind, row in journal_from(journal, offset):
            offset, latest = behind, latest | row
        if latest:
            shown = shown or bar(total=steps, what="train", unit="step", initial=latest["step"])
            shown.set_postfix_str(_summary(latest), refresh=False)
            shown.update(latest["step"] - shown.n)
        if ending:
            break
        stop.wait(0.5)
    if shown is not None:
        shown.close()


def _summary(row: dict[str, Any]) -> str:
    parts = [f"loss {row['loss/total']:.4f}", f"{row['meshes_per_second']:.0f} meshes/s"]
    if "evaluation/pmd_unseen" in row:
        parts.insert(1, f"PMD unseen {row['evaluation/pmd_unseen'] * 1e4:.1f}e-4")
    return ", ".join(parts)


def _sample(path: Path, stop: threading.Event, every: float = 5.0) -> None:
    """Load of this machine under the names that MLflow gives to system metrics, so that its UI shows them as such."""
    journal = Journal(path)
    step, disk, network = journal.next_step, psutil.disk_io_counters(), psutil.net_io_counters()
    psutil.cpu_percent()
    while not stop.wait(every):
        memory = psutil.virtual_memory()
        values = {
            "system/cpu_utilization_percentage": psutil.cpu_percent(),
            "system/system_memory_usage_megabytes": memory.used / 1e6,
            "system/system_memory_usage_percentage": memory.percent,
            "system/disk_usage_percentage": psutil.disk_usage(str(path.parent)).percent,
        }
        if disk and network:
            now = psutil.disk_io_counters(), psutil.net_io_counters()
            values["system/disk_write_megabytes"] = (now[0].write_bytes - disk.write_bytes) / 1e6
            values["system/network_transmit_megabytes"] = (now[1].bytes_sent - network.bytes_sent) / 1e6
        journal.write(step, values)
        step += 1
    journal.close()
