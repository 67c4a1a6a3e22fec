"""Which edges touch which vertex: gathering and summing over edges in a fixed order, the same bits on any device."""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, pad
from torch.utils.weak import WeakTensorKeyDictionary


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
