"""Little work is done in this process, much on Ray; what decides, what is said, and what happens where Ray fails."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import psutil
import pytest
import ray

from datagen.common.errors import ClusterError
from datagen.generate import append, generate, inline
from datagen.recipe import DatasetRecipe
from datagen.store import open_dataset
from tests.support.commands import ROOT
from tests.support.recipes import tiny_dataset, tiny_training
from training.recipes.training import EvaluationRecipe
from training.tracking.record import read_record
from workflows.cli.main import main
from workflows.pipeline import own_ray as own_ray_module
from workflows.pipeline import tasks
from workflows.pipeline.own_ray import own_ray
from workflows.pipeline.tasks import TaskRunner


@pytest.fixture(autouse=True)
def on_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RAY_ADDRESS", "RAY_JOB_CONFIG_JSON_ENV_VAR"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def ray_starts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Starts and ends of a Ray that is none; its tasks run here."""
    seen: list[str] = []

    @contextmanager
    def cluster() -> Iterator[None]:
        seen.append("started")
        yield
        seen.append("ended")

    monkeypatch.setattr(tasks, "ray_cluster", cluster)
    monkeypatch.setattr(tasks, "ray_runner", lambda task, arguments: seen.append("tasks") or inline(task, arguments))
    return seen


def test_a_small_dataset_is_made_without_ray(
    tmp_path: Any, ray_starts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with TaskRunner() as runner:
        generate(tiny_dataset(), str(tmp_path / "x.zarr"), run=runner.make_shards)
    assert not ray_starts
    assert capsys.readouterr().err == "generate: 38 meshes, in this process (Ray from 5,000)\n"


def test_a_large_one_is_made_on_ray_which_ends_with_the_block(
    tmp_path: Any, ray_starts: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tasks, "RAY_FROM_MESHES", 38)
    with TaskRunner() as runner:
        generate(tiny_dataset(), str(tmp_path / "x.zarr"), run=runner.make_shards)
        assert ray_starts == ["started", "tasks"]
    assert ray_starts[-1] == "ended"
    assert capsys.readouterr().err == "generate: 38 meshes, on Ray (Ray from 38)\n"
    again = TaskRunner(local=True)
    generate(tiny_dataset(), str(tmp_path / "y.zarr"), run=again.make_shards)
    assert len(ray_starts) == 3 and "in this process (--local)" in capsys.readouterr().err


@pytest.mark.parametrize(("least", "said"), [(10, ["10 poses"]), (5, ["5 identities", "10 poses"])])
def test_many_identities_are_described_and_many_poses_drawn_on_ray(
    tmp_path: Any,
    ray_starts: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    least: int,
    said: list[str],
) -> None:
    monkeypatch.setattr(tasks, "RAY_FROM_MESHES", least)
    with TaskRunner() as runner:
        generate(tiny_dataset(), str(tmp_path / "x.zarr"), run=runner.make_shards)
    assert ray_starts.count("tasks") == len(said) + 1  # and the shards
    lines = [f"generate: {what}, on Ray (Ray from {least})" for what in [*said, "38 meshes"]]
    assert capsys.readouterr().err.splitlines() == lines


def test_meshes_that_take_long_are_worth_rays_start_sooner() -> None:
    dressed = DatasetRecipe.model_validate({"body": {"family": "clothed"}})
    assert tasks.ray_from(tiny_dataset()) == 5_000
    assert 20 < tasks.ray_from(dressed) < 200, "a minute of cloth"


def test_only_what_is_appended_counts(
    spoilable: Any, ray_starts: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tasks, "RAY_FROM_MESHES", 38)  # as many as are there
    with TaskRunner() as runner:
        append(str(spoilable), unseen=6, run=runner.make_shards)
    assert not ray_starts and "generate: 4 meshes, in this process" in capsys.readouterr().err


def test_a_complete_dataset_starts_nothing(dataset: str, ray_starts: list[str]) -> None:
    with TaskRunner() as runner:
        generate(tiny_dataset(), dataset, run=runner.make_shards)
    assert not ray_starts


def test_on_a_cluster_everything_goes_there(
    tmp_path: Any, ray_starts: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "head:6379")
    with TaskRunner() as runner:
        generate(tiny_dataset(), str(tmp_path / "x.zarr"), run=runner.make_shards)
    assert ray_starts.count("tasks") == 4  # the head, identities, poses, shards


def test_few_triples_are_measured_here(
    dataset: str, ray_starts: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runner, opened, recipe = TaskRunner(), open_dataset(dataset), EvaluationRecipe(triples=3)
    assert list(runner.measure(opened, recipe)(lambda number: number, [(1,), (2,)])) == [1, 2]
    assert capsys.readouterr().err == "evaluate: 192 vertices, in this process (Ray from 100,000)\n"  # 2 x 3 x 32
    monkeypatch.setattr(tasks, "RAY_FROM_VERTICES", 192)
    list(runner.measure(opened, recipe)(lambda number: number, [(1,)]))
    assert ray_starts == ["started", "tasks"]


@pytest.mark.parametrize(
    ("recipe", "cluster", "local", "launcher", "starts"),
    [
        ({"launcher": "auto"}, False, False, "inline", False),
        ({"launcher": "auto"}, True, False, "ray", True),
        ({"launcher": "auto", "ranks": 2}, False, False, "ray", True),
        ({"launcher": "ray"}, False, False, "ray", True),
        ({"launcher": "inline"}, True, False, "inline", False),
        ({"launcher": "ray", "ranks": 2, "fewest_ranks": 1}, False, True, "inline", False),
    ],
)
def test_who_trains(
    recipe: dict[str, Any],
    cluster: bool,
    local: bool,
    launcher: str,
    starts: bool,
    ray_starts: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if cluster:
        monkeypatch.setenv("RAY_ADDRESS", "head:6379")
    chosen = TaskRunner(local=local).training(tiny_training(**recipe))
    assert chosen.launcher == launcher and bool(ray_starts) == starts
    assert (chosen.ranks, chosen.fewest_ranks) == (1, None) if local else chosen.ranks == recipe.get("ranks", 1)


def test_ray_that_does_not_start_at_first_is_given_more_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ray waits 30 s for its node, by asking ``get_node`` until it answers; a busy machine may need longer."""
    from ray._private import services

    answers = iter([RuntimeError("not yet"), RuntimeError("not yet"), {"labels": {}}])
    tries: list[Any] = []

    def get_node(address: str, node: str) -> Any:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def init(**options: Any) -> None:
        tries.append(options)
        if len(tries) == 1:
            raise Exception("The current node timed out during startup.\nMore")
        assert services.get_node("127.0.0.1:1", "node") == {"labels": {}}

    monkeypatch.setattr(services, "get_node", get_node)
    monkeypatch.setattr(ray, "init", init)
    with own_ray():
        assert services.get_node is get_node
    assert len(tries) == 2 and tries[0]["address"] == "local"
    said = capsys.readouterr().err
    assert said == "Ray did not start (The current node timed out during startup.); once more, with more time\n"


@pytest.mark.parametrize("fault", ["interrupted", "looking fails"])
def test_whatever_ends_the_start_of_ray_nothing_of_it_is_left(monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    ended: list[str] = []
    monkeypatch.setattr(ray, "init", lambda **_: _raise(KeyboardInterrupt) if fault == "interrupted" else None)
    monkeypatch.setattr(own_ray_module, "_family", lambda: _raise(LookupError))
    monkeypatch.setattr(own_ray_module, "_end_processes", lambda: ended.append(fault))
    with pytest.raises(KeyboardInterrupt if fault == "interrupted" else LookupError), own_ray():
        pytest.fail("the block must not run")
    assert ended == [fault]


def test_a_process_that_ends_while_it_is_looked_at_and_handlers_that_are_not_pythons(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    child = subprocess.Popen(["true"])
    gone = psutil.Process(child.pid)
    child.wait()
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGUSR1)
    set_signal = signal.signal
    monkeypatch.setattr(ray, "init", lambda **_: None)
    monkeypatch.setattr(own_ray_module, "_family", lambda: [gone])
    try:
        with monkeypatch.context() as foreign:
            foreign.setattr(signal, "getsignal", lambda _: None)
            foreign.setattr(signal, "signal", lambda number, handler: (set_signal(number, handler), None)[1])
            with own_ray():
                pass
        assert signal.getsignal(signal.SIGTERM) == signal.getsignal(signal.SIGUSR1) == signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before[0])
        signal.signal(signal.SIGUSR1, before[1])


@pytest.mark.parametrize(
    ("inside", "status", "said"),
    [
        ("pass", 0, ""),
        ("os._exit(1)", 1, "error: this process has been ended in the middle"),
        ("os.kill(os.getpid(), 9)", -9, "error: this process has been ended in the middle"),
    ],
)
def test_a_process_that_is_ended_within_its_ray_has_last_words(inside: str, status: int, said: str) -> None:
    """Ray's client library aborts its process when a reply comes after the server that should take note of it died."""
    script = (
        "import os, ray; ray.init = lambda **_: None\n"
        "from workflows.pipeline.own_ray import own_ray\n"
        f"with own_ray():\n    {inside}"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], check=False, cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == status
    assert ended.stderr.startswith(said) and len(ended.stderr.splitlines()) == bool(said)
    assert said == "" or ended.stderr.endswith("run the same command again to resume\n")


def test_a_block_that_heeds_no_interruption_is_ended_with_the_same_words(tmp_path: Any) -> None:
    """A call to a dead server may wait for ever; what was being made is then no longer recorded as running."""
    script = (
        "import psutil, ray, signal, subprocess, time; ray.init = lambda **_: None\n"
        "from workflows.pipeline import own_ray\n"
        "server = psutil.Process(subprocess.Popen(['sleep', '600']).pid)\n"
        "server.name = lambda: 'raylet'\n"
        "own_ray._family, own_ray._LOOK_SECONDS, own_ray._LEAVE_SECONDS = (lambda: [server]), 0.1, 0.5\n"
        "import pathlib, sys; from training.tracking.record import begin_record\n"
        "about = {'name': 'x', 'kind': 'train', 'parent': None, 'parameters': {}}\n"
        "with own_ray.own_ray():\n"
        "    begin_record(pathlib.Path(sys.argv[1]), **about)\n"
        "    signal.signal(signal.SIGUSR1, signal.SIG_IGN)\n"
        "    server.kill()\n"
        "    time.sleep(600)"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    ended = subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ended.returncode == ClusterError.exit_status
    record = read_record(tmp_path)
    assert record is not None and record.status == "FAILED"
    assert ended.stderr.startswith("error: Ray's raylet has died") and len(ended.stderr.splitlines()) == 1


def _raise(error: type[BaseException]) -> None:
    raise error


def test_ray_that_does_not_start_at_all_is_one_line_with_what_else_to_do(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def init(**options: Any) -> None:
        raise TimeoutError("Timed out after 30 seconds")

    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(ClusterError, match=r"tried twice \(Timed out after 30 seconds\)") as raised, own_ray():
        raise AssertionError("the block must not run")
    assert "--local" in str(raised.value) and "training.launcher=inline" in str(raised.value)
    assert "\n" not in str(raised.value)
    monkeypatch.setattr(tasks, "RAY_FROM_MESHES", 1)
    with pytest.raises(SystemExit) as ended:
        main(["generate", "--recipe", "smoke", "--out", str(tmp_path / "x.zarr")])
    assert ended.value.code == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("error: Ray did not start") and not any("Traceback" in line for line in lines)
