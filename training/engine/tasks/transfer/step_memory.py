"""What a step takes at least, known before any memory is taken; a recipe that no memory could hold is refused.

Linux grants memory that it does not have and kills who uses it, so that most of what is too large would end without a
word.
"""

import math

import torch

from datagen.common.errors import RecipeError
from datagen.common.resources import bytes_text
from datagen.store import Dataset
from training.data.cache_policy import Room
from training.networks import network_from
from training.recipes.networks import NetworkRecipe
from training.recipes.training import TrainingRecipe

_PARAMETER = 16
"""Bytes of a parameter: itself, its gradient, the optimiser's two means."""
_ACTIVATIONS = 3 * 4
"""Bytes a vertex and channel that a step holds; measured: DSFFNet 3.1 to 5.6 float32, NPT 10 to 12, 3D-CoreNet 20."""
_NARROW = 2_048
"""Networks of no wider layers fit anywhere; to count the parameters of others exactly takes seconds."""


def require_step_memory(recipe: TrainingRecipe, dataset: Dataset, room: Room, *, ranks: int = 1) -> None:
    """Raise if a step of one of the ranks needs more than the room of its device.

    Raises
    ------
    RecipeError
        It does; the message names what to lower.
    """
    most = max((dataset.vertex_count(identity) for identity in dataset.identities("training")), default=0)
    most = recipe.augmentation.subset or most
    meshes = math.ceil(recipe.batch / (ranks * recipe.accumulate))
    widths = _widths(recipe.network)
    needed = least_step_bytes(recipe, most, meshes=meshes, processes=room.sharers)
    if needed > room.free:
        alone = least_step_bytes(recipe, most, meshes=1, processes=room.sharers) > room.free
        lower = "training.network's widths" if alone else "training.batch, or raise training.accumulate"
        raise RecipeError(
            f"a training step takes at least {bytes_text(needed)} ({meshes:,} meshes of {most:,} vertices at a time, "
            f"widths {', '.join(map(str, widths))}), but the {room.where} has {bytes_text(room.free)} free. "
            f"Lower {lower}"
        )


def least_step_bytes(recipe: TrainingRecipe, vertices: int, *, meshes: int, processes: int) -> float:
    """The memory that a step of so many meshes at a time takes at least, of processes that share it."""
    readings = 2 if recipe.augmentation.at_rest else 1
    of_a_mesh = readings * _ACTIVATIONS * sum(_widths(recipe.network)) * vertices
    return processes * (_PARAMETER * _parameters(recipe.network) + meshes * of_a_mesh)


def _widths(network: NetworkRecipe) -> list[int]:
    values = network.model_dump().items()
    lists = [width for name, widths in values if name.endswith("_widths") for width in widths]
    return lists + [width for name, width in values if name.endswith("width")]


def _parameters(network: NetworkRecipe) -> float:
    """How many parameters a network has; 0 of a narrow one, infinite where no computer could address them."""
    if max(_widths(network)) <= _NARROW:
        return 0
    try:
        with torch.device("meta"):
            return sum(parameter.numel() for parameter in network_from(network).parameters())
    except RuntimeError:
        return math.inf
