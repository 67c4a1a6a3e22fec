"""A Ray of our own on this machine: started with patience, watched while it works, ended with everything it started."""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

from datagen.common.errors import ClusterError, first_line_of
from training.tracking.record import fail_begun
from training.tracking.threads import background

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGE = f"-packages{os.sep}ray{os.sep}"  # where Ray's own programs lie, in any environment
_OBJECT_STORE = 300 * 2**20  # manifest rows and metrics are all that passes through it; Ray's default is 30 % of memory
_START_SECONDS = (30.0, 150.0)  # Ray's own patience with its node, and ours after that
_SERVERS = ("gcs_server", "raylet")
_LOOK_SECONDS, _RECORD_SECONDS, _LEAVE_SECONDS = 0.5, 2.0, 20.0
_RESUME = "What was complete is kept: run the same command again to resume"
_ENDED = f"this process has been ended in the middle (killed, or by Ray's client library). {_RESUME}"
WITHOUT_RAY = "--local, where the command has it (dsffnet train: --set training.launcher=inline training.ranks=1)"


def _start() -> None:
    """Start Ray here; where that fails, as on a busy machine, once more and with more patience.

    Raises
    ------
    ClusterError
        It failed twice.
    """
    for seconds in _START_SECONDS:
        try:
            with _patience(seconds):
                _init()
            return
        except BaseException as error:
            _leave()
            if not isinstance(error, Exception):  # interrupted, or told to stop
                raise
            reason = first_line_of(error)
            if seconds != _START_SECONDS[-1]:
                print(f"Ray did not start ({reason}); once more, with more time", file=sys.stderr, flush=True)
    raise ClusterError(
        f"Ray did not start on this machine, tried twice ({reason}). If the machine is busy, run the same command "
        f"again later; or work in this process, without Ray: {WITHOUT_RAY}"
    )


def _init() -> None:
    import ray

    with sigterm_kept():
        ray.init(
            address="local",
            include_dashboard=False,
            object_store_memory=_OBJECT_STORE,
            logging_level=logging.ERROR,
            log_to_driver=False,  # errors of tasks and ranks reach the driver anyway; logs: /tmp/ray/session_latest
            runtime_env={"env_vars": {"PYTHONPATH": f"{_ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}},
        )


@contextmanager
def sigterm_kept() -> Iterator[None]:
    """Have SIGTERM keep its meaning while Ray connects and after: ``ray.init`` has the signal end the process without
    a word, and Ray's C++ part puts a handler before that one which prints where the process stood.
    """
    from ray._private import utils

    set_handler, before = utils.set_sigterm_handler, signal.getsignal(signal.SIGTERM)
    utils.set_sigterm_handler = lambda _: None
    try:
        yield
    finally:
        utils.set_sigterm_handler = set_handler
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before or signal.SIG_DFL)  # None: a handler that is not Python's


@contextmanager
def _patience(seconds: float) -> Iterator[None]:
    """Have Ray wait so long for its store (a setting), and for its node: the latter's 30 s are a constant of its code,
    which asks ``get_node`` until that answers.
    """
    from ray._private import services

    os.environ["RAY_gcs_server_port_wait_time_s"] = f"{seconds:.0f}"  # noqa: SIM112  (the name that Ray reads)

    ask: Callable[..., Any] = services.get_node
    until = time.monotonic() + seconds

    def get_node(*arguments: Any) -> Any:
        while True:
            try:
                return ask(*arguments)
            except RuntimeError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.5)

    services.get_node = get_node
    try:
        yield
    finally:
        services.get_node = ask


def _leave() -> None:
    """Disconnect, then end the servers: Ray's client library aborts a process that is connected when they go."""
    import ray

    with suppress(Exception):
        ray.shutdown()
    _end_processes()


def _end_processes() -> None:
    """Kill what is left of a Ray that this process started: its servers, and by them its agents and workers."""
    _kill(_family())


def _family() -> list[psutil.Process]:
    return [child for child in psutil.Process().children(recursive=True) if _is_rays(child)]


def _kill(processes: list[psutil.Process]) -> None:
    """Kill those that still run, and wait for them alone: the number of one that has ended long ago may be a thread's
    now, which Linux cannot wait for (ENOENT from 6.16 on).
    """
    killed = list[psutil.Process]()
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.kill()
            killed.append(process)
    psutil.wait_procs(killed, timeout=5)


def _is_rays(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        words = process.cmdline()
        return process.name() in _SERVERS or any(_PACKAGE in word or word.startswith("ray::") for word in words)
    return False


@contextmanager
def own_ray() -> Iterator[None]:
    """A Ray of this process, ended with the block. When one of its servers dies, so does the block: Ray itself would
    wait for a minute and then end the process without a word.

    Raises
    ------
    ClusterError
        It did not start, or a server died.
    """
    import ray

    _start()
    watch = _Watch()
    try:
        watch.find()
        with watch.words, _interrupted_by(watch):
            try:
                yield
            finally:
                watch.over = True
                ray.shutdown()
    except BaseException as error:
        if not watch.lost:
            raise
        raise ClusterError(watch.message) from error
    finally:
        watch.end_kin()
        _end_processes()


@contextmanager
def _interrupted_by(watch: "_Watch") -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # which alone can be interrupted
        yield
        return
    before = signal.signal(signal.SIGUSR1, _interrupt)
    try:
        with background(watch.run, name="ray-watch"):
            yield
    finally:
        signal.signal(signal.SIGUSR1, before or signal.SIG_DFL)


def _interrupt(*_: object) -> None:
    """As Ctrl-C does: Ray's calls would turn any other exception into that one."""
    raise KeyboardInterrupt


class _LastWords:
    """A process beside that prints an error, should this one be ended before it leaves the block: Ray's client library
    ends its process by a check of its own when a server dies at the wrong moment, the kernel where memory is short.
    """

    _SCRIPT = 'while read -r line; do last=$line; done; [ -z "$last" ] || echo "$last" >&2'

    def __enter__(self) -> None:
        self._beside = subprocess.Popen(["sh", "-c", self._SCRIPT], stdin=subprocess.PIPE, encoding="utf-8")
        self.be(f"error: {_ENDED}")

    def be(self, line: str) -> None:
        assert self._beside.stdin is not None
        with suppress(BrokenPipeError):  # Ctrl-C, which goes to all, has ended it
            print(line, file=self._beside.stdin, flush=True)

    def __exit__(self, *_: object) -> None:
        self.be("")
        self._beside.communicate()


class _Watch:
    """Looks after the servers of the Ray that this process has started."""

    def __init__(self) -> None:
        self.words = _LastWords()
        self._kin: list[psutil.Process] = []
        self._servers: dict[str, psutil.Process] = {}
        self.lost = ""
        self.over = False

    def find(self) -> None:
        """Look for what has been started."""
        self._kin = _family()
        for child in self._kin:
            with suppress(psutil.Error):  # it has ended by now
                if child.name() in _SERVERS:
                    self._servers[child.name()] = child

    @property
    def message(self) -> str:
        return f"Ray's {self.lost} has died (killed, or out of memory). {_RESUME}"

    def run(self, stop: threading.Event) -> None:
        while not stop.wait(_LOOK_SECONDS):
            dead = next((name for name, server in self._servers.items() if not _alive(server)), "")
            if self.over:
                return
            if dead:
                self.lost = dead
                self._end_block(stop)
                return

    def _end_block(self, stop: threading.Event) -> None:
        """Interrupt the block; end the process where that is not heeded: a call to a dead server may wait for ever.

        What is left of Ray lives until then: its client library ends the process at once when the raylet goes.
        """
        failing = threading.Thread(target=fail_begun, daemon=True)
        failing.start()
        self._kin += _family()  # of now: children of a parent that dies are nobody's
        failing.join(_RECORD_SECONDS)  # a disk may hang
        self.words.be(f"error: {self.message}")
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, signal.SIGUSR1)
        if not stop.wait(_LEAVE_SECONDS):
            self.end_kin()
            os._exit(ClusterError.exit_status)

    def end_kin(self) -> None:
        """Kill all that belonged to this Ray."""
        _kill(self._kin)


def _alive(process: psutil.Process) -> bool:
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
