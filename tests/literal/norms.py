"""Statistics over the vertices of channels-first features ``[b, c, n]``, each of its mass where masses are given."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from training.networks.layers.sampling import vertex_masses


class OverVertices(nn.Module):
    masses: Tensor | None = None
    """``[b, 1, n]``, in sum one; None: all the same."""

    def weights(self, hidden: Tensor) -> Tensor:
        return torch.ones_like(hidden[:, :1]) / hidden.shape[2] if self.masses is None else self.masses

    def mean(self, hidden: Tensor) -> Tensor:
        return (hidden * self.weights(hidden)).sum(dim=2, keepdim=True)


class InstanceNorm(OverVertices):
    def forward(self, hidden: Tensor) -> Tensor:
        if self.masses is None:
            return nn.functional.instance_norm(hidden)
        centred = hidden - self.mean(hidden)
        return centred / torch.sqrt(self.mean(centred.square()) + 1e-5)


def weigh(network: nn.Module, norm_weights: str, vertices: Tensor) -> None:
    """Let the vertices ``[b, n, 3]`` of a mesh count in all statistics of a network as the fast form's option says."""
    for part in network.modules():
        if isinstance(part, OverVertices):
            part.masses = vertex_masses(vertices).mT if norm_weights == "area" else None
