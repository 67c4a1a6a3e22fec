"""The networks by name. Adding one is a file of this folder and a line of `NETWORKS`."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any

from torch import nn

from training.networks.corenet3d import CoreNet3D
from training.networks.dsffnet import DSFFNet
from training.networks.npt import NPT
from training.networks.parts import Parts
from training.recipes.training import NetworkRecipe

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


def build_network(name: str, **options: Any) -> nn.Module:
    """Return a new network.

    Parameters
    ----------
    name
        A key of `NETWORKS`.
    **options
        Keyword arguments of its constructor.

    Raises
    ------
    ValueError
        If there is no network of that name.

    Examples
    --------
    >>> build_network("dsffnet", encoder_widths=(8, 8, 8), decoder_widths=(8, 8, 8)).training
    True
    """
    if name not in NETWORKS:
        nearest = difflib.get_close_matches(name, NETWORKS, n=1, cutoff=0.0)[0]
        raise ValueError(f"unknown network {name!r}; did you mean {nearest!r}? Known: {', '.join(sorted(NETWORKS))}")
    return NETWORKS[name](**options)


def network_from(recipe: NetworkRecipe) -> nn.Module:
    """Return the network that a recipe describes, freshly initialised."""
    return build_network(recipe.name, **recipe.model_dump(exclude={"name"}))
