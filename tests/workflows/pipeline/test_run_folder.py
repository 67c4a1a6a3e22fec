"""Every file of a finished workflow belongs to its folder, and ``--fresh`` removes those and nothing else."""

import shutil
from pathlib import Path

import pytest

from datagen.common.errors import RecipeError, WorkflowError
from tests.support.commands import command
from tests.support.files import tree_hash
from training.tracking.record import begin_record
from workflows.pipeline.run_folder import ComparisonFolder, RunFolder, SingleRunFolder, SweepFolder

SMALL = (
    "data.poses.seen=6",
    "data.poses.unseen=4",
    "training.steps=4",
    "evaluation.triples=2",
    "evaluation.examples=1",
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, empty_store: Path) -> Path:
    out = tmp_path_factory.mktemp("finished") / "out"
    out.mkdir()
    shutil.copy(empty_store, out / "mlflow.db")
    done = command("--recipe", "smoke", "--local", "--out", out, "--set", *SMALL, script="full.py")
    assert done.returncode == 0 and "Where everything lies" in done.stdout, done.stderr
    return out


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "out"))


def test_every_file_of_a_finished_workflow_is_owned(finished: Path) -> None:
    folder = SingleRunFolder(finished)
    for each in (folder, folder.run, folder.run.evaluation):
        assert not each.strangers() and len(each.owned()) > 7


def test_starting_over_keeps_what_is_not_ours_the_locks_and_the_store(out: Path) -> None:
    for place in (out, out / "run"):
        (place / "thesis.txt").write_text("precious")
    RunFolder(out / "run").remove()
    assert {path.name for path in (out / "run").iterdir()} == {"thesis.txt", ".driver.lock", ".lock"}
    shutil.rmtree(out / "run")
    SingleRunFolder(out).remove()
    kept = {path.name for path in out.iterdir()}
    assert kept <= {"thesis.txt", "mlflow.db", "mlflow.db.lock", "mlartifacts", ".lock", "dataset.zarr.lock"}
    assert {"thesis.txt", "mlflow.db", "mlartifacts"} <= kept


def test_a_dataset_that_is_a_link_is_not_removed_elsewhere(tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "other disk" / "dataset.zarr"
    for folder in (out, elsewhere / "pose"):
        folder.mkdir(parents=True)
    (out / "recipe.yaml").write_text("")
    (out / "dataset.zarr").symlink_to(elsewhere)
    with pytest.raises(RecipeError, match=rf"Remove the dataset itself: rm -r '{elsewhere}'; or the link"):
        SingleRunFolder(out).remove()
    assert (elsewhere / "pose").is_dir() and (out / "recipe.yaml").exists()


def test_a_folder_that_leads_to_a_disk_that_is_not_there_says_so(tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to(tmp_path / "disk" / "out")
    says = rf"out leads to {tmp_path}/disk/out, which is not there. Mount or make it"
    with pytest.raises(WorkflowError, match=says), SingleRunFolder(tmp_path / "out").alone():
        pytest.fail("it began")


def test_what_a_failed_run_leaves_is_removed_too(out: Path) -> None:
    run = RunFolder(out / "run")
    left = ("failure.txt", "failure.json", "not-finite.json", "stop", "record.json.unreadable", "evaluation-other")
    for name in left:
        (run.path / name).write_text("")
    (out / "link").symlink_to(out / "mlartifacts")
    (run.path / "pictures").symlink_to(out / "mlartifacts")
    run.remove()
    assert not [name for name in (*left, "pictures") if (run.path / name).exists()]
    assert (out / "mlartifacts").is_dir(), "of a link, only the link"


def test_a_training_is_refused_in_a_workflow_a_dataset_and_a_file(tmp_path: Path) -> None:
    begin_record(tmp_path / "whole", name="mine", kind="workflow", parent=None, parameters={})
    (tmp_path / "x.zarr" / "grid").mkdir(parents=True)
    for file in ("x.zarr/grid/zarr.json", "file"):
        (tmp_path / file).write_text("{}")
    before = tree_hash(tmp_path)
    for place, says in (
        ("whole", "another kind of work: workflow 'mine'"),
        ("x.zarr", f"is the dataset {tmp_path}/x.zarr, or lies in it"),
        ("x.zarr/run", f"x.zarr/run is the dataset {tmp_path}/x.zarr, or lies in it"),
        ("file", f"is the file {tmp_path}/file, or lies in it"),
    ):
        with pytest.raises(RecipeError, match=says), RunFolder(tmp_path / place).alone():
            pytest.fail("it began")
    assert tree_hash(tmp_path) == before


@pytest.mark.parametrize("kind", [SweepFolder, ComparisonFolder])
def test_the_folder_of_another_kind_of_work_is_left_alone(tmp_path: Path, kind: type[SweepFolder]) -> None:
    begin_record(tmp_path, name="mine", kind="workflow", parent=None, parameters={})
    with pytest.raises(RecipeError, match=r"another kind of work: workflow 'mine'\. Choose another --out"):
        kind(tmp_path).remove()
    (tmp_path / "record.json").unlink()
    (tmp_path / "trials").mkdir()
    with pytest.raises(RecipeError, match=f"holds files, but no {kind.kind} of ours, so --fresh leaves it alone"):
        kind(tmp_path).remove()
    assert (tmp_path / "trials").is_dir()


def test_a_training_is_begun_afresh_where_nothing_is(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "new")
    for _ in range(2):  # the second time only the lock is there
        with run.alone():
            run.remove()
    assert run.lock.exists()
