"""A real MLflow server that is missing, killed and started again; the mirror runs all the while.

Afterwards every point of the journal is on the server once, and the work was not slowed.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mlflow
import pytest

from datagen.common.errors import TrackingError
from tests.support.commands import wait_for
from tests.support.ranks import free_port
from training.tracking.journal import Journal, read_journal
from training.tracking.mlflow_mirror import Mirror, publish
from training.tracking.record import EXPERIMENT, Server, begin_record, end_record, find_records, update_record

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]
ROOT = Path(__file__).parents[3]
_PAUSE = 0.02  # seconds between journal lines


class TrackingServer:
    """``mlflow server`` on a port and a database of its own, which a test may kill and start again."""

    def __init__(self, folder: Path) -> None:
        self.uri = f"http://127.0.0.1:{free_port()}"
        self._folder, self._process = folder, None

    def start(self) -> None:
        port, database = self.uri.rpartition(":")[2], f"sqlite:///{self._folder / 'server.db'}"
        command = [sys.executable, "-m", "mlflow", "server", "--port", port, "--host", "127.0.0.1", "--workers", "1"]
        command += ["--backend-store-uri", database, "--artifacts-destination", str(self._folder / "artifacts")]
        with open(self._folder / "server.log", "a") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        wait_for(self._answers, 90)

    def kill(self) -> None:
        """Kill the server and its workers, with no time to say goodbye."""
        if self._process is not None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._process = None

    def pause(self, seconds: float) -> None:
        """A server that accepts connections and says nothing."""
        os.killpg(self._process.pid, signal.SIGSTOP)  # type: ignore[attr-defined]
        time.sleep(seconds)
        os.killpg(self._process.pid, signal.SIGCONT)  # type: ignore[attr-defined]

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(f"{self.uri}/health", timeout=1) as answer:
                return answer.status == 200
        except OSError:
            return False


@pytest.fixture
def server(tmp_path: Path) -> Iterator[TrackingServer]:
    found = TrackingServer(tmp_path)
    yield found
    found.kill()


def begin(root: Path) -> Path:
    """A workflow's record and a training's below it; beginning again goes on with both."""
    begin_record(root, name="workflow", kind="workflow", parent=None, parameters={"batch": "8"})
    begin_record(root / "run", name="train", kind="train", parent=root, parameters={"batch": "8"})
    return root / "run"


@contextmanager
def training(run: Path) -> Iterator[list[float]]:
    """A stand-in for a training: journal lines from a thread, many a second; yields the pauses between them."""
    stop, pauses = threading.Event(), []

    def work() -> None:
        journal = Journal(run / "metrics.jsonl")
        while not stop.is_set():
            began = time.perf_counter()
            journal.write(journal.next_step, {"loss/total": 1 / (1 + journal.next_step), "learning_rate": 0.1})
            time.sleep(_PAUSE)
            pauses.append(time.perf_counter() - began)
        journal.close()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield pauses
    finally:
        stop.set()
        thread.join()


def points_on(server: TrackingServer, key: str) -> list[tuple[int, int, float]]:
    """Every point of a metric of the one training run, as the server has it."""
    client = mlflow.MlflowClient(server.uri)
    experiment = client.get_experiment_by_name(EXPERIMENT).experiment_id
    (run,) = client.search_runs([experiment], "tags.kind = 'train'")
    return sorted((p.step, p.timestamp, p.value) for p in client.get_metric_history(run.info.run_id, key))


def assert_same_as_journal(server: TrackingServer, run: Path) -> None:
    rows = read_journal(run / "metrics.jsonl")
    assert [row["step"] for row in rows] == list(range(len(rows))) and len(rows) > 100
    for key in ("loss/total", "learning_rate"):
        assert points_on(server, key) == [(row["step"], int(row["time"] * 1000), row[key]) for row in rows]


def noted(run: Path, server: TrackingServer) -> int:
    """Up to which byte of the journal has been sent."""
    path = run / "mlflow.json"
    sent = json.loads(path.read_text()) if path.exists() else {}
    return int(sent.get(server.uri, {}).get("offsets", {}).get("metrics.jsonl", 0))


def test_missing_at_the_start_killed_in_the_middle_missing_at_the_end(server: TrackingServer, tmp_path: Path) -> None:
    root = tmp_path / "workflow"
    run = begin(root)
    mirror = Mirror(root, Server(server.uri), every=0.05, after_failure=0.2)
    with pytest.raises(TrackingError, match="dsffnet sync"), mirror:
        with training(run) as pauses:
            wait_for(lambda: len(pauses) > 100, 60)  # nobody there yet
            server.start()
            wait_for(lambda: noted(run, server) > 0, 60)
            server.kill()
            server.start()
            reached = (run / "metrics.jsonl").stat().st_size
            wait_for(lambda: noted(run, server) >= reached, 60)
            server.kill()
            lines = len(pauses)
            wait_for(lambda: len(pauses) > lines + 50, 10)
        end_record(run, "FINISHED")
        end_record(root, "FINISHED")
        began = time.perf_counter()
    assert time.perf_counter() - began < 30, "the end of the work waits for no server that is gone"
    assert sorted(pauses)[len(pauses) // 2] < 3 * _PAUSE, "a line was written at its usual pace throughout"
    server.start()
    sync = [sys.executable, "-m", "workflows", "sync", str(root), "--tracking-uri", server.uri]
    for _ in range(2):
        done = subprocess.run(sync, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0 and "is up to date" in done.stdout, done.stderr
        assert_same_as_journal(server, run)
    client = mlflow.MlflowClient(server.uri)
    runs = client.search_runs([client.get_experiment_by_name(EXPERIMENT).experiment_id])
    assert [r.info.status for r in runs] == ["FINISHED"] * 2, "one run a record, however often it was tried"


class Killed(BaseException):
    """As SIGKILL: nothing catches it, nothing is noted."""


def test_killed_between_any_call_and_the_note_about_it(
    server: TrackingServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And then the training is gone on with: the same run, every point once."""
    server.start()
    root = tmp_path / "workflow"
    run = begin(root)
    for call in ("create_run", "log_batch", "log_inputs", "log_artifact", "set_terminated"):
        begin(root)
        with training(run) as pauses:
            wait_for(lambda pauses=pauses: len(pauses) > 150, 30)  # type: ignore[misc]
        about = {"name": f"{call}.zarr", "manifest_sha256": "0" * 64}
        update_record(run, dataset=about, artifacts=["metrics.jsonl"])
        end_record(run, "KILLED")
        with monkeypatch.context() as patch:
            real = getattr(mlflow.MlflowClient, call)

            def then_killed(*arguments: Any, real: Any = real, **keywords: Any) -> None:
                real(*arguments, **keywords)
                raise Killed

            patch.setattr(mlflow.MlflowClient, call, then_killed)
            with pytest.raises(Killed):
                publish(root, Server(server.uri))
    begin(root)
    publish(root, Server(server.uri))
    client = mlflow.MlflowClient(server.uri)
    runs = client.search_runs([client.get_experiment_by_name(EXPERIMENT).experiment_id])
    assert len(runs) == len(find_records(root)) == 2 and {r.info.status for r in runs} == {"RUNNING"}
    assert_same_as_journal(server, run)


def test_a_server_that_says_nothing_does_not_hold_up_the_work(server: TrackingServer, tmp_path: Path) -> None:
    server.start()
    run = begin(tmp_path / "workflow")
    mirror = Mirror(tmp_path / "workflow", Server(server.uri), every=0.05, after_failure=0.2)
    with mirror:
        with training(run) as pauses:
            wait_for(lambda: noted(run, server) > 0, 60)
            before = len(pauses)
            server.pause(3)
            assert len(pauses) - before > 3 / _PAUSE / 4, "the work went on"
        end_record(run, "FINISHED")
    assert_same_as_journal(server, run)
