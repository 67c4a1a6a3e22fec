"""Checks of what networks are given."""

from __future__ import annotations

import torch
from torch import Tensor


def check_vertices(name: str, mesh: Tensor, dtype: torch.dtype) -> None:
    """Raise ValueError unless `mesh`, called `name`, is ``[batch, vertex, 3]``, not empty, and of `dtype`."""
    if mesh.ndim != 3 or mesh.shape[2] != 3 or mesh.shape[1] < 1 or mesh.dtype != dtype:
        raise ValueError(
            f"{name} must be a {dtype} tensor of shape [batch, vertex, 3], got {mesh.dtype} of shape {list(mesh.shape)}"
        )
