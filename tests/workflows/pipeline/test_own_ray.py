"""The end of a Ray of our own."""

import subprocess
import sys

import psutil
import pytest

from workflows.pipeline import own_ray


def sleeping() -> psutil.Process:
    return psutil.Popen([sys.executable, "-c", "import time; time.sleep(60)"], stdin=subprocess.DEVNULL)


def test_what_ended_long_ago_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its number may be a thread's by then, of which Linux 6.16 and later have no pidfd: psutil raises as it is."""
    ended, alive = sleeping(), sleeping()
    known = psutil.Process(ended.pid)
    ended.kill()
    ended.wait()

    def no_pidfd(timeout: float | None = None) -> int:
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr(known, "wait", no_pidfd)
    own_ray._kill([known, psutil.Process(alive.pid)])
    assert not psutil.pid_exists(alive.pid) or psutil.Process(alive.pid).status() == psutil.STATUS_ZOMBIE
    alive.wait()
