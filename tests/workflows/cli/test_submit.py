"""What ``dsffnet submit`` makes of a job's end, whatever becomes of the job, its driver, its node or the cluster."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from ray.dashboard.modules.job.common import JobStatus
from ray.exceptions import AuthenticationError

from datagen.common.errors import ClusterError
from workflows.cli import submit as submit_command
from workflows.cli.main import main
from workflows.cli.submit import follow


def seen(status: str, **more: Any) -> SimpleNamespace:
    about = {"message": None, "driver_exit_code": None, "driver_node_id": "n1"} | more
    return SimpleNamespace(status=JobStatus(status), **about)


class Scripted:
    """A job whose every look finds the next of these; the last one stays."""

    name = "raysubmit_x"

    def __init__(
        self, *looks: SimpleNamespace | BaseException, alive: Callable[[int], bool] = lambda look: True
    ) -> None:
        self._looks, self._alive, self.count = looks, alive, 0

    def info(self) -> Any:
        found = self._looks[min(self.count, len(self._looks) - 1)]
        self.count += 1
        if isinstance(found, BaseException):
            raise found
        return found

    def node_is_alive(self, node: str) -> bool:
        assert node == "n1"
        return self._alive(self.count)

    def print_log(self, over: Any) -> None:
        print("as the job says")


def test_a_job_that_succeeds_after_a_while() -> None:
    job = Scripted(seen("PENDING", driver_node_id=None), seen("RUNNING"), seen("SUCCEEDED"))
    follow(job, look=0)
    assert job.count == 3


@pytest.mark.parametrize(
    ("end", "says"),
    [
        (
            seen("FAILED", driver_exit_code=75),
            "raysubmit_x failed: its command ended with status 75. Its log: ray job logs",
        ),
        (seen("FAILED", message="Job supervisor actor died.\nMore"), "raysubmit_x failed: Job supervisor actor died"),
        (seen("FAILED"), "raysubmit_x failed: no reason is known"),
        (seen("STOPPED"), "raysubmit_x was stopped"),
    ],
)
def test_any_other_end_is_an_error_in_one_line(end: SimpleNamespace, says: str) -> None:
    with pytest.raises(ClusterError, match=says) as raised:
        follow(Scripted(seen("RUNNING"), end), look=0)
    assert raised.value.exit_status == 1 and "\n" not in str(raised.value)


def test_a_job_that_runs_on_a_dead_node_is_lost() -> None:
    """Where the head's raylet was killed, Ray's record says RUNNING for ever."""
    with pytest.raises(ClusterError, match=r"lost: the node that its driver ran on is dead, for 0 s"):
        follow(Scripted(seen("RUNNING"), alive=lambda look: False), look=0.01, lost=0.05)


def test_a_cluster_that_does_not_answer_is_waited_for_and_then_given_up() -> None:
    refused = ConnectionError("refused")
    follow(Scripted(seen("RUNNING"), refused, refused, seen("RUNNING"), seen("SUCCEEDED")), look=0)
    with pytest.raises(ClusterError, match=r"lost: the cluster does not answer \(refused\)"):
        follow(Scripted(seen("RUNNING"), refused), look=0.01, lost=0.05)


def test_a_node_that_is_back_in_time_loses_nothing() -> None:
    job = Scripted(*[seen("RUNNING")] * 4, seen("SUCCEEDED"), alive=lambda look: look != 2)
    follow(job, look=0, lost=30)


@pytest.fixture
def submitted() -> Iterator[list[list[str]]]:
    """Commands that were submitted, with the address and the folder."""
    asked: list[list[str]] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield asked
    for number, handler in before.items():
        signal.signal(number, handler)


def run(monkeypatch: pytest.MonkeyPatch, job: Scripted, asked: list[list[str]]) -> int:
    def submit(entrypoint: list[str], address: str | None, working_dir: str) -> Scripted:
        asked.append([*entrypoint, str(address), working_dir])
        return job

    monkeypatch.setattr(submit_command, "submitted", submit)
    try:
        main(["submit", "--address", "http://head:8265", "--", "python", "workflows/full.py", "--out", "/data/x"])
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def test_the_command_says_how_the_job_ended(
    monkeypatch: pytest.MonkeyPatch, submitted: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, Scripted(seen("SUCCEEDED")), submitted) == 0
    assert submitted == [["python", "workflows/full.py", "--out", "/data/x", "http://head:8265", "."]]
    assert capsys.readouterr().out.split("\n")[:2] == ["submitted: job raysubmit_x", "as the job says"]
    assert run(monkeypatch, Scripted(seen("FAILED", driver_exit_code=2)), submitted) == 1
    assert capsys.readouterr().err.startswith("error: job raysubmit_x failed: its command ended with status 2")


def test_ctrl_c_leaves_the_job_and_says_how_to_look_at_it(
    monkeypatch: pytest.MonkeyPatch, submitted: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    job = Scripted(KeyboardInterrupt())
    monkeypatch.setattr(job, "print_log", lambda over: threading.Event().wait(15))
    began = time.monotonic()
    assert run(monkeypatch, job, submitted) == 130
    assert time.monotonic() - began < 10, "the log of a job that goes on is not waited for"
    said = capsys.readouterr().err
    assert said.startswith("interrupted; the job continues") and "ray job logs --follow raysubmit_x" in said
    assert "run the same command again" not in said


def test_a_cluster_that_asks_for_a_token_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(address: str | None) -> None:
        raise AuthenticationError("Token authentication is enabled but no token was found")

    monkeypatch.setattr("ray.job_submission.JobSubmissionClient", refuse)
    with pytest.raises(SystemExit) as ended:
        main(["submit", "--address", "http://head:8265", "--", "true"])
    said = capsys.readouterr().err
    assert ended.value.code == 1 and said.count("\n") == 1
    assert said.startswith("error: the job could not be submitted to http://head:8265: Token authentication is enabled")


def test_a_cluster_that_is_not_there_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["submit", "--address", "http://127.0.0.1:9", "--", "true"])
    said = capsys.readouterr().err
    assert ended.value.code == 1
    assert said.startswith("error: the job could not be submitted to http://127.0.0.1:9") and said.count("\n") == 1
