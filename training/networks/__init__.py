"""The networks by name. Adding one is a file of this folder and a line of `NETWORKS`."""

from __future__ import annotations

from collections.abc import Callable

from torch import nn

from training.networks.corenet3d import CoreNet3D
from training.networks.dsffnet import DSFFNet
from training.networks.npt import NPT
from training.networks.parts import Parts
from training.recipes.networks import NetworkRecipe

NETWORKS: dict[str, Callable[..., nn.Module]] = {
    "corenet3d": CoreNet3D,
    "dsffnet": DSFFNet,
    "npt": NPT,
    "parts": Parts,
}
"""Name in a recipe -> constructor. Networks are called as ``network(source=..., target=...)``, ``[b, n, 3]`` both.

A network may have ``accumulation()``: a context around the parts of a training step, for what must not change between
them. One with ``takes_surfaces`` is told ``source_surface`` and ``target_surface`` where they are known
(:class:`training.networks.layers.surface.Surface`).
"""


def network_from(recipe: NetworkRecipe) -> nn.Module:
    """Return the network that a recipe describes, freshly initialised."""
    return NETWORKS[recipe.name](**recipe.model_dump(exclude={"name"}))
