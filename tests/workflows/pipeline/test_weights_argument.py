"""Evaluating what a person names: a run, a workflow's folder, a checkpoint, exported weights; each has its place."""

import argparse
from pathlib import Path

import pytest

from datagen.store import open_dataset
from tests.support.recipes import PARTS, tiny_training
from training.checkpoints.checkpoint import export_weights, require_checkpoint
from training.engine.trainer import train
from training.recipes.training import EvaluationRecipe
from training.tracking.record import begin_record, read_record
from workflows.cli.declare import which_checkpoint
from workflows.pipeline.evaluate import evaluate_weights
from workflows.pipeline.run_folder import RunFolder
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import train_model
from workflows.pipeline.weights_argument import evaluated, projecting

RECIPE = EvaluationRecipe(triples=1, emd_points=8, examples=1)


@pytest.fixture
def workflow(dataset: str, tmp_path: Path) -> Path:
    """A workflow's folder with a run of eight steps in it."""
    train(tiny_training(), data=dataset, run=tmp_path / "workflow" / "run")
    return tmp_path / "workflow"


def test_each_has_a_folder_of_its_own_and_none_lies_in_a_checkpoint(workflow: Path, dataset: str) -> None:
    run, data = workflow / "run", open_dataset(dataset)
    export_weights(require_checkpoint(run), workflow / "exported")
    step = run / "checkpoints" / "step-00000004"
    assert evaluated(workflow).folder(data) == evaluated(run).folder(data) == run / "evaluation"
    assert evaluated(step).folder(data) == evaluated(run, 4).folder(data) == run / "evaluation-step-4"
    assert evaluated(step / "weights.safetensors").folder(data) == run / "evaluation-step-4"
    assert evaluated(run, "best").folder(data).name in ("evaluation-step-4", "evaluation-step-8")
    exported = workflow / "exported"
    assert evaluated(exported).folder(data) == exported / "evaluation"
    assert evaluated(exported / "weights.safetensors").folder(data) == exported / "evaluation"
    assert evaluated(run).weights == run / "checkpoints" / "step-00000008"


def test_other_data_is_named(workflow: Path, spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = open_dataset(str(spoilable))
    monkeypatch.setattr(type(other), "uuid", "another")
    assert evaluated(workflow).folder(other).name == "evaluation-leg"
    assert evaluated(workflow, 4).folder(other).name == "evaluation-leg-step-4"


def test_weights_without_a_journal_get_all_but_the_curve(workflow: Path, dataset: str) -> None:
    export_weights(require_checkpoint(workflow / "run"), workflow / "exported")
    before = sorted((workflow / "run" / "checkpoints").rglob("*"))
    for place, folder, has_curve in (
        (workflow / "exported", workflow / "exported" / "evaluation", False),
        (workflow / "run" / "checkpoints" / "step-00000004", workflow / "run" / "evaluation-step-4", True),
    ):
        assert "step" in evaluate_weights(RECIPE, dataset, place, parent=None, tasks=TaskRunner())
        assert (folder / "tables.md").exists() and (folder / "figures" / "examples.png").exists()
        assert (folder / "figures" / "training-curve.png").exists() == has_curve
    assert sorted((workflow / "run" / "checkpoints").rglob("*")) == before


def test_projected_outputs_have_a_row_and_the_runs_own_metrics_keep_their_names(
    workflow: Path, dataset: str, tmp_path: Path
) -> None:
    train(tiny_training(**PARTS, steps=1, edge_weight=0), data=dataset, run=tmp_path / "parts")
    project = projecting(str(tmp_path / "parts"))
    text = evaluate_weights(RECIPE, dataset, workflow / "run", parent=None, tasks=TaskRunner(), project=project)
    assert "DSFFNet on parts" in text
    record = read_record(workflow / "run" / "evaluation")
    assert record is not None and {"pmd_unseen", "DSFFNet_on_parts/pmd_unseen"} <= set(record.metrics)


def test_which_checkpoint_is_a_word_or_a_step() -> None:
    assert [which_checkpoint(word) for word in ("latest", "best", "2000")] == ["latest", "best", 2000]
    with pytest.raises(argparse.ArgumentTypeError, match="'newest' is none of result, latest, best, nor a step"):
        which_checkpoint("newest")


def test_a_training_without_a_record_may_be_begun_afresh(workflow: Path) -> None:
    RunFolder(workflow / "run").remove()
    assert not (workflow / "run" / "checkpoints").exists() and not (workflow / "run" / "metrics.jsonl").exists()


def test_the_driver_says_where_meshes_were_kept(
    tmp_path: Path, dataset: str, capsys: pytest.CaptureFixture[str]
) -> None:
    begin_record(tmp_path / "run", name="train", kind="train", parent=None, parameters={})
    (tmp_path / "run" / "input.json").write_text('{"where": "memory (1 MB)"}')
    train_model(tiny_training(), dataset, RunFolder(tmp_path / "run"), parent=None, tasks=TaskRunner())
    assert "train: meshes were kept in " in capsys.readouterr().out
