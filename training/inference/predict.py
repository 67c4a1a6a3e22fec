"""Networks from recipes and checkpoints, and running them over meshes."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from datagen.mesh.geometry import Mesh, edges_of
from training.checkpoints.checkpoint import Checkpoint, Which, recipe_of, require_checkpoint
from training.checkpoints.weights import fill_network
from training.networks import network_from
from training.networks.execution import GraphedTransfer
from training.networks.layers.surface import Surface, joined, surface_of
from training.recipes.training import TrainingRecipe

if TYPE_CHECKING:
    from training.data.batch import Batch

_MESHES_AT_ONCE = 8


def load_trained(run: Path, which: Which = "result") -> tuple[nn.Module, TrainingRecipe, int]:
    """Return the network of a run with its weights, the recipe it was trained by, and the step.

    The weights are the newest sound ones or, where early stopping ended the run, the best; or those of ``which``.

    Raises
    ------
    CheckpointError
        The run has no usable checkpoint, or its network is none of this version.
    """
    checkpoint = require_checkpoint(run, which, weights_only=True)
    recipe = recipe_of(checkpoint, network_only=True)
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


def surfaces_of(network: nn.Module, *, sources: Sequence[Mesh], targets: Sequence[Mesh]) -> dict[str, Surface]:
    """What a network takes beside the vertices of meshes: keyword arguments, none for the networks of the papers."""
    if not takes_surfaces(network):
        return {}
    device = next(network.parameters()).device
    return {
        "source_surface": surface_of_meshes(sources).to(device),
        "target_surface": surface_of_meshes(targets).to(device),
    }


def takes_surfaces(network: nn.Module) -> bool:
    """Whether a network is told what is near along the surfaces of its meshes (`training.networks.NETWORKS`)."""
    return bool(getattr(network, "takes_surfaces", False))


def surface_of_meshes(meshes: Sequence[Mesh]) -> Surface:
    """What is near along the surfaces of meshes."""
    return joined([surface_of(mesh.vertices, edges_of(mesh.faces)) for mesh in meshes])


def _predict_mixed(network: nn.Module, batch: "Batch") -> Tensor:
    from training.networks.padded_batches import MixedCounts

    counts = {"source_counts": batch.source_counts, "target_counts": batch.target_counts}
    found: Tensor = MixedCounts(network)(source=batch.source, target=batch.target, **counts, **_told(network, batch))
    return found
