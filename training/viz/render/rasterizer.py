"""Triangles to pixels: the nearest face of every pixel, by a packed z-buffer, vectorised over faces."""

import numpy as np
import numpy.typing as npt

from datagen.common.arrays import Floats, Integers

_EMPTY = np.iinfo(np.int64).max
_CANDIDATES_AT_ONCE = 1 << 21  # bounds memory when triangles are large on screen
_LEVELS = 2**31 - 1  # of depth; a pixel keeps the least of (depth level, face) packed into 64 bits


def planes(screen: Floats, faces: Integers) -> tuple[Floats, Floats]:
    """Return two barycentric weights and nearness of faces as planes over the screen [3, 3, f], and doubled area."""
    origin = screen.T[:, faces[:, 0]]
    first, second = screen.T[:, faces[:, 1]] - origin, screen.T[:, faces[:, 2]] - origin
    area = first[0] * second[1] - first[1] * second[0]
    safe = np.where(np.abs(area) > 1e-12, area, np.inf)
    one = np.stack([second[1], -second[0]]) / safe
    two = np.stack([-first[1], first[0]]) / safe
    slopes = np.stack([one, two, one * first[2] + two * second[2]])
    offset = -(slopes * origin[:2]).sum(1)
    offset[2] += origin[2]
    return np.concatenate([slopes, offset[:, None]], 1), area


def on_plane(plane: Floats, owner: Integers, x: Floats, y: Floats) -> Floats:
    """Return the value at points on the screen [p] of the planes [3, f] of their faces."""
    return np.asarray(plane[0][owner] * x + plane[1][owner] * y + plane[2][owner])


def _boxes(screen: Floats, faces: Integers, limit: npt.ArrayLike) -> tuple[Integers, Integers]:
    """Return the first pixel and the number of pixels, across and down, [f, 2] of the boxes around faces."""
    one, two, three = (screen[faces[:, corner], :2] for corner in range(3))
    low = np.clip(np.ceil(np.minimum(np.minimum(one, two), three) - 0.5), 0, limit).astype(np.int64)
    high = np.clip(np.floor(np.maximum(np.maximum(one, two), three) + 0.5), 0, limit).astype(np.int64)
    return low, np.maximum(high - low, 0)


def rasterise(screen: Floats, faces: Integers, width: int, height: int) -> tuple[Integers, Floats]:
    """Return the nearest face of every pixel centre [h * w] (-1: none) and its nearness (-inf: none).

    ``screen`` [v, 3] holds pixels across, pixels down, and a nearness that is affine on the screen (larger is nearer).
    """
    plane, area = planes(screen, faces)
    low, span = _boxes(screen, faces, (width, height))
    count = np.where(np.abs(area) > 1e-12, span[:, 0] * span[:, 1], 0)
    farthest, depth = screen[:, 2].min(), max(float(np.ptp(screen[:, 2])), 1e-30)
    best = np.full(width * height, _EMPTY)
    drawn = np.flatnonzero(count)
    for group in np.split(drawn, np.flatnonzero(np.diff(np.cumsum(count[drawn]) // _CANDIDATES_AT_ONCE)) + 1):
        owner = np.repeat(group, count[group])
        row, column = np.divmod(_ranges(count[group]), span[owner, 0])
        row, column = row + low[owner, 1], column + low[owner, 0]
        x, y = column + 0.5, row + 0.5
        one, two = on_plane(plane[0], owner, x, y), on_plane(plane[1], owner, x, y)
        inside = np.flatnonzero((one >= -1e-9) & (two >= -1e-9) & (one + two <= 1 + 1e-9))
        near = on_plane(plane[2], owner[inside], x[inside], y[inside])
        far = ((1 - np.clip((near - farthest) / depth, 0, 1)) * _LEVELS).astype(np.int64)
        np.minimum.at(best, row[inside] * width + column[inside], far << 32 | owner[inside])
    found = best != _EMPTY
    nearness = np.where(found, (1 - (best >> 32) / _LEVELS) * depth + farthest, -np.inf)
    return np.where(found, best & 0xFFFFFFFF, -1), nearness


def _ranges(counts: Integers) -> Integers:
    """Return 0 .. count - 1 for every count, one after another."""
    ends = np.cumsum(counts)
    return np.asarray(np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts))
