"""Small recipes that run in a second."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.generate import make_shard
from datagen.generate.plan import plan_of
from datagen.grid import Shard
from datagen.recipe import DatasetRecipe
from training.recipes.training import TrainingRecipe


def tiny_dataset(**changes: Any) -> DatasetRecipe:
    """3 training and 2 evaluation legs of 32 vertices in 6 seen and 4 unseen poses, 4 poses a shard."""
    values: dict[str, Any] = {
        "body": {"family": "leg", "rings": 8, "segments": 4},
        "identities": {"training": 3, "evaluation": 2},
        "poses": {"seen": 6, "unseen": 4},
        "triples": {"count": 5},
        "store": {"poses_per_shard": 4},
    }
    return DatasetRecipe.model_validate(values | changes)


def shards_of(recipe: DatasetRecipe) -> list[Shard]:
    """All shards of a recipe's dataset."""
    return plan_of(recipe).arrays.shards()


def vertices_of(recipe: DatasetRecipe, shard: Shard) -> NDArray[np.float32]:
    """The meshes of a shard, vertices [identity, pose, vertex, 3]."""
    meshes = np.concatenate([vertices for vertices, _ in make_shard(recipe, shard)])
    return meshes.reshape(len(shard.identities), len(shard.poses), shard.vertices, 3)


def tiny_training(**changes: Any) -> TrainingRecipe:
    """A few steps of a few channels, in this process."""
    values: dict[str, Any] = {
        "network": {"encoder_widths": (8, 8, 8), "decoder_widths": (8, 8, 8)},
        "batch": 4,
        "steps": 8,
        "learning_rate": 0.003,
        "schedule": {"name": "one_cycle"},
        "gradient_clip": 1.0,
        "launcher": "inline",
        "device": "cpu",
        "log_every": 1,
        "evaluate_every": 4,
        "evaluate_triples": 3,
        "checkpoint_every": 4,
        "keep_checkpoints": 3,
    }
    return TrainingRecipe.model_validate(values | changes)


LEG: dict[str, str | None] = {"left_hip": None, "left_knee": "left_hip"}
"""The joints of a leg, for the parts network."""

PARTS: dict[str, Any] = {
    "network": {"name": "parts", "joints": LEG, "width": 8, "token_width": 8, "blocks": 1},
    "augmentation": {"subset": 24},
}
"""The parts network in a :func:`tiny_training`."""

MIXED_COUNTS = (32, 30, 30)
"""Vertices of identities 0, 1, 2, then again; the last two have equal counts and different faces."""


def mixed_dataset() -> DatasetRecipe:
    """Five training and three evaluation legs of three kinds."""
    kinds = [(8, 4), (6, 5), (10, 3)]
    bodies = [{"family": "leg", "rings": rings, "segments": segments} for rings, segments in kinds]
    return tiny_dataset(body={"family": "mixed", "bodies": bodies}, identities={"training": 5, "evaluation": 3})
