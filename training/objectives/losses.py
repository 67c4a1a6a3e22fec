"""Training losses (DSFFNet, section 3.5): ``L = L_rec + 0.0005 L_edge``, and the variants of other published recipes.

Vertices are ``[batch, vertex, 3]`` in the normalised box (half its longest edge = 1); losses are scalars without unit.
Meshes of one batch may have different numbers of vertices; then rows past a mesh's own are padding, may hold anything,
NaN included, and influence neither a value nor a gradient. Every mesh counts the same, however many vertices it has.
"""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag, mse_loss, pad
from torch.utils.weak import WeakTensorKeyDictionary

from training.networks.execution import sent
from training.recipes.training import TrainingRecipe


class Incidence(NamedTuple):
    """Which edges touch a vertex: those from ``starts[v]`` on, in the order of the list, until the next vertex's.

    Sums over it have a fixed order. Adding with atomic operations has none, and on CUDA gives other bits each time.
    """

    ends: Tensor  # [e, 2] int64
    end_signs: Tensor  # [e, 2] +1, -1
    edges: Tensor  # [2 e] int64
    signs: Tensor  # [2 e] +1 where the vertex is the edge's first end, else -1
    starts: Tensor  # [vertex] int64


INCIDENCES: MutableMapping[Tensor, Incidence] = WeakTensorKeyDictionary()
"""By the tensor of edges, which is not kept alive."""


def incidence_of(pairs: Tensor, vertices: int) -> Incidence:
    """Return the incidence of edges ``[e, 2]`` int64, worked out once and kept as long as the tensor."""
    found = INCIDENCES.get(pairs)
    if found is None or len(found.starts) != vertices:
        found = INCIDENCES[pairs] = make_incidence(pairs.detach(), vertices)  # not `pairs`, which a value would keep
    return found


def make_incidence(pairs: Tensor, vertices: int) -> Incidence:
    """Return the incidence of edges ``[e, 2]`` int64 of so many vertices."""
    at, order = torch.sort(pairs.t().reshape(-1), stable=True)
    return Incidence(
        ends=pairs,
        end_signs=1.0 - 2.0 * torch.arange(2, device=pairs.device).repeat(len(pairs), 1),
        edges=order % len(pairs),
        signs=torch.where(order < len(pairs), 1.0, -1.0),
        starts=torch.searchsorted(at, torch.arange(vertices, device=pairs.device)),
    )


def join_incidences(pairs: Tensor, parts: Sequence[Incidence], rows: int) -> Incidence:
    """Return the incidence of packed edges from those of their meshes, without sorting.

    Parameters
    ----------
    pairs
        ``[e, 2]`` int64, the edges of mesh after mesh, those of mesh `m` shifted by ``m * rows``.
    parts
        The incidence of each mesh, of at most `rows` vertices.
    rows
        To which the vertices of each mesh are padded.
    """
    sizes = [len(part.ends) for part in parts]
    before = [0, *accumulate(sizes)]
    shifted = list(zip(parts, before[:-1], strict=True))
    ends = zip(shifted, before[1:], strict=True)  # padding has no edges: it begins where the next mesh does
    return Incidence(
        ends=pairs.detach(),
        end_signs=torch.cat([part.end_signs for part in parts]),
        edges=torch.cat([part.edges + first for part, first in shifted]),
        signs=torch.cat([part.signs for part in parts]),
        starts=torch.cat(
            [pad(part.starts + 2 * first, (0, rows - len(part.starts)), value=2 * end) for (part, first), end in ends]
        ),
    )


def edge_vectors(rows: Tensor, incidence: Incidence) -> Tensor:
    """Return the vectors ``[e, m, 3]`` of edges, first end minus second, of vertices ``[vertex, 3 m]``."""
    signs = incidence.end_signs.to(rows.dtype)
    return embedding_bag(incidence.ends, rows, mode="sum", per_sample_weights=signs).view(len(signs), -1, 3)


def sum_at_vertices(pull: Tensor, incidence: Incidence) -> Tensor:
    """Return at every vertex the sum of its edges' rows ``[e, k]``, minus those that end there: ``[vertex, k]``."""
    signs = incidence.signs.to(pull.dtype)
    return embedding_bag(incidence.edges, pull, incidence.starts, mode="sum", per_sample_weights=signs)


PAPER = TrainingRecipe()
"""Its loss is that of the DSFFNet paper."""

SHORTEST_EDGE = 1e-6
"""Reference edges of at most this length have no meaningful ratio: they count as perfect. A body is about 2 long."""


@dataclass(frozen=True)
class PackedEdges:
    """Edges of the targets of a batch whose meshes have different topologies.

    Attributes
    ----------
    pairs
        ``[e, 2]`` int64, rows of the padded vertices as one array ``[b * n_target, 3]``: mesh * n_target + vertex.
    meshes
        ``[e]`` int64, the mesh of the batch that each edge is of; ascending.
    """

    pairs: Tensor
    meshes: Tensor

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> PackedEdges:
        """The same on another device."""
        pairs, meshes = (part.to(device, non_blocking=non_blocking) for part in (self.pairs, self.meshes))
        return PackedEdges(pairs, meshes)

    def part(self, start: int, stop: int, *, rows: int) -> PackedEdges:
        """Those of the meshes from ``start`` to ``stop`` of a batch padded to ``rows`` vertices."""
        inside = (self.meshes >= start) & (self.meshes < stop)
        return PackedEdges(self.pairs[inside] - start * rows, self.meshes[inside] - start)


def transfer_loss(
    prediction: Tensor,
    *,
    truth: Tensor,
    target: Tensor,
    edges: Tensor | PackedEdges,
    counts: Sequence[int] | None = None,
    recipe: TrainingRecipe = PAPER,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted loss and its two parts, unweighted and detached.

    Parameters
    ----------
    prediction, truth, target
        ``[b, n, 3]``; padded where `counts` are fewer than ``n``.
    edges
        ``[e, 2]`` int64 of the one topology that all meshes share, or those of each mesh. By what `recipe.edge_sum`
        says they are :func:`loss_edges` of the faces.
    counts
        Vertices of each mesh, ``b`` of them; ``None`` means ``n`` each.
    recipe
        Weights and variants; the default is the paper's. At `edge_weight` 0 (ablation "w/o L_edge") the edge loss is
        still computed, for the log.

    Returns
    -------
    tuple
        The loss, and ``{"reconstruction": ..., "edge": ...}``.

    Raises
    ------
    ValueError
        If shapes or counts do not fit.
    """
    reconstruction = reconstruction_loss(prediction, truth, counts)
    loss = recipe.reconstruction_weight * reconstruction
    edge = edge_length_loss(
        prediction if recipe.edge_weight else prediction.detach(),
        truth if recipe.edge_reference == "truth" else target,
        edges,
        measure=recipe.edge_measure,
        mean_over=recipe.edge_sum,
    )
    if recipe.edge_weight:
        loss = loss + recipe.edge_weight * edge
    return loss, {"reconstruction": reconstruction.detach(), "edge": edge.detach()}


def reconstruction_loss(prediction: Tensor, truth: Tensor, counts: Sequence[int] | None = None) -> Tensor:
    """Return the mean over meshes of the mean over a mesh's vertices of ``|prediction - truth|^2``.

    Parameters
    ----------
    prediction, truth
        ``[b, n, 3]``.
    counts
        Vertices of each mesh; ``None`` means ``n`` each.

    Raises
    ------
    ValueError
        If the shapes differ, or the counts do not fit them.
    """
    _check_pair(prediction, truth)
    meshes, rows, _ = prediction.shape
    if counts is None or (len(counts) == meshes and set(counts) == {rows}):
        return mse_loss(prediction, truth) * 3
    if len(counts) != meshes or min(counts) < 1 or max(counts) > rows:
        raise ValueError(f"counts must be {meshes} numbers from 1 to {rows}, got {list(counts)}")
    vertices = sent(torch.tensor(counts), prediction.device)
    present = torch.arange(rows, device=prediction.device) < vertices.unsqueeze(1)
    # chosen before it is squared: a product with zero would keep the padding's NaN, in the gradient too
    difference = torch.where(present.unsqueeze(2), prediction - truth, 0)
    return (difference.square().sum((1, 2)) / vertices).mean()


def edge_length_loss(
    prediction: Tensor,
    reference: Tensor,
    edges: Tensor | PackedEdges,
    *,
    measure: Literal["length", "squared_length"] = "length",
    mean_over: Literal["edges", "faces"] = "edges",
) -> Tensor:
    """Return the mean over meshes of the mean over a mesh's edges of ``|l_prediction / l_reference - 1|``.

    The equation is garbled in print; this is what its text describes. Edges of the reference not longer than
    `SHORTEST_EDGE` contribute zero (and are counted). Where an edge of the prediction has length zero, so has its
    derivative. The reference is data: it receives no gradient. The gradient is the same bits every time, on CUDA too.

    Parameters
    ----------
    prediction, reference
        ``[b, n, 3]``.
    edges
        ``[e, 2]`` int64, indices of vertices of every mesh, or those of each mesh. How they touch is worked out once
        for a tensor and kept as long as it: use one tensor for all steps, and do not change it in place.
    measure
        What `l` is: a length, or a squared length (DSFFNet's released code).
    mean_over
        ``"faces"``: of the sum of a face's three edges (NPT), which is three times the mean over :func:`loss_edges`.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    _check_pair(prediction, reference)
    if isinstance(edges, Tensor):
        pairs, weights = edges, None
        rows, known = (vertices.transpose(0, 1).reshape(vertices.shape[1], -1) for vertices in (prediction, reference))
    else:
        pairs, weights = edges.pairs, _mesh_weights(edges.meshes, len(prediction), prediction.dtype)
        rows, known = (vertices.reshape(-1, 3) for vertices in (prediction, reference))
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.shape[0] == 0 or pairs.dtype != torch.int64:
        raise ValueError(
            f"edges must be int64 of shape [edge, 2] and not empty, got {pairs.dtype} of {list(pairs.shape)}"
        )
    mean = cast(Tensor, _EdgeError.apply(rows, known, pairs, weights, measure == "squared_length"))  # type: ignore[no-untyped-call]
    return 3 * mean if mean_over == "faces" else mean


def loss_edges(faces: NDArray[np.integer], edge_sum: Literal["edges", "faces"] = "edges") -> NDArray[np.int64]:
    """Return the edges ``[e, 2]`` of triangles ``[f, 3]`` that the edge loss is a mean over, sorted.

    ``"edges"``: each once. ``"faces"``: each as often as a face has it; but each once where that is the same mean, as
    on a closed surface, whose edges are in two faces each.
    """
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1).astype(np.int64)
    edges, occurrences = np.unique(sides, axis=0, return_counts=True)
    if edge_sum == "edges" or np.ptp(occurrences) == 0:
        return edges
    return np.repeat(edges, occurrences, axis=0)


class _EdgeError(torch.autograd.Function):
    """Weighted mean of an edge's error. Vertices are rows of ``3 m`` numbers: ``m`` meshes, or 1 in a packed batch."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, known: Tensor, pairs: Tensor, weights: Tensor | None, squared: bool) -> Tensor:
        incidence = incidence_of(pairs, len(rows))
        differences = edge_vectors(rows, incidence)
        lengths = _lengths(differences, squared)
        reference = _lengths(edge_vectors(known, incidence), squared)
        inverse = torch.where(reference > SHORTEST_EDGE ** (2 if squared else 1), 1 / reference, 0)
        error = (lengths - reference) * inverse
        if ctx.needs_input_grad[0]:
            slope = inverse.mul_(error.sign())
            slope = slope * 2 if squared else torch.where(lengths > 0, slope / lengths, 0)
            slope = slope / error.numel() if weights is None else slope * weights
            ctx.save_for_backward(differences.mul_(slope.unsqueeze(2)).flatten(1))
            ctx.incidence = incidence
        return error.abs().mean() if weights is None else error.abs().mul(weights).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None, None]:
        (pull,) = ctx.saved_tensors
        return sum_at_vertices(pull, ctx.incidence).mul_(gradient), None, None, None, None


def _lengths(differences: Tensor, squared: bool) -> Tensor:
    """Return the lengths ``[e, m]`` of vectors, or their squares."""
    x, y, z = differences.unbind(2)  # three strided products take a third of the time of a sum over an axis of three
    square = x * x + y * y + z * z
    return square if squared else square.sqrt_()


def _mesh_weights(meshes: Tensor, count: int, dtype: torch.dtype) -> Tensor:
    """Return the weight ``[e, 1]`` of every edge in the mean over `count` meshes of the mean over a mesh's edges."""
    edges = torch.zeros(count, dtype=torch.int64, device=meshes.device).index_add_(0, meshes, torch.ones_like(meshes))
    return (count * edges).to(dtype).reciprocal().index_select(0, meshes).unsqueeze(1)


def _check_pair(prediction: Tensor, truth: Tensor) -> None:
    if prediction.shape != truth.shape or prediction.ndim != 3 or prediction.shape[2] != 3:
        shapes = f"{list(prediction.shape)} and {list(truth.shape)}"
        raise ValueError(f"prediction and truth must both be [batch, vertex, 3], got {shapes}")
