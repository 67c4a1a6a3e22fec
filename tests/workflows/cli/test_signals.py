"""What a command does when it is told to stop while Ray works for it."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from workflows.pipeline.console import guarded

ROOT = Path(__file__).parents[3]
WAITING = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a suite started in the background has Ctrl-C ignored
from workflows.pipeline.console import guarded
from workflows.pipeline.ray_cluster import ray_cluster

def main():
    import ray, time
    with ray_cluster():
        @ray.remote
        def work():
            time.sleep(300)
        for said in ("at work", "interrupted"):
            try:
                print(said, flush=True)
                ray.wait([work.remote()])
            except KeyboardInterrupt:
                if said == "interrupted":
                    raise

guarded(main)
"""


def test_a_command_that_waits_for_ray_hears_signals_and_is_stopped_with_its_own_status() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout and process.stdout.readline() == "at work\n"
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline() == "interrupted\n"
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 143, said
    assert said.splitlines()[-1].endswith("run the same command again to resume")


STARTING = """
import os, signal, time
import ray
from workflows.pipeline.console import guarded
from workflows.pipeline.ray_cluster import ray_cluster
connect = ray.init

def connecting(*arguments, **named):
    connect(*arguments, **named)
    os.kill(os.getpid(), signal.SIGTERM)

def main():
    ray.init = connecting
    try:
        with ray_cluster():
            pass
    finally:
        time.sleep(4)  # as closing may take; Ray's own handler would abort after three seconds

guarded(main)
"""


def test_a_command_that_is_told_to_stop_while_ray_starts_says_so() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", STARTING], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert ended.returncode == 143, ended.stderr
    assert ended.stderr.splitlines()[-1] == "stopped; run the same command again to resume"


@pytest.mark.parametrize(
    ("told", "status", "words"),
    [(signal.SIGHUP, 129, "stopped"), (signal.SIGTERM, 143, "stopped"), (signal.SIGINT, 130, "interrupted")],
)
def test_a_closed_terminal_ends_a_command_as_the_other_signals_do(
    told: signal.Signals, status: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = (signal.SIGHUP, signal.SIGTERM, signal.SIGINT)
    before = {number: signal.getsignal(number) for number in numbers}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as ended:
            guarded(lambda: os.kill(os.getpid(), told))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert ended.value.code == status
    assert capsys.readouterr().err == f"{words}; run the same command again to resume\n"


def test_what_fails_as_all_are_told_to_stop_ends_with_the_status_of_the_signal() -> None:
    """As Ray's processes do where a signal goes to the whole group."""
    code = """
import os, signal
from datagen.common.errors import ClusterError
from workflows.pipeline.console import guarded

def main():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    finally:
        raise ClusterError("Ray's raylet has died")

guarded(main)
"""
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (143, "stopped; Ray's raylet has died\n")


@pytest.mark.parametrize("words", [["--help"], ["recipe"]])
def test_a_pipe_that_is_read_no_more_ends_a_command_without_a_word(words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command, buffered = [sys.executable, "-m", "workflows", *words], {**os.environ, "PYTHONUNBUFFERED": ""}
    ended = subprocess.run(
        command, cwd=ROOT, stdout=writing, stderr=subprocess.PIPE, text=True, env=buffered, check=False
    )
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (141, "")


def test_nohup_is_heeded() -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGTERM)}
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        guarded(lambda: os.kill(os.getpid(), signal.SIGHUP))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
