"""Networks from recipes and checkpoints, and running them over meshes."""

from pathlib import Path

import torch
from torch import Tensor, nn

from training.batches import Batch
from training.checkpoint import require_checkpoint
from training.networks import build_network
from training.recipe import NetworkRecipe, TrainingRecipe

_MESHES_AT_ONCE = 8


def network_from(recipe: NetworkRecipe) -> nn.Module:
    """The network that a recipe describes, freshly initialised."""
    return build_network(recipe.name, **recipe.model_dump(exclude={"name"}))


def load_trained(run: Path) -> tuple[nn.Module, TrainingRecipe, int]:
    """The network of a run with its newest sound weights, the recipe it was trained by, and the step.

    Raises
    ------
    CheckpointError
        The run has no usable checkpoint.
    """
    checkpoint = require_checkpoint(run)
    recipe = TrainingRecipe.model_validate(checkpoint.recipe)
    network = network_from(recipe.network)
    network.load_state_dict(checkpoint.weights())
    return network.eval(), recipe, checkpoint.step


@torch.no_grad()
def predict(network: nn.Module, batch: Batch) -> Tensor:
    """Output vertices [batch, vertex, 3], a few meshes at a time so that memory stays bounded."""
    parts = [
        network(
            source=batch.source[start : start + _MESHES_AT_ONCE], target=batch.target[start : start + _MESHES_AT_ONCE]
        )
        for start in range(0, len(batch.source), _MESHES_AT_ONCE)
    ]
    return torch.cat(parts)
