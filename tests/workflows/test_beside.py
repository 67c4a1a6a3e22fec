"""A workflow whose recipe has a training ``beside`` the first: both in one table, one picture, one report."""

import shutil
from pathlib import Path

import pytest

from datagen.common.errors import RecipeError
from tests.support.recipes import tiny_dataset, tiny_training
from training.evaluation.evaluate import read_rows
from training.evaluation.tables import methods_of
from training.recipes.training import EvaluationRecipe
from training.tracking.record import MODEL, read_record
from workflows import full
from workflows.pipeline.evaluate import evaluate_weights
from workflows.pipeline.run_folder import SingleRunFolder
from workflows.pipeline.tasks import TaskRunner
from workflows.recipe.loader import WorkflowRecipe, load_recipe


def test_both_are_trained_and_measured_on_the_same_triples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = WorkflowRecipe(
        data=tiny_dataset(),
        training=tiny_training(steps=2),
        beside=tiny_training(steps=2, network={"name": "npt", "encoder_widths": (4, 8, 13)}),
        evaluation=EvaluationRecipe(emd_points=16, examples=1, chunk=4),
    )
    full.run_workflow(recipe, tmp_path, TaskRunner(local=True))
    folder = SingleRunFolder(tmp_path)
    rows = read_rows(folder.run.evaluation.rows)
    triples = {name: [r.triple for r in rows if r.method == name] for name in methods_of(rows)}
    assert {"DSFFNet", "NPT"} < triples.keys() and triples["DSFFNet"] == triples["NPT"]
    assert sorted(path.name for path in folder.run.evaluation.meshes.glob("00-output*")) == [
        "00-output-DSFFNet.glb",
        "00-output-NPT.glb",
    ]
    whole, beside = read_record(tmp_path), read_record(folder.beside.path)
    assert whole is not None and {"pmd_unseen", "NPT/pmd_unseen"} < whole.metrics.keys()
    assert beside is not None and (beside.name, beside.model) == ("train-beside", f"{MODEL}-beside")
    assert whole.dataset == beside.dataset is not None, "MLflow shows it with the whole, too"
    pmd = whole.metrics["NPT/pmd_unseen"]
    assert "NPT, step 2 " in beside.model_about and f"{pmd:.2f}e-4 in unseen poses" in beside.model_about
    report = folder.report.read_text()
    assert "Model card: NPT" in report and f"models:/{MODEL}-beside@" in report and "Beside it, NPT" in report
    capsys.readouterr()
    full.run_workflow(recipe, tmp_path, TaskRunner(local=True))
    said = capsys.readouterr().out
    assert all(f"{stage}: skipped" in said for stage in ("generate", "train", "train-beside", "evaluate", "report"))
    runner = TaskRunner(local=True)
    evaluate_weights(recipe.evaluation, folder.data, folder.run.path, parent=None, tasks=runner)
    capsys.readouterr()
    full.run_workflow(recipe, tmp_path, TaskRunner(local=True))
    assert "evaluate: finished" in capsys.readouterr().out, "the first alone was measured in between"
    assert {"DSFFNet", "NPT"} < set(methods_of(read_rows(folder.run.evaluation.rows)))
    shutil.rmtree(folder.beside.path)
    full.run_workflow(recipe, tmp_path, TaskRunner(local=True))
    said = capsys.readouterr().out
    assert "train: skipped" in said and "evaluate: finished" in said, "what it was measured on is new"
    other = recipe.model_copy(update={"beside": recipe.beside.model_copy(update={"steps": 3})})
    with pytest.raises(RecipeError, match=r"beside was trained by another recipe \(beside.steps: 2 there, 3 here\)"):
        full.run_workflow(other, tmp_path, TaskRunner(local=True))


def test_its_keys_are_those_of_training() -> None:
    words = ["beside.network.name=npt", "beside.steps=7"]
    recipe = load_recipe("smoke", words)
    assert recipe.beside is not None and (recipe.beside.network.name, recipe.beside.steps) == ("npt", 7)
    assert load_recipe("quickstart", ["beside=null"]).beside is None
    named = load_recipe("smoke", ["beside=npt-paper"]).beside
    assert named is not None and named == load_recipe("smoke", ["training=npt-paper"]).training
    with pytest.raises(RecipeError, match=r"unknown key 'beside.stepz', did you mean 'beside.steps'\?"):
        load_recipe("smoke", ["beside.stepz=7"])
    with pytest.raises(RecipeError, match=r"beside.early_stopping goes by .*beside.early_stopping=null"):
        load_recipe("smoke", ["beside.early_stopping=3", "data.poses.unseen=0"])
