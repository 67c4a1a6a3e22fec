"""A power failure left files of a finished workflow empty or as garbage: the same command makes them again."""

import json
import os
import stat
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from datagen.common.errors import UnsafeFileError
from datagen.store import open_dataset
from tests.support.recipes import tiny_dataset, tiny_training
from tests.support.workflows import finished_workflow
from training.recipes.training import EvaluationRecipe
from training.reports.report import NAMES
from training.tracking.record import about_dataset, flatten, read_record, write_record
from workflows import full
from workflows.cli.main import main
from workflows.pipeline import generate, train
from workflows.pipeline.evaluate import is_evaluated
from workflows.pipeline.run_folder import RunFolder, SingleRunFolder
from workflows.pipeline.stage import recorded
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import refuse_conflicts
from workflows.recipe.loader import WorkflowRecipe

FOLDERS = {"workflow": ".", "generate": "generate", "train": "run", "evaluate": "run/evaluation"}
GARBAGE = [b"", b"null", b'{"name": "x", "colour": "red"}', b"[" * 5000]


@pytest.fixture
def without_work(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Stages that leave their records and nothing else, in no time; the list says which were done."""
    done: list[str] = []

    def stage(name: str) -> Any:
        def work(*arguments: Any, parent: Path | None = None, **_: object) -> str:
            done.append(name)
            out = parent or arguments[1].path
            with recorded(out / FOLDERS[name], kind=name, name=name, parent=out, parameters={"a": 1}):
                return "a table"

        return work

    def report(out: Path) -> None:
        done.append("report")
        for name in NAMES:
            (out / name).write_text("a report")

    monkeypatch.setattr(generate, "generate_dataset", stage("generate"))
    monkeypatch.setattr(full, "train_model", stage("train"))
    monkeypatch.setattr(full, "evaluate_weights", stage("evaluate"))
    monkeypatch.setattr(full, "workflow_report", report)
    monkeypatch.setattr(full, "announce_times", lambda *_: None)  # which tries steps
    monkeypatch.setattr(generate, "is_complete", lambda *_: True)
    monkeypatch.setattr(full, "is_trained", lambda *_: True)
    monkeypatch.setattr(full, "is_evaluated", lambda _, __, run, *___: read_record(run.evaluation.path) is not None)
    return done


@pytest.mark.parametrize("content", GARBAGE)
@pytest.mark.parametrize("kind", FOLDERS)
def test_an_unreadable_record_is_made_again_by_the_same_command(
    tmp_path: Path, without_work: list[str], kind: str, content: bytes
) -> None:
    full.run_workflow(WorkflowRecipe(), tmp_path, TaskRunner(local=True))
    before = {name: read_record(tmp_path / folder) for name, folder in FOLDERS.items()}
    path = tmp_path / FOLDERS[kind] / "record.json"
    path.write_bytes(content)
    without_work.clear()
    full.run_workflow(WorkflowRecipe(), tmp_path, TaskRunner(local=True))
    assert without_work == (["evaluate", "report"] if kind in ("workflow", "evaluate") else [kind])
    after = {name: read_record(tmp_path / folder) for name, folder in FOLDERS.items()}
    assert _content(after[kind]) == _content(before[kind]) and path.with_name("record.json.unreadable").exists()
    without_work.clear()
    full.run_workflow(WorkflowRecipe(), tmp_path, TaskRunner(local=True))
    assert not without_work, "all is well again"


def _content(record: Any) -> Any:
    return replace(record, started=0, ended=0, id="", measured=None)


@pytest.fixture(scope="module")
def evaluated(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluated") / "out"
    finished_workflow(_pristine, out)
    evaluation, data = out / "run" / "evaluation", str(out / "dataset.zarr")
    (evaluation / "viewer.html").write_text("viewer")
    (evaluation / "figures" / "examples.png").write_text("png")
    record = read_record(evaluation)
    assert record is not None
    parameters = flatten(EvaluationRecipe().model_dump(mode="json"))
    about = about_dataset(open_dataset(data))
    write_record(evaluation, replace(record, dataset=about, parameters=parameters, status="FINISHED"))
    return out


@pytest.mark.parametrize("content", [b"", b"\xff", b"a,b\n1,2\n", None], ids=repr)
@pytest.mark.parametrize("name", ["rows.csv", "tables.md", "viewer.html", "figures/examples.png", "record.json"])
def test_an_evaluation_with_a_damaged_file_is_not_done(evaluated: Path, name: str, content: bytes | None) -> None:
    run, data = evaluated / "run", str(evaluated / "dataset.zarr")
    path = run / "evaluation" / name
    whole = path.read_bytes()
    assert is_evaluated(EvaluationRecipe(), data, RunFolder(run))
    path.unlink()
    try:
        if content is None:
            path.symlink_to("/dev/zero")
        else:
            path.write_bytes(content)
        read_again = name in ("rows.csv", "record.json") or (name == "tables.md" and content == b"\xff")
        is_whole = is_evaluated(EvaluationRecipe(), data, RunFolder(run))
        assert is_whole == (content not in (b"", None) and not read_again)
    finally:
        path.unlink()
        path.write_bytes(whole)


def test_a_run_without_a_readable_record_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "record.json").symlink_to("/dev/zero")
    with pytest.raises(SystemExit) as status:
        main(["sync", str(tmp_path)])
    error = capsys.readouterr().err
    assert status.value.code == 1 and error.count("error: ") == 1 and "holds no record of a run" in error


def test_a_run_has_the_permissions_of_the_umask(tmp_path: Path, dataset: str) -> None:
    before = os.umask(0o077)
    try:
        train.train_model(
            tiny_training(steps=4), dataset, RunFolder(tmp_path / "run"), parent=None, tasks=TaskRunner(local=True)
        )
    finally:
        os.umask(before)
    for path in (tmp_path / "run").rglob("*"):
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0, path
    assert json.loads((tmp_path / "run" / "record.json").read_text())["status"] == "FINISHED"


@pytest.mark.parametrize("name", ["figures", "tables.md", "record.json", "measured"])
@pytest.mark.parametrize("inside", [True, False], ids=["of a workflow", "alone"])
def test_links_that_lead_out_of_a_stage_are_refused_before_anything_is_written(
    tmp_path: Path, name: str, inside: bool
) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "record.json").write_text("{}")
    (tmp_path / "run" / "evaluation").mkdir(parents=True)
    (tmp_path / "run" / "evaluation" / name).symlink_to(victim if "." not in name else victim / "record.json")
    with (
        pytest.raises(UnsafeFileError, match="link"),
        recorded(
            tmp_path / "run" / "evaluation",
            kind="evaluate",
            name="x",
            parent=tmp_path / "run" if inside else None,
            parameters={},
        ),
    ):
        pytest.fail("it began")
    assert [path.name for path in victim.iterdir()] == ["record.json"]
    assert (victim / "record.json").read_text() == "{}"


@pytest.mark.parametrize("name", ["run", "generate", "stages", "trials", "trials/a"])
def test_links_that_lead_out_of_a_workflow_are_refused_before_anything_is_done(tmp_path: Path, name: str) -> None:
    """Not when all has been trained; the dataset may lie elsewhere, and so may the whole folder."""
    out, victim, recipe = tmp_path / "out", tmp_path / "victim", tiny_dataset()
    victim.mkdir()
    (out / name).parent.mkdir(parents=True)
    (out / "dataset.zarr").symlink_to(victim)
    (tmp_path / "link").symlink_to(out)
    folder, runs = SingleRunFolder(tmp_path / "link"), {tmp_path / "link" / "trials" / "a": tiny_training()}
    refuse_conflicts(recipe, folder, runs)
    (out / name).symlink_to(victim)
    with pytest.raises(UnsafeFileError, match=rf"a link that leads out .*link the whole folder {out}.* instead"):
        refuse_conflicts(recipe, folder, runs)
    assert not list(victim.iterdir())
