"""What lies near along the surface of a mesh, so that a hand on a thigh is not taken for the thigh's.

Two vertices may touch and yet belong to far parts of a body. The mesh' edges tell: the way from one to the other along
the surface is long. Vertices are gathered into cells, and of cells it is known which are near each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor
from torch.nn.functional import pad

from datagen.common.arrays import Floats
from datagen.mesh.geometry import bounding_box

_CUBES = (0.1, 0.125, 0.16, 0.2)
"""Edges of the grid's cubes, half the longest edge of a mesh' box being 1: the first that gives few enough cells. Where
none does, as in hair, all is near all."""
_MOST_CELLS = 1000
_CRUMB = 0.01
"""Of the vertices: a piece with fewer is near to all, lest triangles that share no vertices be cells each."""
_FAR = 0.35
"""Length of a way along the surface: three and a half times the radius within which the network looks."""


_ELSEWHERE = (1.0, np.sqrt(2), np.sqrt(3))
"""A product with it is the same for vertices at one place, and for others by chance alone."""
_NOT_NEAR = float(np.log(1e-4))


class Surface(NamedTuple):
    """What is near along the surfaces of some meshes.

    Attributes
    ----------
    cells
        The number of each vertex' cell [b, n].
    near
        Which cells [b, cell, cell] are near each other along the surface; those of pieces that no edge joins are, too.
    """

    cells: Tensor
    near: Tensor

    def to(self, device: torch.device | str) -> Surface:
        """The same on another device."""
        return Surface(self.cells.to(device), self.near.to(device))

    def of(self, meshes: Sequence[int] | slice, vertices: int | None = None) -> Surface:
        """Those of some meshes, of so many vertices; None: all."""
        return Surface(self.cells[meshes, :vertices], self.near[meshes])

    def at(self, rows: Tensor) -> Surface:
        """Those of the vertices of these numbers [b, k] alone."""
        return Surface(self.cells.gather(1, rows), self.near)

    def apart(self, rows: Tensor) -> Tensor:
        """What the exponent of a Gaussian loses [b, cell, k] between a cell and the vertices of these numbers [b, k].

        Of what is not near the Gaussian counts next to nothing, which is all that there is where nothing is near.
        """
        cells = self.cells.gather(1, rows)
        near = self.near.gather(2, cells[:, None].expand(-1, self.near.shape[1], -1))
        return torch.where(near, 0.0, _NOT_NEAR)


def of_cells(apart: Tensor, cells: Tensor) -> Tensor:
    """Return the rows [b, n, k] of `Surface.apart` [b, cell, k] for vertices of these cells [b, n]."""
    first = torch.arange(len(apart), device=cells.device)[:, None] * apart.shape[1]
    return apart.flatten(0, 1).index_select(0, (cells + first).flatten()).view(*cells.shape, -1)


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Return the surfaces of several meshes as those of one batch, padded where they are smaller."""
    vertices, cells = (max(each[place].shape[1] for each in surfaces) for place in range(2))
    return Surface(
        torch.cat([pad(each.cells, (0, vertices - each.cells.shape[1])) for each in surfaces]),
        torch.cat([pad(each.near, (0, cells - each.near.shape[1]) * 2) for each in surfaces]),
    )


def surface_of(vertices: Floats, edges: NDArray[np.integer]) -> Surface:
    """Return the surface of one mesh.

    A cell is what edges join within a cube of a grid; vertices at one place are one, as at the seams of textures. Ways
    are measured between the middles of cells, so that noise of vertices hardly makes them longer.

    Parameters
    ----------
    vertices
        [n, 3] in any unit.
    edges
        [e, 2]; without any all is near all.
    """
    vertices = np.asarray(vertices, np.float64)
    _, first, point_of = np.unique(vertices @ _ELSEWHERE, return_index=True, return_inverse=True)
    placed, count = np.nan_to_num(bounding_box(vertices).normalise(vertices[first])), len(first)
    edges = point_of[edges]
    piece = _joined_by(edges, count)
    is_crumb = (np.bincount(piece) < _CRUMB * count)[piece]
    cells = np.zeros(count, np.int64)
    for size in _CUBES:
        cube = np.unique(np.floor(placed / size).astype(np.int64) @ (1, 1 << 20, 1 << 40), return_inverse=True)[1]
        found = _joined_by(edges[cube[edges[:, 0]] == cube[edges[:, 1]]], count)
        found = np.unique(np.where(is_crumb, -1, found), return_inverse=True)[1]
        if found.max() < _MOST_CELLS:
            cells = found
            break
    number = int(cells.max()) + 1
    filled = np.bincount(cells)
    middles = np.stack([np.bincount(cells, axis) for axis in placed.T], axis=1) / filled[:, None]
    one, other = np.divmod(np.unique(cells[edges[:, 0]] * number + cells[edges[:, 1]]), number)
    one, other = one[one != other], other[one != other]
    lengths = np.linalg.norm(middles[one] - middles[other], axis=1) + 1e-9
    ways = dijkstra(csr_array((lengths, (one, other)), (number, number)), directed=False, limit=_FAR)
    of_cell = np.zeros(number, np.int64)
    of_cell[cells] = np.where(is_crumb, -1, piece)
    near = np.isfinite(ways) | (of_cell[:, None] != of_cell) | (of_cell < 0)
    return Surface(torch.from_numpy(cells[point_of])[None], torch.from_numpy(near)[None])


def _joined_by(edges: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """The number of each vertex' [n] connected component."""
    graph = csr_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), (count, count))
    found: NDArray[np.int64] = connected_components(graph, directed=False)[1].astype(np.int64)
    return found
