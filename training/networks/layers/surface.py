"""What lies near along the surface of a mesh, so that a hand on a thigh is not taken for the thigh's.

Two vertices may touch and yet belong to far parts of a body. The mesh' edges tell: the way from one to the other along
the surface is long. Vertices are gathered into cells, and of cells it is known which are near each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
"""Edges of the grid's cubes, half the longest edge of a mesh' box being 1, or of that of the body unfolded: the first
that gives few enough cells. Where none does, as in hair, all is near all."""
_MOST_CELLS = 1000
_CRUMB = 0.01
"""Of the vertices: a piece with fewer is near to all, lest triangles that share no vertices be cells each."""
_FAR = 0.35
"""Length of a way along the surface, in that unit: three and a half times the radius within which the network looks at
bodies that are not folded up."""
_LONGEST, _MOST_FOLDED = 2.8, 2.0
"""The longest way along the surface of an ordinary body, in half the longest edge of its box: people and animals have
2.1 to 3.2. What has more is measured as if its box were larger, up to so many times
(docs/results/parts-experiments.md)."""


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
    are measured between the middles of cells, so that noise of vertices hardly makes them longer. A body that is folded
    up fills a small box: it is as large as the longest way along its surface says, along that of the piece with most
    points where there are several.

    Parameters
    ----------
    vertices
        [n, 3] in any unit.
    edges
        [e, 2]; without any all is near all.
    """
    vertices = np.asarray(vertices, np.float64)
    _, first, point_of = np.unique(vertices @ _ELSEWHERE, return_index=True, return_inverse=True)
    placed, edges = np.nan_to_num(bounding_box(vertices).normalise(vertices[first])), point_of[edges]
    found = _Cells.few(placed, edges)
    if found is not None and (folded := min(found.longest_way() / _LONGEST, _MOST_FOLDED)) > 1:
        found = _Cells.few(placed / folded, edges)
    cells = np.zeros(len(placed), np.int64) if found is None else found.cells
    near = np.ones((1, 1), np.bool_) if found is None else found.near()
    return Surface(torch.from_numpy(cells[point_of])[None], torch.from_numpy(near)[None])


@dataclass(frozen=True)
class _Cells:
    """The cell [n] of each point; ways [cell, cell] between neighbours; the piece [cell] that each belongs to, -1:
    crumbs.
    """

    cells: NDArray[np.int64]
    ways: csr_array
    pieces: NDArray[np.int64]

    @classmethod
    def few(cls, placed: NDArray[np.float64], edges: NDArray[np.integer]) -> _Cells | None:
        """The smallest that are few enough; None: there are too many."""
        each = (cls.of(placed, edges, size) for size in _CUBES)
        return next((found for found in each if found.count <= _MOST_CELLS), None)

    @classmethod
    def of(cls, placed: NDArray[np.float64], edges: NDArray[np.integer], size: float) -> _Cells:
        """Those of points [n, 3], joined by edges, in cubes of a size; crumbs are one cell, the first."""
        cube = np.unique(np.floor(placed / size).astype(np.int64) @ (1, 1 << 20, 1 << 40), return_inverse=True)[1]
        cells = _joined_by(edges[cube[edges[:, 0]] == cube[edges[:, 1]]], len(placed))
        filled = np.bincount(cells)
        between = np.unique(cells[edges[:, 0]] * len(filled) + cells[edges[:, 1]])
        between = np.stack(np.divmod(between, len(filled)), axis=1)
        pieces = _joined_by(between, len(filled))
        pieces = np.where((np.bincount(pieces, filled) < _CRUMB * len(placed))[pieces], -1, pieces)
        number = np.where(pieces < 0, -1, np.arange(len(filled)))
        kept, number = np.unique(number, return_inverse=True)
        cells, between = number[cells], number[between]
        one, other = between[between[:, 0] != between[:, 1]].T
        middles = np.stack([np.bincount(cells, axis) for axis in placed.T], axis=1) / np.bincount(cells)[:, None]
        lengths = np.linalg.norm(middles[one] - middles[other], axis=1) + 1e-9
        ways = csr_array((lengths, (one, other)), (len(kept), len(kept)))
        return cls(cells, ways, np.where(kept < 0, -1, pieces[kept]))

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.pieces)

    def longest_way(self) -> float:
        """About how long the longest of the shortest ways is along the piece with most points; of crumbs none."""
        points = np.bincount(self.pieces + 1, np.bincount(self.cells))[1:]
        if not len(points):
            return 0.0
        start, longest = int(np.argmax(self.pieces == points.argmax())), 0.0
        for _ in range(3):  # from one end to the other
            reached = np.nan_to_num(dijkstra(self.ways, directed=False, indices=start), posinf=0)
            start, longest = int(reached.argmax()), float(reached.max())
        return longest

    def near(self) -> NDArray[np.bool_]:
        """Which cells [cell, cell] a way along the surface joins that is not long, or none at all."""
        reached = np.isfinite(dijkstra(self.ways, directed=False, limit=_FAR))
        return reached | (self.pieces[:, None] != self.pieces)  # so crumbs are near all: their piece is no other's


def _joined_by(edges: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """The number of each vertex' [n] connected component."""
    graph = csr_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), (count, count))
    found: NDArray[np.int64] = connected_components(graph, directed=False)[1].astype(np.int64)
    return found
