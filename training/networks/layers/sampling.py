"""The sample of a mesh that statistics are taken over, so that they speak of its surface, not of how it is meshed.

Vertices are thinned to one in each cell of a grid, and weighted by the inverse of their density. Both need vertices
alone, so that a point cloud, a mesh with holes and one whose faces point inwards are all the same; where it is known
what is near along the surface, what merely touches does not count as near.

Where statistics are taken over all vertices, each has a mass by its density in the same way (`vertex_masses`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from training.networks.layers.modulation import full_precision
from training.networks.layers.surface import Surface, of_cells

_CELL = 1 / 32
"""Edge of the grid's cells, half the longest edge of a mesh' box being 1: they thin out what is meshed much more finely
than the rest, no more. Cells of 1/16 cost up to an eighth of the accuracy."""
_BEYOND = 5
"""Coordinates are cut off there, in the same unit, so that no two cells have one number."""
MOST_SAMPLED = 2048
"""Vertices of a mesh that are sampled at most. By half as many dense meshes have an eighth to a quarter more error
(docs/results/parts-experiments.md)."""
_AT_ONCE, _REGION = 512, 0.25
"""So many vertices that are not of the sample are told at a time, region after region; the edge of a region, half the
longest edge of a mesh' box being 1."""
_RADIUS = 0.1
"""Of the Gaussian that counts neighbours: about that of an arm."""
_REACH = 5 * _RADIUS
"""Further off the Gaussian is below 4e-6, and need not be worked out."""
_NODES = 12
"""Of the grid on which all vertices are counted, in half the longest edge of a mesh' box."""


class Surroundings(NamedTuple):
    """What of a sample lies around some vertices of the same meshes.

    Attributes
    ----------
    vertices
        Those around which it lies [b, m, 3].
    near
        Gaussian [b, m, c] of their distances from those of the sample; next to nothing where they merely touch, zero
        in columns that only another mesh of the batch needs.
    columns
        Which of the sample [b, c]; None: all of it.
    per_mass
        One over the mass that is near each [b, m, 1].
    offsets
        How far [b, m, 3] they lie from the middle of what is near, in units of the Gaussian. It points out of the
        surface, the further the more that is curved: a normal that needs no faces.
    """

    vertices: Tensor
    near: Tensor
    columns: Tensor | None
    per_mass: Tensor
    offsets: Tensor

    def mean(self, weighted: Tensor) -> Tensor:
        """Return the mean [b, m, f] of what is near, of the sample's values times its masses [b, k, f]."""
        return self.per_mass * (self.near @ _among(weighted, self.columns))


class Sample(NamedTuple):
    """Some vertices of each mesh.

    Attributes
    ----------
    rows
        Their numbers [b, k].
    masses
        [b, k], about the surface's area around each; they sum to one. Zero: of no account.
    around
        The vertices [b, k, 3] themselves, and what lies around them.
    surface
        Of the meshes, for all their vertices; None: what touches is near.
    apart
        `Surface.apart` of the sample.
    """

    rows: Tensor
    masses: Tensor
    around: Surroundings
    surface: Surface | None
    apart: Tensor | None

    @property
    def vertices(self) -> Tensor:
        """[b, k, 3]."""
        return self.around.vertices

    def moved(self, vertices: Tensor) -> Sample:
        """Return it where its vertices came to lie [b, k, 3]."""
        return _with_masses(self.rows, vertices, self.masses > 0, self.surface, self.apart)

    def mirrored(self) -> Sample:
        """Return it of the meshes' mirror images, of left and right, which are along X."""
        here = self.around
        signs = here.vertices.new_tensor([-1.0, 1.0, 1.0])
        around = here._replace(vertices=here.vertices * signs, offsets=here.offsets * signs)
        return self._replace(around=around)


def masses_by(norm_weights: str, vertices: Tensor) -> Tensor | None:
    """Return `vertex_masses` for ``"area"``, None for ``"uniform"``: what a network's norms take."""
    return vertex_masses(vertices) if norm_weights == "area" else None


@torch.no_grad()
def vertex_masses(vertices: Tensor) -> Tensor:
    """Return the masses [b, n, 1] of vertices [b, n, 3] in the normalised box, about the area around each; in sum one.

    They are the inverse of how many vertices lie near, by a Gaussian: those of a part that is meshed twice as finely
    are half as large. Vertices are counted at the nearest nodes of a grid, the counts blurred there and read between
    the nodes, so that time and memory are linear in the vertices. Counts are whole numbers, the same in any order.
    """
    meshes, count, _ = vertices.shape
    edge = 2 * _NODES + 1
    placed = vertices.nan_to_num().clamp(-1, 1)
    x, y, z = ((placed + 1) * _NODES).round().long().unbind(2)
    number = ((z * edge + y) * edge + x) * meshes + torch.arange(meshes, device=vertices.device)[:, None]
    ones = vertices.new_ones(1).expand(meshes * count)
    density = vertices.new_zeros(edge**3 * meshes).scatter_add(0, number.flatten(), ones)
    nodes = torch.arange(edge, device=vertices.device, dtype=vertices.dtype) / (_NODES * _RADIUS)
    blur = torch.exp(-0.5 * (nodes[:, None] - nodes).square())
    with full_precision(vertices):
        for _ in range(3):  # along the first axis, which then becomes the last: [z, y, x, b] to [b, z, y, x]
            density = (blur @ density.view(edge, -1)).mT.contiguous()
        grid = density.view(meshes, 1, edge, edge, edge)
        near = grid_sample(grid, placed[:, :, None, None], align_corners=True)[:, 0, :, 0]
    broken = vertices.sum((1, 2), keepdim=True) * 0  # not a number where one is
    return 1 / near / (1 / near).sum(dim=1, keepdim=True) + broken


def sample(vertices: Tensor, surface: Surface | None = None) -> Sample:
    """Return some vertices [b, k, 3] of meshes [b, n, 3], whatever the vertices' order (but for ties)."""
    rows, chosen = _thinned(vertices.detach(), surface)
    apart = None if surface is None else surface.apart(rows)
    drawn = _with_masses(rows, taken(vertices, rows), chosen, surface, apart)
    broken = vertices.detach().sum((1, 2), keepdim=True) * 0  # not a number where one is, in the sample or not
    return drawn._replace(masses=drawn.masses + broken[..., 0])


def taken(vertices: Tensor, index: Tensor) -> Tensor:
    """Return the rows [b, k, c] of [b, n, c] by number [b, k]."""
    first = torch.arange(len(index), device=index.device)[:, None] * vertices.shape[1]
    return vertices.flatten(0, 1).index_select(0, (index + first).flatten()).view(*index.shape, -1)


@torch.no_grad()
def _thinned(vertices: Tensor, surface: Surface | None) -> tuple[Tensor, Tensor]:
    """Numbers [b, k] of vertices, and which of them [b, k] are the nearest to the middle of their cells.

    Of more cells than the sample takes (`MOST_SAMPLED`), those are taken whose vertex is nearest to the middle: on a
    body they lie more evenly than a draw (docs/results/parts-experiments.md), but flat faces along the grid may be left
    out as a whole. Layers of a surface that touch have cells of their own.
    """
    scaled = vertices.nan_to_num().clamp(-_BEYOND, _BEYOND) / _CELL
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
    # of a min() torch.export would understand less
    count = vertices.shape[1] if vertices.shape[1] <= MOST_SAMPLED else MOST_SAMPLED
    kept = torch.where(first, -off, -9.0).topk(count, dim=1)
    return order.gather(1, kept.indices), kept.values > -9


def _with_masses(
    rows: Tensor, vertices: Tensor, chosen: Tensor, surface: Surface | None, apart: Tensor | None
) -> Sample:
    """Return the sample of vertices [b, k, 3], each of a mass by how few of the chosen ones [b, k] are near it."""
    told = None if surface is None or apart is None else of_cells(apart, surface.cells.gather(1, rows))
    near = _near(vertices, vertices, told)
    masses = chosen / (near @ chosen.to(near.dtype)[..., None])[..., 0].clamp_min(1e-6)
    masses = masses / masses.sum(dim=1, keepdim=True)
    return Sample(rows, masses, _surroundings(vertices, near, vertices, masses), surface, apart)


def others(vertices: Tensor, drawn: Sample) -> Iterator[tuple[Tensor, Surroundings]]:
    """Yield the vertices that are not in the sample of meshes [b, n, 3], some at a time, with their numbers [b, m].

    They go region by region, so that little of the sample is near any of them; what is out of reach of the box around
    them is left out, but on a GPU and in a graph. Which vertices share a box depends on their order where they are of
    one region: a difference of some 1e-6 in what is read, less than rounding makes.
    """
    count = vertices.shape[1] - drawn.rows.shape[1]
    if not count:
        return
    x, y, z = (vertices.detach().nan_to_num().clamp(-_BEYOND, _BEYOND) / _REGION).floor().long().unbind(2)
    region = ((y * 64 + x) * 64 + z).scatter(1, drawn.rows, 1 << 20)  # the sample last: no region has such a number
    for rows in region.argsort(dim=1, stable=True)[:, :count].split(_AT_ONCE, dim=1):  # type: ignore[no-untyped-call]
        some = taken(vertices, rows)
        columns, inside = _within_reach(some, drawn.vertices)
        told = None
        if drawn.surface is not None and drawn.apart is not None:
            told = of_cells(_columns_of(drawn.apart, columns), drawn.surface.cells.gather(1, rows))
        near = _near(some, _among(drawn.vertices, columns), told)
        if inside is not None and len(inside) > 1:  # a mesh hears what it would hear alone
            near = near * inside[:, None]
        yield rows, _surroundings(some, near, drawn.vertices, drawn.masses, columns)


@torch.no_grad()
def _within_reach(vertices: Tensor, sampled: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Which of a sample [b, k, 3] may be near some vertices [b, m, 3]: numbers [b, c], and of which this is so [b, c].

    There are as many for each mesh as for the one with most. None: all of it, where asking how many would make a GPU
    wait or cut a graph.
    """
    if vertices.is_cuda or torch.compiler.is_compiling():
        return None, None
    low, high = vertices.amin(dim=1, keepdim=True), vertices.amax(dim=1, keepdim=True)
    away = ((low - sampled).clamp_min(0) + (sampled - high).clamp_min(0)).square().sum(dim=2)
    inside = away < _REACH**2
    columns = away.topk(max(int(inside.sum(dim=1).amax()), 1), dim=1, largest=False).indices
    return columns, inside.gather(1, columns)


def _columns_of(apart: Tensor, columns: Tensor | None) -> Tensor:
    """Columns [b, c] of [b, cell, k]."""
    return apart if columns is None else apart.gather(2, columns[:, None].expand(-1, apart.shape[1], -1))


def _surroundings(
    vertices: Tensor, near: Tensor, sampled: Tensor, masses: Tensor, columns: Tensor | None = None
) -> Surroundings:
    weighted = masses[..., None] * torch.cat([sampled, torch.ones_like(sampled[..., :1])], dim=2)
    sums = near @ _among(weighted, columns)
    per_mass = 1 / sums[..., 3:].clamp_min(1e-12)
    return Surroundings(vertices, near, columns, per_mass, (vertices - per_mass * sums[..., :3]) * (2 / _RADIUS))


def _among(values: Tensor, columns: Tensor | None) -> Tensor:
    return values if columns is None else taken(values, columns)


def _near(vertices: Tensor, sampled: Tensor, apart: Tensor | None) -> Tensor:
    """Gaussian [b, n, k] of the distance of vertices [b, n, 3] from those of a sample [b, k, 3], less where they lie
    ``apart``, which is written over.
    """
    one, other = vertices / _RADIUS, sampled / _RADIUS
    unit = torch.ones_like(one[..., :1]), torch.ones_like(other[..., :1])
    halves = -0.5 * one.square().sum(2, keepdim=True), -0.5 * other.square().sum(2, keepdim=True)
    left, right = torch.cat([one, halves[0], unit[0]], dim=2), torch.cat([other, unit[1], halves[1]], dim=2).mT
    exponents = left @ right if apart is None else apart.to(left.dtype).baddbmm_(left, right)
    # -|one - other|^2 / 2 by one product, in place, as passes over [n, k] are what this costs; below that numbers are
    # slow ones
    return exponents.clamp_min_(-60).exp_()
