"""Features on their way into a bfloat16 product: less a constant first, since rounding errors grow with the size."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

SAMPLED = 16
"""One vertex in this many decides such a constant: any near the mean will do."""


def centred_for_autocast(features: Tensor) -> Tensor:
    """Return ``[b, n, c]`` features as autocast's products take them; without autocast the features themselves.

    Under bfloat16 a constant is taken from each channel of each mesh: about its mean. What follows must not depend on
    such constants, as an instance norm after a linear layer does not.
    """
    device = features.device.type
    if not torch.is_autocast_enabled(device) or features.dtype != torch.float32:
        return features
    constant = features.detach()[:, ::SAMPLED].mean(dim=1, keepdim=True)
    if torch.compiler.is_compiling():
        return (features - constant).to(torch.get_autocast_dtype(device))
    return cast(Tensor, _Centred.apply(features, constant, torch.get_autocast_dtype(device)))  # type: ignore[no-untyped-call]


class _Centred(torch.autograd.Function):
    """Difference and rounding in one pass over memory."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, constant: Tensor, dtype: torch.dtype) -> Tensor:
        return torch.sub(features, constant, out=torch.empty_like(features, dtype=dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return gradient.float(), None, None
