"""The implicit template of a person in clothes: an occupancy network in canonical space (FITE, Lin et al. 2022)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

_SHARPNESS = 100.0


class OccupancyTemplate(nn.Module):
    """Whether canonical points are inside of a dressed person, under a pose: a logit, positive inside.

    An MLP of nine layers with softplus (beta 100) and weight normalisation. After the fourth the point and the pose,
    linearly reduced to eight numbers, join it: ``[h, condition, x] / sqrt 2``. It starts as about a ball (Atzmon and
    Lipman 2020): weights N(0, sqrt(2 / out)), biases 0, and last weights N(-sqrt(pi / width), 1e-4), last bias 1. At
    the default width, and with 69 numbers a pose, it has 465,708 parameters.

    Parameters
    ----------
    centre, radius
        Of a ball around the body, metres: the network sees points from its centre, its radius being one.
    condition
        Numbers of a pose.
    width
        Of the hidden layers.
    """

    centre: Tensor
    radius: Tensor

    def __init__(
        self, *, centre: Sequence[float] = (0, 0, 0), radius: float = 1.0, condition: int = 69, width: int = 256
    ) -> None:
        super().__init__()
        self.register_buffer("centre", torch.tensor(centre, dtype=torch.float32))
        self.register_buffer("radius", torch.tensor(radius, dtype=torch.float32))
        self.condition = nn.Linear(condition, _REDUCED)
        self.before = nn.ModuleList([_layer(3, width), *(_layer(width, width) for _ in range(2))])
        self.before.append(_layer(width, width - 3))
        self.after = nn.ModuleList([_layer(width + _REDUCED, width), *(_layer(width, width) for _ in range(3))])
        self.last = _last_layer(width)

    def forward(self, points: Tensor, pose: Tensor) -> Tensor:
        """Logits [b, n] at points [b, n, 3] under poses [b, condition]."""
        at = (points - self.centre) / self.radius
        reduced = self.condition(pose)[:, None].expand(-1, points.shape[1], -1)
        hidden = at
        for layer in self.before:
            hidden = _softplus(layer(hidden))
        hidden = torch.cat([hidden, reduced, at], dim=-1) / 2**0.5
        for layer in self.after:
            hidden = _softplus(layer(hidden))
        logits: Tensor = self.last(hidden)[..., 0]
        return logits


_REDUCED = 8


def _softplus(values: Tensor) -> Tensor:
    return nn.functional.softplus(values, beta=_SHARPNESS)


def _layer(inputs: int, outputs: int) -> nn.Module:
    layer = nn.Linear(inputs, outputs)
    nn.init.normal_(layer.weight, 0.0, (2 / outputs) ** 0.5)
    nn.init.zeros_(layer.bias)
    return weight_norm(layer)


def _last_layer(width: int) -> nn.Module:
    layer = nn.Linear(width, 1)
    nn.init.normal_(layer.weight, -((torch.pi / width) ** 0.5), 1e-4)
    nn.init.ones_(layer.bias)
    return weight_norm(layer)
