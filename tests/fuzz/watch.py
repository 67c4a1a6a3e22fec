"""What a case may do: stay in its folder, start no process, ask no server, and end within bounded time and memory.

Python's audit events show every file that is opened, listed, made, renamed or removed. A forbidden one is noted and
*prevented*, so that a hostile dataset cannot reach this machine while it is being tested with.
"""

import contextlib
import os
import resource
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

WALL_SECONDS, CPU_SECONDS = 20, 15  # of one case, on a busy machine
MEMORY = 150 * 2**20  # bytes that one case may take beside what was taken before it
_ADDRESSES = 3 * 2**30  # bytes that can be allocated at all, lest a case takes the machine
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_ROOT = Path(__file__).parents[2]
_READABLE = tuple(
    os.path.realpath(place) for place in (_ROOT, sys.prefix, sys.base_prefix, "/usr", "/lib", "/proc", "/sys", "/dev")
)
_CHANGES = {
    "os.remove": (0,), "os.rmdir": (0,), "os.mkdir": (0,), "os.truncate": (0,), "os.chmod": (0,), "os.chown": (0,),
    "os.utime": (0,), "os.rename": (0, 1), "os.link": (1,), "os.symlink": (1,), "shutil.rmtree": (0,),
    "os.setxattr": (0,), "os.removexattr": (0,), "sqlite3.connect": (0,),
}  # fmt: skip
"""Audit events that change what is at a path -> which of their arguments are paths."""
_FOLLOWING = ("os.truncate", "os.chmod", "os.chown", "os.utime", "sqlite3.connect")
_DIRECTORY = {"os.remove": 1, "os.rmdir": 1, "os.mkdir": 2, "os.chmod": 2, "os.utime": 3, "shutil.rmtree": 1}
_STARTS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.startfile")
_ASKS = ("socket.connect", "socket.getaddrinfo", "urllib.Request")


class Trespass(BaseException):
    """A case reached for what it must not; not an Exception, so that no reader takes it for damage."""


class OutOfTime(BaseException):
    """A case did not end."""


class Watch:
    """What one case did.

    ``faults`` are in words, one a kind and place; ``seconds`` of CPU; ``bytes`` of memory at its peak.
    """

    def __init__(self, home: Path) -> None:
        self.home = os.path.realpath(home)
        self.faults: list[str] = []
        self.seconds, self.bytes = 0.0, 0

    def see(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Judge one audit event; raise Trespass where it is forbidden."""
        if event == "open":
            path, _, flags = arguments
            if isinstance(path, (str, bytes)):
                self._look(event, _real(path), writes=bool((flags or 0) & _WRITING))
        elif event in ("os.listdir", "os.scandir"):
            if isinstance(arguments[0], (str, bytes)):
                self._look(event, _real(arguments[0]), writes=False)
        elif event in _CHANGES:
            for place in _CHANGES[event]:
                self._look(event, _changed(event, arguments, place), writes=True)
        elif event in _STARTS and not _asks_git(event, arguments):
            self._fault(f"starts a process: {event} {arguments[:2]!r:.100}")
        elif event in _ASKS:
            self._fault(f"asks a server: {event} {arguments[1:]!r:.100}")

    def _look(self, event: str, path: str | None, *, writes: bool) -> None:
        if path is None or _is_within(path, self.home) or path == "/dev/null":
            return
        if writes:
            self._fault(f"changes what is outside: {event} {path}")
        if not any(_is_within(path, place) for place in _READABLE) and not path.endswith("/etc/mime.types"):
            self._fault(f"reads what is outside: {event} {path}")

    def _fault(self, words: str) -> None:
        self.faults.append(words)
        raise Trespass(words)


_watch: Watch | None = None
_is_hooked = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _watch is not None:
        _watch.see(event, arguments)


@contextlib.contextmanager
def watched(home: Path) -> Iterator[Watch]:
    """Watch what happens in the block; only one at a time. OutOfTime is raised in it after WALL_SECONDS."""
    global _watch, _is_hooked  # noqa: PLW0603 - audit hooks can never be removed, so one is there for all
    if not _is_hooked:
        sys.addaudithook(_hook)
        _is_hooked = True
    watch, before, began = Watch(home), _resident("VmRSS"), time.process_time()
    with _limited(), _alarm():
        _watch = watch
        try:
            yield watch
        finally:
            _watch = None
            watch.seconds = time.process_time() - began
            watch.bytes = max(0, _resident("VmHWM") - before)


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_resident("VmSize") + _ADDRESSES, hard))
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the peak of resident memory is counted anew
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextlib.contextmanager
def _alarm() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise OutOfTime(f"no end after {WALL_SECONDS} s")

    before: Any = signal.signal(signal.SIGALRM, ring)
    timer = signal.setitimer(signal.ITIMER_REAL, WALL_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, *timer)
        signal.signal(signal.SIGALRM, before)


def _resident(what: str) -> int:
    """A line of /proc/self/status, in bytes."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith(f"{what}:"))


def _real(path: str | bytes | os.PathLike[str]) -> str:
    return os.path.realpath(os.fsdecode(path))


def _changed(event: str, arguments: tuple[Any, ...], place: int) -> str | None:
    """The path that an event changes: a link itself, not what it leads to, unless the event follows links."""
    path = arguments[place]
    if not isinstance(path, (str, bytes, os.PathLike)):
        return None
    folder: Any = arguments[_DIRECTORY[event]] if event in _DIRECTORY and len(arguments) > _DIRECTORY[event] else -1
    start = os.readlink(f"/proc/self/fd/{folder}") if isinstance(folder, int) and folder >= 0 else ""
    whole = os.path.join(start, os.fsdecode(path))
    if event in _FOLLOWING:
        return _real(whole)
    return os.path.join(_real(os.path.dirname(whole) or "."), os.path.basename(whole))


def _is_within(path: str, folder: str) -> bool:
    return path == folder or path.startswith(f"{folder}/")


def _asks_git(event: str, arguments: tuple[Any, ...]) -> bool:
    """Which commit this is, which provenance notes."""
    return (
        event == "subprocess.Popen" and list(arguments[1])[:1] == ["git"] and list(arguments[1])[3:4] == ["rev-parse"]
    )


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Modes and contents of all below a folder, to see whether anything changed it, by whatever way."""
    found = {}
    for path in sorted(folder.rglob("*")):
        content = os.readlink(path).encode() if path.is_symlink() else path.read_bytes() if path.is_file() else b""
        found[str(path.relative_to(folder))] = path.lstat().st_mode, content
    return found
