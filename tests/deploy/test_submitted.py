"""``dsffnet submit`` against a Ray head: its exit status when the job, its driver or the head's raylet dies."""

import signal
import subprocess
import time
from collections.abc import Iterator

import psutil
import pytest
from composefile import ROOT
from processes import Stack, services_running

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(400)]
WAITING = ("python", "-c", "import time; print('at work', flush=True); time.sleep(300)")


@pytest.fixture(scope="module")
def head() -> Iterator[Stack]:
    with services_running(["ray-head"]) as running:
        yield running


def start(head: Stack, *entrypoint: str) -> subprocess.Popen[str]:
    """The client's own command up to ``--``, with this behind it, and a folder of little to upload."""
    command = head.command("client")
    words = [*command[: command.index("--")], f"--working-dir={ROOT / 'deploy'}", "--", *entrypoint]
    return subprocess.Popen(
        words, cwd=ROOT, env=head.environment("client"), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def at_work(process: subprocess.Popen[str]) -> psutil.Process:
    """The driver of a job, once it is at work."""
    assert process.stdout is not None
    until = time.monotonic() + 120
    for line in process.stdout:
        assert time.monotonic() < until
        if "at work" in line:
            break
    return next(p for p in psutil.process_iter(["cmdline"]) if (p.info["cmdline"] or [])[1:] == list(WAITING[1:]))


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    output, _ = process.communicate(timeout=200)
    return process.returncode, output


def test_the_status_is_the_job_s(head: Stack) -> None:
    status, output = end(start(head, "python", "-c", "print('done by the job')"))
    assert status == 0 and "done by the job" in output and output.rstrip().endswith("succeeded")

    status, output = end(start(head, "python", "-c", "import sys; print('last words'); sys.exit(75)"))
    assert status == 1 and "last words" in output
    assert "failed: its command ended with status 75" in output.splitlines()[-1]

    process = start(head, *WAITING)
    at_work(process).kill()
    status, output = end(process)
    assert status == 1 and "error: job raysubmit_" in output.splitlines()[-1]

    process = start(head, *WAITING)
    driver = at_work(process)
    process.send_signal(signal.SIGINT)
    status, output = end(process)
    assert status == 130 and "the job continues" in output.splitlines()[-1]
    assert driver.is_running()


def test_sigkill_of_the_head_s_raylet(head: Stack) -> None:
    """Where ``ray job submit`` ends with status 0. The last test: the head is of no use afterwards."""
    process = start(head, *WAITING)
    driver = at_work(process)
    raylets = [p for p in head.leftovers() if p.name() == "raylet"]
    assert len(raylets) == 1
    raylets[0].kill()
    status, output = end(process)
    assert status == 1, output
    assert output.splitlines()[-1].startswith("error: job raysubmit_"), output
    driver.kill()  # one that does not use Ray outlives its node
