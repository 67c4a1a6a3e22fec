"""Generation at breadth: many identities in few poses against few identities in many poses, by the command itself.

    python -m benchmarks.datagen.breadth [identities ...] [--anny] [--ray] [--folder FOLDER]

For each number of identities (2,000 by default) legs, or Anny's bodies of 369 vertices, are made in 10 poses, then
100 identities in as many poses as give the same number of meshes. Every step is a process of its own (``dsffnet
generate``, ``verify``, ``inspect``, ``append``), of which is measured: CPU seconds of it and of all that it starts,
its own peak memory, and the time to the first line of progress. A dataset that is half made when its process is
killed shows what resuming takes.
"""

import argparse
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from datagen.store import open_dataset

POSES, FEW, APPENDED, OPENED = 10, 100, 1000, 5
_LOOK_SECONDS = 0.5


@dataclass
class Step:
    """What a command took: CPU seconds and wall seconds of all its processes, the peak of its own in MiB, and seconds
    to the first line of its progress (0 where it shows none).
    """

    cpu: float = 0.0
    wall: float = 0.0
    peak: float = 0.0
    progress: float = 0.0
    killed: bool = False
    said: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        first = f", first progress after {self.progress:.1f} s" if self.progress else ""
        return f"{self.cpu:8.1f} s CPU {self.wall:8.1f} s wall {self.peak:7.0f} MiB{first}"


def dsffnet(*arguments: str, until: Callable[[], bool] = lambda: False) -> Step:
    """Run a command, and kill it once ``until`` holds."""
    step, began, before = Step(), time.perf_counter(), _reaped()
    process = psutil.Popen([sys.executable, "-m", "workflows", *arguments], stdout=subprocess.DEVNULL,
                           stderr=subprocess.PIPE, text=True)  # fmt: skip
    reading = threading.Thread(target=_read, args=(process.stderr, step, began))
    reading.start()
    spent: dict[int, float] = {}
    while process.poll() is None:
        _look(process, step, spent)
        if until():
            step.killed = True
            for each in [process, *process.children(recursive=True)]:
                with suppress(psutil.NoSuchProcess):
                    each.send_signal(signal.SIGKILL)
        time.sleep(_LOOK_SECONDS)
    reading.join()
    step.cpu, step.wall = max(sum(spent.values()), _reaped() - before), time.perf_counter() - began
    if process.returncode and not step.killed:
        raise SystemExit("\n".join([f"dsffnet {' '.join(arguments)} failed", *step.said[-5:]]))
    return step


def _reaped() -> float:
    """CPU seconds of processes that have ended and were this one's; Ray's servers are nobody's, so only looked at."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def _read(lines: Sequence[str], step: Step, began: float) -> None:
    for line in lines:
        step.said.append(line.rstrip())
        if "%|" in line and not step.progress:
            step.progress = time.perf_counter() - began


def _look(process: psutil.Process, step: Step, spent: dict[int, float]) -> None:
    """Note the CPU time of every process of a command, and the peak memory of the first."""
    with suppress(psutil.Error, OSError, StopIteration):
        status = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8").splitlines()
        step.peak = next(float(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1024
        for each in [process, *process.children(recursive=True)]:
            with suppress(psutil.Error):
                times = each.cpu_times()
                spent[each.pid] = times.user + times.system


BODIES: dict[str, tuple[str, dict[str, int | str]]] = {
    "leg": ("smoke", {"body.rings": 24, "body.segments": 12}),
    "anny": ("quickstart", {"body.topology": "notoes_collapse3pc"}),
}
"""A recipe by the family of its bodies, and what is set of them."""


@dataclass(frozen=True)
class Making:
    """How datasets are made."""

    body: str
    where: tuple[str, ...]

    def command(self, url: Path, identities: int, poses: int) -> list[str]:
        """``dsffnet generate`` of bodies in a grid of training identities and seen poses."""
        recipe, of_body = BODIES[self.body]
        sizes = {"identities.training": identities, "identities.evaluation": 0, "poses.seen": poses, "poses.unseen": 0,
                 "store.poses_per_shard": 100, **of_body}  # fmt: skip
        settings = (f"data.{key}={value}" for key, value in sizes.items())
        return ["generate", "--recipe", recipe, "--out", str(url), *self.where, "--set", *settings]


def shards_in(url: Path) -> int:
    """How many shards there are."""
    return sum(1 for _ in url.glob("grid/*/*/vertices/c/*/*/0/0"))


def opening(url: Path) -> float:
    """Median milliseconds of opening."""
    taken = []
    for _ in range(OPENED):
        began = time.perf_counter()
        open_dataset(str(url))
        taken.append(1e3 * (time.perf_counter() - began))
    return statistics.median(taken)


def generate(url: Path, identities: int, poses: int, making: Making) -> Step:
    """Make a dataset and report it."""
    step = dsffnet(*making.command(url, identities, poses))
    objects = sum(path.is_file() for path in url.rglob("*"))
    print(f"generate {identities:7,} x {poses:6,}: {step}; {identities * poses / step.cpu:,.0f} meshes a CPU second; "
          f"opened in {opening(url):.0f} ms; {objects:,} objects, {shards_in(url):,} shards", flush=True)  # fmt: skip
    return step


def resume(url: Path, identities: int, making: Making, shards: int) -> None:
    """Kill a generation half way and report how long the same command takes until it makes the first shard."""
    made = making.command(url, identities, POSES)
    killed = dsffnet(*made, until=lambda: shards_in(url) >= shards // 2)
    half = shards_in(url)
    step = dsffnet(*made, until=lambda: shards_in(url) > half)
    print(f"resume at {half:,} of {shards:,} shards: {step} to the next shard (killed after {killed.cpu:.1f} s CPU)",
          flush=True)  # fmt: skip


def measure(identities: int, folder: Path, making: Making) -> None:
    """Measure and print everything of one number of identities."""
    broad, deep, small, half = (folder / f"{name}.zarr" for name in ("broad", "deep", "small", "half"))
    step = generate(broad, identities, POSES, making)
    shards = shards_in(broad)
    other = generate(deep, FEW, identities * POSES // FEW, making)
    print(f"  many identities: {other.cpu / step.cpu:.2f} of the meshes a CPU second of few", flush=True)
    shutil.rmtree(deep)
    for command in ("verify", "inspect"):
        print(f"{command:24}: {dsffnet(command, str(broad))}", flush=True)
    alone = generate(small, APPENDED, POSES, making)
    grown = dsffnet("append", str(broad), "--training-identities", str(identities + APPENDED), *making.where)
    print(f"append {APPENDED:,} to {identities:,}: {grown}; {grown.cpu / alone.cpu:.2f} of these alone", flush=True)
    shutil.rmtree(broad)
    resume(half, identities, making, shards)


def main() -> None:
    """Measure each number of identities."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("identities", type=int, nargs="*", default=[2000])
    made.add_argument("--anny", action="store_true", help="bodies of 369 vertices in the place of legs")
    made.add_argument("--ray", action="store_true", help="on Ray where meshes are many, and not in one process")
    made.add_argument("--folder", type=Path, help="where datasets go meanwhile (default: the system's)")
    options = made.parse_args()
    making = Making("anny" if options.anny else "leg", () if options.ray else ("--local",))
    for identities in options.identities:
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            measure(identities, Path(folder), making)


if __name__ == "__main__":
    main()
