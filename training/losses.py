"""Training losses (DSFFNet, section 3.5): ``L = L_rec + 0.0005 L_edge``.

Vertices are ``[batch, vertex, 3]`` in the normalised box (half its longest edge = 1); losses are scalars without unit.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

EDGE_WEIGHT = 0.0005
"""Weight of the edge-length loss (DSFFNet, section 4.1)."""

SHORTEST_EDGE = 1e-6
"""Reference edges of at most this length have no meaningful ratio: they count as perfect. A body is about 2 long."""


def reconstruction_loss(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over meshes and vertices of ``|prediction - truth|^2``.

    Parameters
    ----------
    prediction, truth
        ``[b, n, 3]``.

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    _check_pair(prediction, truth)
    return torch.nn.functional.mse_loss(prediction, truth) * 3


def edge_lengths(vertices: Tensor, edges: Tensor) -> Tensor:
    """Return the lengths ``[b, e]`` of `edges` (``[e, 2]`` int64) in `vertices` (``[b, n, 3]``), without derivative."""
    with torch.no_grad():
        return _edges(vertices, edges)[1].t()


def edge_length_loss(prediction: Tensor, reference: Tensor, edges: Tensor, *, lengths: Tensor | None = None) -> Tensor:
    """Return the mean over meshes and edges of ``|l_prediction / l_reference - 1|``.

    The equation is garbled in print; this is what its text describes. Edges of the reference not longer than
    `SHORTEST_EDGE` contribute zero (and are counted). Where an edge of the prediction has length zero, so has its
    derivative. The reference is data: it receives no gradient.

    Parameters
    ----------
    prediction, reference
        ``[b, n, 3]``.
    edges
        ``[e, 2]`` int64, indices of vertices.
    lengths
        The reference's `edge_lengths`, ``[b, e]``, where they are known already.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    _check_pair(prediction, reference)
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.shape[0] == 0 or edges.dtype != torch.int64:
        raise ValueError(
            f"edges must be int64 of shape [edge, 2] and not empty, got {edges.dtype} of {list(edges.shape)}"
        )
    if lengths is None:
        lengths = edge_lengths(reference, edges)
    elif lengths.shape != (prediction.shape[0], edges.shape[0]):
        raise ValueError(f"lengths must be [{prediction.shape[0]}, {edges.shape[0]}], got {list(lengths.shape)}")
    return cast(Tensor, _EdgeLengthLoss.apply(prediction, lengths.t(), edges))  # type: ignore[no-untyped-call]


def pose_transfer_loss(
    prediction: Tensor, truth: Tensor, edges: Tensor, edge_weight: float = EDGE_WEIGHT
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return ``L_rec + edge_weight L_edge`` and its two parts, detached, as ``{"reconstruction": ..., "edge": ...}``.

    Parameters
    ----------
    prediction, truth
        ``[b, n, 3]``.
    edges
        ``[e, 2]`` int64.
    edge_weight
        0 is the ablation "w/o L_edge"; the edge loss is then still computed, for the log.
    """
    reconstruction = reconstruction_loss(prediction, truth)
    edge = edge_length_loss(prediction, truth, edges)
    parts = {"reconstruction": reconstruction.detach(), "edge": edge.detach()}
    return reconstruction + edge_weight * edge, parts


class _EdgeLengthLoss(torch.autograd.Function):
    """Meshes last: a vertex is one row of ``3 b`` numbers, so that gathering and adding rows are contiguous."""

    @staticmethod
    def forward(ctx: Any, prediction: Tensor, reference: Tensor, edges: Tensor) -> Tensor:
        differences, lengths = _edges(prediction, edges)
        inverse = torch.where(reference > SHORTEST_EDGE, 1 / reference, 0)
        error = torch.where(reference > SHORTEST_EDGE, (lengths - reference) * inverse, 0)
        ctx.save_for_backward(differences, lengths, inverse, error, edges)
        ctx.vertices = prediction.shape[1]
        return error.abs().mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        differences, lengths, inverse, error, edges = ctx.saved_tensors
        direction = torch.where(lengths > 0, inverse / lengths, 0).mul_(error.sign()).mul_(gradient / error.numel())
        pull = (differences * direction.unsqueeze(2)).flatten(1)
        total = pull.new_zeros(ctx.vertices, pull.shape[1])
        total.index_add_(0, edges[:, 0], pull).index_add_(0, edges[:, 1], pull, alpha=-1)
        return total.view(ctx.vertices, -1, 3).transpose(0, 1), None, None


def _edges(vertices: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
    """Return the edges' vectors ``[e, b, 3]`` and lengths ``[e, b]``."""
    rows = vertices.transpose(0, 1).reshape(vertices.shape[1], -1)
    differences = (rows.index_select(0, edges[:, 0]) - rows.index_select(0, edges[:, 1])).view(edges.shape[0], -1, 3)
    x, y, z = differences.unbind(2)  # three strided products take a third of the time of a sum over an axis of three
    return differences, torch.sqrt(x * x + y * y + z * z)


def _check_pair(prediction: Tensor, truth: Tensor) -> None:
    if prediction.shape != truth.shape or prediction.ndim != 3 or prediction.shape[2] != 3:
        shapes = f"{list(prediction.shape)} and {list(truth.shape)}"
        raise ValueError(f"prediction and truth must both be [batch, vertex, 3], got {shapes}")
