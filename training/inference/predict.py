"""Networks from recipes and checkpoints, and running them over meshes."""

from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from datagen.common.errors import CheckpointError
from training.checkpoints.checkpoint import Checkpoint, recipe_of, require_checkpoint
from training.checkpoints.weights import fill_network
from training.inference.mesh_reading import takes_surfaces
from training.networks import NETWORKS, network_from
from training.networks.execution import GraphedTransfer
from training.networks.layers.surface import Surface
from training.recipes.training import TrainingRecipe

if TYPE_CHECKING:
    from training.data.batch import Batch

_MESHES_AT_ONCE = 8


def load_trained(run: Path) -> tuple[nn.Module, TrainingRecipe, int]:
    """Return the network of a run with its weights, the recipe it was trained by, and the step.

    The weights are the newest sound ones or, where early stopping ended the run, the best.

    Raises
    ------
    CheckpointError
        The run has no usable checkpoint, or its network is none of this version.
    """
    checkpoint = require_checkpoint(run, "result", weights_only=True)
    recipe = recipe_of(checkpoint, network_only=True)
    if recipe.network.name not in NETWORKS:
        raise CheckpointError(
            f"{checkpoint.path} holds network {recipe.network.name!r}, which transfers no poses. "
            f"Name a run of {', '.join(sorted(NETWORKS))}"
        )
    network = network_from(recipe.network)
    load_weights(network, checkpoint)
    return network.eval(), recipe, checkpoint.step


def load_weights(network: nn.Module, checkpoint: Checkpoint) -> None:
    """Give a network the weights of a checkpoint, their moving average where it keeps one.

    Raises
    ------
    CheckpointError
        They are another network's.
    """
    fill_network(network, checkpoint.weights(average=True), where=str(checkpoint.path))


@torch.no_grad()
def predict(network: nn.Module, batch: "Batch") -> Tensor:
    """Output vertices [batch, vertex, 3] in float32 precision, a few meshes at a time so that memory stays bounded.

    Rows after a mesh's count are zero. On a GPU a single pair whose shapes have come before is replayed (see
    :class:`GraphedTransfer`).
    """
    parts = [batch.part(start, start + _MESHES_AT_ONCE) for start in range(0, len(batch), _MESHES_AT_ONCE)]
    if batch.source_counts or batch.target_counts:
        return torch.cat([_predict_mixed(network, part) for part in parts])
    transfer = GraphedTransfer(network)
    return torch.cat([transfer(source=part.source, target=part.target, **_told(network, part)) for part in parts])


def _told(network: nn.Module, batch: "Batch") -> dict[str, Surface]:
    """What a network takes beside vertices."""
    if not takes_surfaces(network) or batch.surfaces is None:
        return {}
    return {"source_surface": batch.surfaces[0], "target_surface": batch.surfaces[1]}


def _predict_mixed(network: nn.Module, batch: "Batch") -> Tensor:
    from training.networks.padded_batches import MixedCounts

    counts = {"source_counts": batch.source_counts, "target_counts": batch.target_counts}
    found: Tensor = MixedCounts(network)(source=batch.source, target=batch.target, **counts, **_told(network, batch))
    return found
