"""Giving an output of another network the rigid parts of its target, by weights that the parts network reads off it.

Departure from the DSFFNet paper, which ends at the network's output: this is an option, off by default. Each part of
the target is turned and moved as near to the output as it goes (Kabsch's method, one scale for all parts), and the
vertices follow by linear blend skinning, so that the target's shape stays as it is within a part.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from datagen.common.errors import RecipeError
from training.inference.predict import load_trained
from training.networks.layers.modulation import full_precision
from training.networks.layers.rigid_parts import matrices, skinned
from training.networks.layers.sampling import Sample, sample, taken
from training.networks.layers.surface import Surface
from training.networks.parts import Parts

PROJECTED = " on parts"
"""After the name of a method in tables, where its outputs are projected."""
_STIFFNESS = 1e-6
"""Of a part that has next to no vertices: it stays as it is turned in the target."""


class OntoParts(nn.Module):
    """A network whose outputs are projected onto rigid parts of their targets.

    Parameters
    ----------
    network
        Called as ``network(source=..., target=...)``.
    parts
        Says which part each vertex of the target belongs to.
    """

    takes_surfaces = True
    network: nn.Module
    parts: Parts

    def __init__(self, network: nn.Module, parts: Parts) -> None:
        super().__init__()
        self.network, self.parts = network, parts

    @classmethod
    def of(cls, network: nn.Module, weights: Path) -> OntoParts:
        """The network with the parts network of a run or of weights.

        Raises
        ------
        CheckpointError
            There are no such weights.
        RecipeError
            They are of another network, or both are parts networks.
        """
        parts = load_trained(weights)[0]
        if not isinstance(parts, Parts):
            raise RecipeError(
                f"--project takes weights of a parts network, but {weights} are those of {type(parts).__name__}: name "
                "human or animals"
            )
        if isinstance(network, Parts):
            raise RecipeError("a parts network's output lies on rigid parts already: leave out --project")
        return cls(network, parts.to(next(network.parameters()).device)).eval()

    @torch.no_grad()
    def forward(self, *, source: Tensor, target: Tensor, **surfaces: Surface) -> Tensor:
        """Return ``[b, n_target, 3]`` for ``[b, n_source, 3]`` and ``[b, n_target, 3]``, each in its normalised box.

        Of the ``surfaces`` that :func:`training.inference.mesh_reading.surfaces_of` finds, the target's is read.
        """
        output = self.network(source=source, target=target)
        with full_precision(target):
            drawn = sample(target, surfaces.get("target_surface"))
            return projected(output, target, self.parts.skinning_weights(drawn, target), drawn)


def projected(output: Tensor, target: Tensor, weights: Tensor, drawn: Sample) -> Tensor:
    """Return the target's vertices [b, n, 3], its parts where those of the output are.

    Parameters
    ----------
    output, target
        [b, n, 3].
    weights
        Skinning weights [b, n, part].
    drawn
        Of the target: how much of the surface each vertex stands for.
    """
    broken = output.sum((1, 2), keepdim=True) * 0  # not a number where one is
    output = output.nan_to_num(0, 0, 0)
    shares = taken(weights, drawn.rows) * drawn.masses[..., None]
    mass = shares.sum(1).clamp_min(1e-9)[..., None]
    of_parts = shares.mT / mass
    there, here = taken(output, drawn.rows), taken(target, drawn.rows)
    goal, middle = of_parts @ there, of_parts @ here
    products = (there[..., :, None] * here[..., None, :]).flatten(2)
    crossed = matrices(of_parts @ products) - goal[..., :, None] * middle[..., None, :]
    stiff = _STIFFNESS * torch.eye(3, dtype=output.dtype, device=output.device)
    left, size, right = torch.linalg.svd(crossed + stiff)
    sign = torch.linalg.det(left @ right).sign()
    left = torch.cat([left[..., :2], left[..., 2:] * sign[..., None, None]], dim=-1)
    fits = size[..., 0] + size[..., 1] + sign * size[..., 2]
    spread = (of_parts @ here.square()).sum(2) - middle.square().sum(2)
    scale = (mass[..., 0] * fits).sum(1) / (mass[..., 0] * spread).sum(1).clamp_min(1e-9)
    turns = scale[:, None, None, None] * (left @ right)
    return skinned(target, weights, turns, middle, goal) + broken
