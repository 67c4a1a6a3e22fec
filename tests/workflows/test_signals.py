"""What a command does when it is told to stop while Ray works for it."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WAITING = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a suite started in the background has Ctrl-C ignored
from workflows.console import guarded
from workflows.cluster import ray_cluster

def main():
    import ray, time
    with ray_cluster():
        @ray.remote
        def work():
            time.sleep(300)
        print("at work", flush=True)
        ray.wait([work.remote()])

guarded(main)
"""


@pytest.mark.parametrize(("told", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_command_that_waits_for_ray_is_stopped_with_its_own_status(told: signal.Signals, status: int) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout and process.stdout.readline() == "at work\n"
    process.send_signal(told)
    _, said = process.communicate(timeout=60)
    assert process.returncode == status, said
    assert said.splitlines()[-1].endswith("run the same command again to go on from here")
