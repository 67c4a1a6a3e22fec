"""What a training resumes from, what its result is; a recipe of another version is one error, or its weights serve."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from datagen.common.errors import CheckpointError
from datagen.store import open_dataset
from tests.support.recipes import tiny_training
from training.checkpoints.checkpoint import Checkpoint, require_checkpoint, save_checkpoint
from training.checkpoints.folder import manifest_of, write_manifest
from training.engine.distributed import Ranks
from training.engine.tasks.transfer.transfer_task import TransferTask
from training.engine.train_step import Learner
from training.engine.trainer import train
from training.inference.predict import load_trained
from training.recipes.training import ScheduleRecipe, TrainingRecipe
from training.tracking.journal import read_journal


def rewrite(found: Checkpoint, recipe: dict[str, Any]) -> None:
    """Have a checkpoint's manifest tell of another recipe."""
    about = manifest_of(found.path)
    del about["manifest_sha256"]
    write_manifest(found.path, about | {"recipe": recipe})


def test_a_state_without_one_of_its_parts_is_told_how_to_begin_from_its_weights(dataset: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(tiny_training(), data=dataset, run=run)
    found = require_checkpoint(run, 4)
    state = {name: part for name, part in found.state().items() if name != "schedule"}
    about = {name: getattr(found, name) for name in ("recipe", "dataset")}
    for step in (8, 4):
        (run / "checkpoints" / f"step-{step:08d}" / "manifest.json").unlink()
    save_checkpoint(run, about=about | {"step": 4}, weights=found.weights(), state=state, keep=1)
    with pytest.raises(CheckpointError, match=r"KeyError: .*schedule.*--set training\.start_from=.*in another --out"):
        train(tiny_training(), data=dataset, run=run)
    assert train(tiny_training(start_from=str(run)), data=dataset, run=tmp_path / "second") == 8


def test_a_recipe_with_unknown_keys_is_named_and_its_weights_serve(dataset: str, tmp_path: Path) -> None:
    run, recipe = tmp_path / "run", tiny_training().model_dump(mode="json")
    train(tiny_training(), data=dataset, run=run)
    found = require_checkpoint(run)
    rewrite(found, recipe | {"forgotten": 3})
    with pytest.raises(CheckpointError, match=rf"{found.path}.*training\.forgotten: Extra inputs"):
        train(tiny_training(), data=dataset, run=run)
    _, trained_by, step = load_trained(run)
    assert step == 8 and trained_by.network == tiny_training().network
    rewrite(found, recipe | {"network": {"name": "dsffnet", "forgotten": 3}})
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
    task = TransferTask(tiny_training(), open_dataset(dataset))
    learner = Learner(tiny_training(), Ranks(0, 1, 0), torch.device("cpu"), task=task, steps_per_epoch=3, steps=8)
    learner.load(found, state)
    assert learner.optimiser.param_groups[0]["fused"] is True


def test_weights_where_early_stopping_ended_the_run_are_the_best(dataset: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    recipe = tiny_training(steps=400, learning_rate=0.5, evaluate_every=2, early_stopping=3)
    reached = train(recipe, data=dataset, run=run)
    rows = [row for row in read_journal(run / "metrics.jsonl") if "evaluation/pmd_unseen" in row]
    best = min(rows, key=lambda row: row["evaluation/pmd_unseen"])["step"]
    assert best < reached < 400
    assert load_trained(run)[2] == require_checkpoint(run, "best").step == best
    assert require_checkpoint(run, "latest").step == require_checkpoint(run, reached).step == reached
    assert json.loads((require_checkpoint(run).path / "manifest.json").read_text())["last_step"] == 400
