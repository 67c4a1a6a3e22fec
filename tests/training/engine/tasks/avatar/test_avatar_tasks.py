"""The template and the avatar of an outfit are learned by the trainer of everything else: resumed, measured."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen.common.errors import CheckpointError, DatasetError
from tests.support.shapes.outfits import drawn_outfit
from training.avatar.outfit import Outfit
from training.avatar.template import extract_template, plainest_pose
from training.checkpoints.checkpoint import require_checkpoint
from training.checkpoints.weights import fill_network
from training.engine.tasks.avatar.frames import FrameOrder, drawn
from training.engine.tasks.registry import task_of
from training.engine.train_step import Learner
from training.engine.trainer import train
from training.inference.predict import load_trained
from training.recipes.training import TrainingRecipe
from training.tracking.journal import read_journal
from workflows.avatar.runs import trained
from workflows.pipeline.run_folder import RunFolder

TEMPLATE = {"name": "template", "width": 32, "points": 300}
AVATAR = {"name": "avatar", "map_size": 16, "unet_width": 2, "hidden_width": 16, "geometry": 8, "pose": 8,
          "features_rate": 2.0, "scan_points": 300, "normals_from": 0.5}  # fmt: skip


def recipe_of(network: dict[str, Any], **changes: Any) -> TrainingRecipe:
    given = {"batch": 3, "steps": 6, "optimiser": "adam", "learning_rate": 2e-3, "weight_decay": 0, "device": "cpu"}
    often = {"schedule": {"name": "constant"}, "evaluate_every": 100, "log_every": 1}
    return TrainingRecipe.model_validate({"network": network, **given, **often, **changes})


@pytest.fixture(scope="module")
def outfit(tmp_path_factory: pytest.TempPathFactory) -> Outfit:
    return drawn_outfit(tmp_path_factory.mktemp("outfits"))


def test_frames_are_all_shown_in_every_epoch_and_mixed() -> None:
    order = FrameOrder([[0, 2, 5], [1, 3]], batch=2, seed=4)
    assert (order.cells, order.steps_per_epoch) == (5, 2)
    rows = [order.epoch(number) for number in (0, 1)]
    assert all({*map(tuple, its.tolist())} == {(0, 0), (0, 2), (0, 5), (1, 1), (1, 3)} for its in rows)
    assert not np.array_equal(*rows) and np.array_equal(rows[0], order.epoch(0))
    with pytest.raises(DatasetError, match="2 frames to learn from, fewer than a batch of 3"):
        FrameOrder([[0, 1]], batch=3, seed=0)
    assert not np.array_equal(drawn(0, 1, 0, of=50, count=9), drawn(0, 1, 1, of=50, count=9))


def test_a_template_is_learned_and_extracted(outfit: Outfit, tmp_path: Path) -> None:
    recipe = recipe_of(TEMPLATE, steps=150, gradient_clip=0.1)
    assert train(recipe, data=str(outfit.path), run=tmp_path) == 150
    rows = read_journal(tmp_path / "metrics.jsonl")
    assert rows[-1]["evaluation/iou_seen"] > 0.5, "near the surface, where half of the points are inside"
    assert rows[-1]["evaluation/iou_unseen"] > 0.4 and rows[-1]["loss/total"] < 0.7 * rows[0]["loss/total"]
    network = task_of(recipe, str(outfit.path)).network()
    fill_network(network, require_checkpoint(tmp_path).weights(), where="")
    samples = outfit.samples.load()
    template = extract_template(network, plainest_pose(samples.conditions), outfit.field.load(), cell=0.04)
    subject = outfit.subject.load()
    away = torch.cdist(template.vertices, torch.from_numpy(subject.body.vertices).float()).min(dim=1).values
    assert away.mean() < 0.06 and torch.allclose(template.weights.sum(dim=1), torch.ones(()), atol=1e-3)


def test_an_avatar_comes_nearer_to_its_scans(outfit: Outfit, tmp_path: Path) -> None:
    recipe = recipe_of(AVATAR | {"hidden_width": 32}, steps=120, evaluate_every=40, learning_rate=3e-3)
    train(recipe, data=str(outfit.path.parent), run=tmp_path)
    key = "evaluation/plane_unseen"
    planes = [row[key] for row in read_journal(tmp_path / "metrics.jsonl") if key in row]
    assert planes[-1] < 5.5, "the leg is a centimetre below its stocking"


@pytest.mark.parametrize("network", [TEMPLATE, AVATAR], ids=["template", "avatar"])
def test_a_stopped_training_goes_on_to_the_same_weights(
    network: dict[str, Any], outfit: Outfit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, place = recipe_of(network, checkpoint_every=3), outfit.path if network is TEMPLATE else outfit.path.parent
    train(recipe, data=str(place), run=tmp_path / "whole")
    step, left = Learner.step, [4]

    def is_killed(*arguments: Any, **more: Any) -> Any:
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt
        return step(*arguments, **more)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Learner, "step", is_killed)
        train(recipe, data=str(place), run=tmp_path / "parts")
    assert require_checkpoint(tmp_path / "parts").step == 3
    assert train(recipe, data=str(place), run=tmp_path / "parts") == 6
    whole, parts = (require_checkpoint(tmp_path / name).weights() for name in ("whole", "parts"))
    assert all(torch.equal(whole[name], parts[name]) for name in whole)


def test_an_avatar_is_resumed_on_no_other_templates(outfit: Outfit, tmp_path: Path) -> None:
    other = drawn_outfit(tmp_path / "outfits")
    train(recipe_of(AVATAR, steps=1), data=str(outfit.path.parent), run=tmp_path / "run")
    template = other.template.load()
    other.template.path.unlink()
    type(template)(template.vertices + 0.1, template.faces, template.normals, template.weights).save(
        other.template.path
    )
    recipe, place = recipe_of(AVATAR, steps=1), other.path.parent
    with pytest.raises(CheckpointError, match="was trained on dataset"):
        train(recipe, data=str(place), run=tmp_path / "run")
    with pytest.raises(CheckpointError, match="was trained on dataset"):
        trained(recipe, place, RunFolder(tmp_path / "run"), section="avatar")
    assert not trained(recipe, outfit.path.parent, RunFolder(tmp_path / "run"), section="avatar").training


def test_an_avatar_transfers_no_poses(outfit: Outfit, tmp_path: Path) -> None:
    train(recipe_of(AVATAR, steps=1), data=str(outfit.path.parent), run=tmp_path)
    with pytest.raises(CheckpointError, match="network 'avatar', which transfers no poses"):
        load_trained(tmp_path)
