"""Naive surface nets (Gibson 1998): the zero surface of a sampled field as a closed mesh, one vertex a mixed cell."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.geometry import triangles_of

_CORNERS = tuple(product((0, 1), repeat=3))


def surface_nets(field: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices [vertex, 3] in cells and triangles [face, 3], facing outward, of field [x, y, z], negative inside.

    The field must be positive on the border of the grid.
    """
    inside = field < 0
    corners = np.stack([_corner(field, corner) for corner in _CORNERS], axis=-1)
    mixed = (corners < 0).any(axis=-1) & (corners >= 0).any(axis=-1)
    cells = np.argwhere(mixed)
    number = np.full(mixed.shape, -1)
    number[mixed] = np.arange(len(cells))
    quads = [_quads(inside, number, axis) for axis in range(3)]
    return cells + _crossings(corners[mixed]), triangles_of(np.concatenate(quads))


def _corner(field: NDArray[np.float64], corner: tuple[int, ...]) -> NDArray[np.float64]:
    return field[tuple(slice(step, size - 1 + step) for step, size in zip(corner, field.shape, strict=True))]


def _crossings(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean place [cell, 3] in the unit cell of where its edges cross zero, from its corners' values [cell, 8]."""
    total, count = np.zeros((len(corners), 3)), np.zeros((len(corners), 1))
    for first, second in product(range(8), repeat=2):
        start, end = np.array(_CORNERS[first]), np.array(_CORNERS[second])
        if first < second and np.abs(end - start).sum() == 1:
            a, b = corners[:, first, None], corners[:, second, None]
            crosses = (a < 0) != (b < 0)
            part = np.where(crosses, a / np.where(crosses, a - b, 1), 0)
            total += np.where(crosses, start + part * (end - start), 0)
            count += crosses
    return total / count


def _quads(inside: NDArray[np.bool_], number: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    """Quads [quad, 4] of cells around the grid edges along ``axis`` that cross the surface."""
    cyclic = [(axis + step) % 3 for step in range(3)]  # keeps the grid right-handed, so that quads face outward
    along, cells = inside.transpose(cyclic), number.transpose(cyclic)
    edges = np.argwhere(along[:-1] != along[1:])
    i, j, k = edges.T
    around = np.stack([cells[i, j - 1, k - 1], cells[i, j, k - 1], cells[i, j, k], cells[i, j - 1, k]], axis=1)
    leaving = along[i, j, k]
    return np.where(leaving[:, None], around, around[:, ::-1])
