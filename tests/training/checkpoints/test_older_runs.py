"""Runs of an earlier version: one clear error or weights that serve, never a traceback, never another training."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from datagen.common.errors import CheckpointError
from tests.support.recipes import tiny_training
from training.checkpoints.checkpoint import require_checkpoint, save_checkpoint
from training.engine.distributed import Ranks
from training.engine.trainer import Learner, train
from training.inference.predict import load_trained
from training.recipes.training import ScheduleRecipe, TrainingRecipe
from training.tracking.journal import read_journal


def make_older(run: Path, recipe: dict[str, Any] | None = None) -> Path:
    """Rewrite a run's newest checkpoint as an earlier version wrote it."""
    found = require_checkpoint(run)
    weights = found.weights()
    about = {"step": found.step, "recipe": recipe or found.recipe, "dataset": found.dataset}
    network = torch.nn.Linear(2, 2)
    schedule = torch.optim.lr_scheduler.StepLR(torch.optim.AdamW(network.parameters()), 3).state_dict()
    (found.path / "manifest.json").unlink()
    state = {"optimiser": found.state()["optimiser"], "schedule": {k: v for k, v in schedule.items() if k != "step"}}
    return save_checkpoint(run, about=about, weights=weights, state=state, keep=1)


def older_recipe(**changes: Any) -> dict[str, Any]:
    values = tiny_training(**changes).model_dump(mode="json")
    values["schedule"]["warm_up"] = 0.1
    return values


STEP = {"name": "step"}


def test_an_older_run_that_is_not_finished_is_told_how_to_go_on(dataset: str, tmp_path: Path) -> None:
    run, recipe = tmp_path / "run", tiny_training(epochs=1, steps=None, schedule=STEP)
    reached = train(recipe, data=dataset, run=run)
    make_older(run, older_recipe(epochs=2, steps=None, schedule=STEP))
    longer = tiny_training(epochs=2, steps=None, schedule=STEP)
    with pytest.raises(CheckpointError, match=r"earlier version.*--set training\.start_from=.*in another --out"):
        train(longer, data=dataset, run=run)
    begun = longer.model_copy(update={"start_from": str(run)})
    assert train(begun, data=dataset, run=tmp_path / "second") == 2 * reached


def test_an_older_finished_run_is_left_alone_and_its_weights_serve(dataset: str, tmp_path: Path) -> None:
    run, recipe = tmp_path / "run", tiny_training(schedule=STEP)
    train(recipe, data=dataset, run=run)
    before = make_older(run, older_recipe(schedule=STEP)).stat().st_mtime_ns
    assert train(recipe, data=dataset, run=run) == 8
    assert require_checkpoint(run).path.stat().st_mtime_ns == before
    assert load_trained(run)[2] == 8


def test_a_recipe_with_unknown_keys_is_named_and_its_weights_serve(dataset: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(tiny_training(), data=dataset, run=run)
    folder = make_older(run, older_recipe() | {"forgotten": 3})
    with pytest.raises(CheckpointError, match=rf"{folder}.*training\.forgotten: Extra inputs"):
        train(tiny_training(), data=dataset, run=run)
    _, recipe, step = load_trained(run)
    assert step == 8 and recipe.network == tiny_training().network
    make_older(run, older_recipe() | {"network": {"name": "dsffnet", "forgotten": 3}})
    with pytest.raises(CheckpointError, match=r"training\.network\.dsffnet\.forgotten"):
        load_trained(run)


@pytest.mark.parametrize("kind", [{"name": "one_cycle", "warm_up": 0.1}, {"name": "cosine", "warm_up": 0.0}])
def test_a_default_that_is_spelled_out_is_the_same_learning(kind: dict[str, Any]) -> None:
    without = TrainingRecipe(schedule=ScheduleRecipe(name=kind["name"]))
    without.require_same_learning(TrainingRecipe(schedule=ScheduleRecipe(**kind)), where="run")


def test_an_optimiser_that_was_not_fused_is_so_after_a_resume(dataset: str, tmp_path: Path) -> None:
    train(tiny_training(), data=dataset, run=tmp_path / "run")
    found = require_checkpoint(tmp_path / "run")
    state = found.state()
    state["optimiser"]["param_groups"][0]["fused"] = None
    learner = Learner(tiny_training(), Ranks(0, 1, 0), torch.device("cpu"), steps_per_epoch=3, steps=8)
    learner.load(found, state)
    assert learner.optimiser.param_groups[0]["fused"] is True


def test_weights_where_early_stopping_ended_the_run_are_the_best(dataset: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    recipe = tiny_training(steps=400, learning_rate=0.5, evaluate_every=2, early_stopping=3)
    reached = train(recipe, data=dataset, run=run)
    rows = [row for row in read_journal(run / "metrics.jsonl") if "evaluation/pmd_unseen" in row]
    best = min(rows, key=lambda row: row["evaluation/pmd_unseen"])["step"]
    assert best < reached < 400
    assert load_trained(run)[2] == load_trained(run, "best")[2] == best
    assert load_trained(run, "latest")[2] == load_trained(run, reached)[2] == reached
    assert json.loads((require_checkpoint(run).path / "manifest.json").read_text())["last_step"] == 400
