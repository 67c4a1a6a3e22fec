"""Checks of what networks are given.

Every network takes what passes them, and treats broken numbers alike: a NaN or an infinity in a mesh is not searched
for, and makes all output vertices of its pair NaN, and of no other pair. Norms over the vertices spread it, and the
maximum over the vertices keeps it.
"""

from __future__ import annotations

import torch
from torch import Tensor

PRECISIONS = (torch.float32, torch.float64)
"""Of coordinates and parameters. Norms over thousands of vertices do not bear less; autocast lowers wide products."""


def check_vertices(name: str, mesh: Tensor, dtype: torch.dtype) -> None:
    """Raise ValueError unless `mesh`, called `name`, fits a network whose parameters are of `dtype`.

    It must be ``[batch, vertex, 3]``, with at least one mesh and one vertex, and of the same `dtype`, which must be one
    of `PRECISIONS`.
    """
    _check_precision(f"{name} vertices", mesh.dtype)
    _check_precision("parameters", dtype)
    if mesh.ndim != 3 or mesh.shape[2] != 3 or mesh.shape[0] < 1 or mesh.shape[1] < 1 or mesh.dtype != dtype:
        raise ValueError(
            f"{name} must be a {dtype} tensor of shape [batch, vertex, 3], not empty, "
            f"got {mesh.dtype} of shape {list(mesh.shape)}"
        )


def check_pair(source: Tensor, target: Tensor, dtype: torch.dtype) -> None:
    """Raise ValueError unless both fit (see `check_vertices`) and are equally many."""
    check_vertices("source", source, dtype)
    check_vertices("target", target, dtype)
    if source.shape[0] != target.shape[0]:
        raise ValueError(
            f"source and target must be equally many, got shapes {list(source.shape)} and {list(target.shape)}"
        )


def check_widths(**widths: tuple[int, ...]) -> None:
    """Raise ValueError unless each option, called by its name, is three positive integers."""
    for name, given in widths.items():
        if len(given) != 3 or min(given) < 1:
            raise ValueError(f"{name} must be three positive integers, got {given}")


def check_norm_weights(name: str) -> None:
    """Raise ValueError unless `name` says how much vertices count in norms."""
    if name not in ("uniform", "area"):
        raise ValueError(f"norm_weights must be 'uniform' or 'area', got {name!r}")


def _check_precision(name: str, dtype: torch.dtype) -> None:
    if dtype.is_floating_point and dtype not in PRECISIONS:
        raise ValueError(
            f"{name} must be float32 or float64, got {str(dtype).removeprefix('torch.')}; "
            "for half-precision products use training.precision=bfloat16 (autocast)"
        )
