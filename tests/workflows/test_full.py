"""The whole workflow as a person runs it, undisturbed and under SIGKILL of the driver, of Ray's workers, of a rank."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import torch

from datagen.generate import generate
from datagen.store import open_dataset
from tests.support.commands import command, wait_for
from tests.support.disk import grow, small_disk
from tests.support.files import tree_hash
from training.checkpoints.checkpoint import require_checkpoint
from training.tracking.journal import read_journal
from training.tracking.record import read_record
from workflows.pipeline.run_folder import SingleRunFolder
from workflows.recipe.loader import load_recipe

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(400)]
ROOT = Path(__file__).parents[2]
LONGER = ["data.poses.seen=60", "data.poses.unseen=40", "training.steps=250", "training.checkpoint_every=25"]


@pytest.fixture(scope="module", autouse=True)
def _store(empty_store: Path) -> Iterator[None]:
    """Workflows begin with a copy of an empty MLflow store, which takes seconds to make."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(STORE, "path", empty_store)
        yield


@pytest.fixture(scope="module", autouse=True)
def _agents() -> Iterator[None]:
    """What may wait a minute is waited for once, while all tests run."""
    yield
    _, alive = psutil.wait_procs(AGENTS, timeout=120)
    assert not alive, [process.cmdline() for process in alive]


STORE: dict[str, Path] = {}
AGENTS: list[psutil.Process] = []
ENDED = "error: this process has been ended in the middle"


def start(out: Path, *arguments: str, **environment: str) -> subprocess.Popen[str]:
    if not out.exists():
        out.mkdir()
        shutil.copy(STORE["path"], out / "mlflow.db")
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "MLFLOW_"))}
    return subprocess.Popen(
        [sys.executable, "workflows/full.py", "--recipe", "smoke", "--out", str(out), *arguments],
        cwd=ROOT,
        env=clean | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def run(out: Path, *arguments: str, **environment: str) -> tuple[int, str]:
    process = start(out, *arguments, **environment)
    output, _ = process.communicate(timeout=300)
    return process.returncode, output


def longer(out: Path) -> tuple[str, ...]:
    return ("--set", *LONGER)


def on_ray(out: Path) -> tuple[str, ...]:
    """More meshes than are made without Ray, and little else."""
    return ("--set", "data.poses.seen=700", "data.poses.unseen=400", "training.steps=20", "evaluation.triples=6")


def wait_until_gone(processes: list[psutil.Process]) -> None:
    """Ray's agents wait a minute for the store of a driver that was killed; all else goes with it."""
    agents = [process for process in processes if is_agent(process)]
    AGENTS.extend(agents)
    _, alive = psutil.wait_procs([process for process in processes if process not in agents], timeout=60)
    assert not alive, [process.cmdline() for process in alive]


def is_agent(process: psutil.Process) -> bool:
    try:
        return process.name().endswith("Agent")
    except psutil.Error:
        return False


def family(process: subprocess.Popen[str], title: str) -> list[psutil.Process]:
    """Ray's processes below the driver whose title holds ``title``."""
    found = []
    for child in psutil.Process(process.pid).children(recursive=True):
        try:
            if title in " ".join(child.cmdline()):
                found.append(child)
        except psutil.Error:
            continue
    return found


def shards(out: Path) -> int:
    return len(list((out / "dataset.zarr").rglob("vertices/c/*/*/0/0")))


def trained_steps(out: Path) -> int:
    rows = read_journal(out / "run" / "metrics.jsonl")
    return int(rows[-1]["step"]) if rows else 0


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    out.mkdir()  # it makes its MLflow store itself, as for a person
    status, output = run(out, *longer(out))
    assert status == 0, output
    yield out


def assert_equal(out: Path, undisturbed: Path) -> None:
    """The same dataset and the same trained weights, to the bit, and one line a step in the journal."""
    assert tree_hash(out / "dataset.zarr") == tree_hash(undisturbed / "dataset.zarr")
    one, other = (require_checkpoint(folder / "run").weights() for folder in (out, undisturbed))
    assert all(torch.equal(one[name], other[name]) for name in other)
    steps = [row["step"] for row in read_journal(out / "run" / "metrics.jsonl")]
    assert steps == [row["step"] for row in read_journal(undisturbed / "run" / "metrics.jsonl")]


def test_outputs_closing_words_and_records(undisturbed: Path) -> None:
    evaluation = undisturbed / "run" / "evaluation"
    for name in ("rows.csv", "tables.md", "viewer.html", "figures/examples.png", "figures/training-curve.png"):
        assert (evaluation / name).stat().st_size > 500, name
    assert len(list((evaluation / "meshes").glob("*.glb"))) == 16
    folder = SingleRunFolder(undisturbed)
    assert not [each.strangers() for each in (folder, folder.run, folder.run.evaluation) if each.strangers()]
    for folder, kind in ((".", "workflow"), ("generate", "generate"), ("run", "train"), ("run/evaluation", "evaluate")):
        record = read_record(undisturbed / folder)
        assert record is not None and (record.kind, record.status) == (kind, "FINISHED")


def test_run_again_every_stage_is_skipped_in_seconds(undisturbed: Path) -> None:
    before = tree_hash(undisturbed / "run")
    began = time.monotonic()
    status, output = run(undisturbed, *longer(undisturbed))
    assert status == 0 and output.count("skipped, finished before") == 4  # generate, train, evaluate, report
    assert "Where everything lies" in output and "dsffnet transfer --model" in output
    assert time.monotonic() - began < 30 and tree_hash(undisturbed / "run") == before


def test_a_copy_elsewhere_is_finished_and_shows_its_own_artifacts(undisturbed: Path, tmp_path: Path) -> None:
    import mlflow

    before, copied = tree_hash(undisturbed), tmp_path / "a copy #2"
    shutil.copytree(undisturbed, copied)
    status, output = run(copied, *longer(copied))
    assert status == 0 and output.count("skipped, finished before") == 4, output
    assert tree_hash(undisturbed) == before
    client = mlflow.MlflowClient(f"sqlite:///{copied / 'mlflow.db'}")
    version = client.get_model_version_by_alias("dsffnet", "latest-trained").version
    assert client.get_model_version_download_uri("dsffnet", version).startswith(copied.as_uri())


def test_mlflow_shows_one_parent_three_children_and_a_loadable_model(undisturbed: Path) -> None:
    import mlflow

    uri = f"sqlite:///{undisturbed / 'mlflow.db'}"
    client = mlflow.MlflowClient(uri)
    runs = client.search_runs([client.get_experiment_by_name("dsffnet").experiment_id])
    (parent,) = [r for r in runs if r.data.tags["kind"] == "workflow"]
    children = {r.data.tags["kind"]: r for r in runs if r.data.tags.get("mlflow.parentRunId") == parent.info.run_id}
    assert set(children) == {"generate", "train", "evaluate"}
    assert {r.info.status for r in runs} == {"FINISHED"}
    assert children["train"].data.params["batch"] == "4" and "pmd_unseen" in children["evaluate"].data.metrics
    assert any(key.startswith("system/") for r in runs for key in r.data.metrics)
    assert children["train"].inputs.dataset_inputs
    mlflow.set_tracking_uri(uri)
    model = mlflow.pyfunc.load_model("models:/dsffnet@latest-trained")
    dataset = open_dataset(str(undisturbed / "dataset.zarr"))
    meshes = {"source": dataset.vertices(4, 0), "target": dataset.vertices(5, 1), "target_faces": dataset.faces(5)}
    posed = model.predict(
        {name: values.astype("int64" if "faces" in name else float) for name, values in meshes.items()}
    )
    assert posed.shape == meshes["target"].shape


def test_evaluating_on_other_data_leaves_the_workflow_as_it_was(undisturbed: Path, tmp_path: Path) -> None:
    def dsffnet(*arguments: object) -> None:
        done = command(*arguments)
        assert done.returncode == 0, done.stderr

    table = (undisturbed / "run" / "evaluation" / "tables.md").read_text()
    other = tmp_path / "other.zarr"
    dsffnet("generate", "--recipe", "smoke", "--local", "--set", "data.identities.seed=9", "--out", other)
    dsffnet("evaluate", undisturbed / "run", "--data", other, "--recipe", "smoke", "--set", "evaluation.triples=6")
    assert (undisturbed / "run" / "evaluation-other" / "tables.md").exists()
    dsffnet("evaluate", undisturbed / "run", "--data", undisturbed / "dataset.zarr", "--set", "evaluation.triples=6")
    status, output = run(undisturbed, *longer(undisturbed))
    assert status == 0 and output.count("skipped, finished before") == 2, output
    again = (undisturbed / "run" / "evaluation" / "tables.md").read_text()
    assert again == table, "the workflow's own evaluation is back"


def test_going_on_with_other_intervals_and_refusing_another_recipe(undisturbed: Path) -> None:
    status, output = run(undisturbed, *longer(undisturbed), "training.log_every=10")
    assert status == 0, output
    recipe = (undisturbed / "recipe.yaml").read_text()
    status, output = run(undisturbed, *longer(undisturbed), "training.learning_rate=0.5")
    assert status == 2 and output.count("error: ") == 1 and "training.learning_rate: 0.003 there" in output, output
    assert (undisturbed / "recipe.yaml").read_text() == recipe
    status, output = run(undisturbed, *longer(undisturbed))
    assert status == 0, output


def test_sigterm_of_the_driver_while_training_writes_a_checkpoint(undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(out, *longer(out))
    wait_for(lambda: trained_steps(out) >= 30, process=process)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 143 and "stopped at step" in output, output
    record = read_record(out / "run")
    assert record is not None and record.status == "KILLED"
    stopped = require_checkpoint(out / "run").step
    assert 30 <= stopped < 250 and stopped >= trained_steps(out)
    assert run(out, *longer(out))[0] == 0
    assert_equal(out, undisturbed)


@pytest.mark.timeout(900)
def test_sigkill_of_the_driver_in_every_stage(undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    moments = [
        lambda: shards(out) >= 5,
        (out / "stages" / "generate.json").exists,
        lambda: trained_steps(out) >= 60,
        (out / "run" / "evaluation" / "record.json").exists,
    ]
    killed = list[tuple[subprocess.Popen[str], list[psutil.Process]]]()
    for moment in moments:
        process = start(out, *longer(out))
        wait_for(moment, process=process)
        killed.append((process, family(process, "ray")))
        process.send_signal(signal.SIGKILL)
        process.wait()
    status, output = run(out, *longer(out))
    assert status == 0, output
    assert len(killed[2][1]) > 4, "Ray trains"
    for process, rays in killed:
        process.communicate(timeout=90)  # nobody holds its output open
        wait_until_gone(rays)
    assert_equal(out, undisturbed)


def test_sigkill_of_ray_workers_while_generating(undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(out, *on_ray(out))
    for count in (2, 60):
        wait_for(
            lambda count=count: shards(out) >= count and bool(family(process, "ray::ensure_shard")), process=process
        )  # type: ignore[misc]
        for worker in family(process, "ray::ensure_shard"):
            worker.send_signal(signal.SIGKILL)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    recipe = load_recipe("smoke", [word for word in on_ray(out) if word.startswith("data.")])
    local = generate(recipe.data, str(tmp_path / "local.zarr"))
    assert tree_hash(out / "dataset.zarr") == tree_hash(Path(local.url))


@pytest.mark.timeout(900)
@pytest.mark.parametrize("stage", ["generate", "train"])
def test_sigkill_of_each_server_of_ray(stage: str, undisturbed: Path, tmp_path: Path) -> None:
    """Ray by itself waits for a minute, and then ends the process in the middle of a line."""
    out = tmp_path / "out"
    arguments, done = (on_ray(out), shards) if stage == "generate" else (longer(out), trained_steps)

    def lost(server: str, more: int) -> str:
        reached, process = done(out) + more, start(out, *arguments)
        wait_for(lambda: done(out) >= reached and bool(family(process, "ray::")), process=process)
        return assert_ends_with_its_server(process, server)

    for server, more in (("raylet", 30), ("gcs_server", 5)):  # without the latter ranks learn on for a while
        last_words = lost(server, more)
        record = read_record(out / ("run" if stage == "train" else "generate"))
        killed = last_words.startswith(ENDED)  # as by SIGKILL: what follows sees that it no longer runs
        assert record is not None and record.status in ("FAILED", *(["KILLED", "RUNNING"] if killed else []))
    status, output = run(out, *arguments)
    assert status == 0, output
    if stage == "train":
        assert_equal(out, undisturbed)


def assert_ends_with_its_server(process: subprocess.Popen[str], server: str) -> str:
    """Kill a server; the line with which the process ends."""
    rays = family(process, "ray")
    (victim,) = [child for child in rays if child.name() == server]
    victim.kill()
    began = time.monotonic()
    output, _ = process.communicate(timeout=90)
    assert process.returncode == 1 and time.monotonic() - began < 45, output
    # Ray's client library itself ends the process, where a task's reply comes just then
    last = output.splitlines()[-1]
    assert last.startswith((f"error: Ray's {server} has died", ENDED)), output
    assert "Traceback" not in output
    wait_until_gone(rays)
    return last


def test_nothing_of_ray_outlives_a_driver_that_is_ended_while_it_trains(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for number, status in ((signal.SIGINT, 130), (signal.SIGHUP, 129)):
        before = trained_steps(out)
        process = start(out, *longer(out))
        wait_for(lambda before=before: trained_steps(out) >= before + 10, process=process)  # type: ignore[misc]
        rays = family(process, "ray")
        assert len(rays) > 4
        process.send_signal(number)
        output, _ = process.communicate(timeout=90)
        assert process.returncode == status, output
        assert output.splitlines()[-1].endswith("run the same command again to resume"), output
        wait_until_gone(rays)


def test_sigkill_of_a_training_rank(undisturbed: Path, tmp_path: Path) -> None:
    """The group starts again by itself, from the newest checkpoint, and ends equal to an undisturbed training."""
    out = tmp_path / "out"
    process = start(out, *longer(out))
    wait_for(lambda: trained_steps(out) >= 60, process=process)
    ranks = family(process, "ray::RayTrainWorker")
    assert len(ranks) == 2, [p.cmdline() for p in psutil.Process(process.pid).children(recursive=True)]
    ranks[1].send_signal(signal.SIGKILL)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert_equal(out, undisturbed)


def test_tracking_server_down_costs_nothing_but_the_exit_status(tmp_path: Path) -> None:
    out = tmp_path / "out"
    status, output = run(out, "--tracking-uri", "http://127.0.0.1:9", "--local")
    assert status == 1 and output.count("error: MLflow at http://127.0.0.1:9 could not be brought up to date") == 1, (
        output
    )
    assert "Nothing is lost" in output and (out / "run" / "evaluation" / "tables.md").exists()
    done = command("sync", out, "--tracking-uri", f"sqlite:///{tmp_path / 'later.db'}")
    assert done.returncode == 0 and "is up to date" in done.stdout, done.stderr
    assert len(json.loads((out / "mlflow.json").read_text())) == 1


def test_a_full_disk_ends_it_with_one_error_and_it_goes_on_once_there_is_room(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", kibibytes=3_000) as disk:
        status, output = run(disk / "out", *longer(disk / "out"))
        assert status == 1 and output.count("error: ") == 1 and "Traceback" not in output, output
        grow(disk, kibibytes=400_000)
        status, output = run(disk / "out", *longer(disk / "out"))
        assert status == 0, output


def test_more_ranks_than_cpus(tmp_path: Path) -> None:
    ranks = 2 * (os.cpu_count() or 1) + 2
    status, output = run(tmp_path / "out", "--set", f"training.ranks={ranks}", f"training.batch={ranks}")
    assert status == 1 and output.count("error: ") == 1, output
    assert f"training.ranks is {ranks}, but the cluster has" in output and "--set training.ranks=" in output
