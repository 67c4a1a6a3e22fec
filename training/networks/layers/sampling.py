"""The sample of a mesh that statistics are taken over, so that they speak of its surface, not of how it is meshed.

Vertices are thinned to one in each cell of a grid, and weighted by the inverse of their density. Both need vertices
alone, so that a point cloud, a mesh with holes and one whose faces point inwards are all the same; where it is known
what is near along the surface, what merely touches does not count as near.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from training.networks.layers.surface import Surface, of_cells

_CELL = 1 / 16
"""Edge of the grid's cells, half the longest edge of a mesh' box being 1: a person meets some 900 of them."""
_MOST = 1024
_MOST_AT_ONCE = 1024
_RADIUS = 0.1
"""Of the Gaussian that counts neighbours: about that of an arm."""


class Sample(NamedTuple):
    """Some vertices of each mesh.

    Attributes
    ----------
    rows
        Their numbers [b, k].
    vertices
        [b, k, 3].
    masses
        [b, k], about the surface's area around each; they sum to one. Zero: of no account.
    near
        Gaussian [b, k, k] of their distances from each other; next to nothing between those that merely touch.
    surface
        Of the meshes, for all their vertices; None: what touches is near.
    """

    rows: Tensor
    vertices: Tensor
    masses: Tensor
    near: Tensor
    surface: Surface | None


def sample(vertices: Tensor, surface: Surface | None = None) -> Sample:
    """Return 1,024 vertices [b, k, 3] of meshes [b, n, 3] or fewer, whatever the vertices' order (but for ties)."""
    index, chosen = _thinned(vertices.detach(), surface)
    drawn = with_masses(index, taken(vertices, index), chosen, surface)
    broken = vertices.detach().sum((1, 2), keepdim=True) * 0  # not a number where one is, in the sample or not
    return drawn._replace(masses=drawn.masses + broken[..., 0])


def taken(vertices: Tensor, index: Tensor) -> Tensor:
    """Return the rows [b, k, c] of [b, n, c] by number [b, k]."""
    return vertices.gather(1, index[..., None].expand(-1, -1, vertices.shape[2]))


@torch.no_grad()
def _thinned(vertices: Tensor, surface: Surface | None) -> tuple[Tensor, Tensor]:
    """Numbers [b, k] of vertices, and which of them [b, k] are the nearest to the middle of their cells.

    Layers of a surface that touch have cells of their own.
    """
    scaled = vertices.nan_to_num().clamp(-8, 8) / _CELL
    cell = scaled.floor()
    off = (scaled - cell - 0.5).square().sum(dim=2)
    x, y, z = cell.long().unbind(2)
    number = (x * 512 + y) * 512 + z
    if surface is not None:
        number = number + (surface.cells << 27)
    order = off.argsort(dim=1, stable=True)
    order = order.gather(1, number.gather(1, order).argsort(dim=1, stable=True))
    ordered = number.gather(1, order)
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[:, 1:] = ordered[:, 1:] != ordered[:, :-1]
    off = off.gather(1, order)
    count = vertices.shape[1] if vertices.shape[1] <= _MOST else _MOST  # of a min() torch.export would understand less
    kept = torch.where(first, -off, -9.0).topk(count, dim=1)
    return order.gather(1, kept.indices), kept.values > -9


def with_masses(index: Tensor, vertices: Tensor, chosen: Tensor, surface: Surface | None) -> Sample:
    """Return the sample of vertices [b, k, 3], each of a mass by how few of the chosen ones [b, k] are near it."""
    apart = None if surface is None else of_cells(surface.apart(index), surface.at(index).cells)
    near = _near(vertices, vertices, apart)
    masses = chosen / (near @ chosen.to(near.dtype)[..., None])[..., 0].clamp_min(1e-6)
    return Sample(index, vertices, masses / masses.sum(dim=1, keepdim=True), near, surface)


def nearness(vertices: Tensor, drawn: Sample) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield all vertices [b, n, 3] of the meshes, some [b, m, 3] at a time, each with its Gaussian [b, m, k]."""
    surface, start = drawn.surface, 0
    apart = None if surface is None else surface.apart(drawn.rows)
    for some in vertices.split(_MOST_AT_ONCE, dim=1):  # type: ignore[no-untyped-call]
        told = None
        if surface is not None and apart is not None:
            told = of_cells(apart, surface.cells[:, start : start + some.shape[1]])
        start += some.shape[1]
        yield some, _near(some, drawn.vertices, told)


def offsets(vertices: Tensor, near: Tensor, drawn: Sample) -> Tensor:
    """Return how far [b, n, 3] vertices lie from the middle of the sample near them, in units of the Gaussian.

    It points out of the surface, the further the more that is curved: a normal that needs no faces.
    """
    weighted = drawn.masses[..., None] * torch.cat([drawn.vertices, torch.ones_like(drawn.vertices[..., :1])], dim=2)
    sums = near @ weighted
    return (vertices - sums[..., :3] / sums[..., 3:].clamp_min(1e-12)) * (2 / _RADIUS)


def _near(vertices: Tensor, others: Tensor, apart: Tensor | None) -> Tensor:
    """Gaussian [b, n, k] of the distance of vertices [b, n, 3] from others [b, k, 3], less where they lie ``apart``."""
    one, other = vertices / _RADIUS, others / _RADIUS
    unit = torch.ones_like(one[..., :1]), torch.ones_like(other[..., :1])
    halves = -0.5 * one.square().sum(2, keepdim=True), -0.5 * other.square().sum(2, keepdim=True)
    left, right = torch.cat([one, halves[0], unit[0]], dim=2), torch.cat([other, unit[1], halves[1]], dim=2).mT
    exponents = left @ right if apart is None else torch.baddbmm(apart.to(left.dtype), left, right)
    # -|one - other|^2 / 2 by one product, as passes over [n, k] are what this costs; below that numbers are slow ones
    return torch.exp(exponents.clamp_min(-60))
