"""Triangle surfaces that remember where their vertices come from: cut level, subdivided, without stray vertices."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from datagen.mesh.geometry import triangles_of

Matrix: TypeAlias = scipy.sparse.csr_array
_SNAP = 0.35  # of an edge: a cut that passes nearer to a vertex moves the vertex instead, so that no slivers appear


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles ``faces`` [face, 3] over vertices that are weighted means of others.

    ``origin`` [vertex, source] holds the weights; its rows sum to one. What the sources have (places, skinning
    weights), the vertices get by a product with it.
    """

    faces: NDArray[np.int64]
    origin: Matrix

    def of(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values [vertex, ...] of what has ``values`` [source, ...]."""
        return np.asarray(self.origin @ values)

    def keep(self, faces: NDArray[np.bool_]) -> "Surface":
        """The surface of some faces [face], without the vertices that none of them has."""
        used, renumbered = np.unique(self.faces[faces], return_inverse=True)
        return Surface(renumbered.reshape(-1, 3), self.origin[used])

    def pieces(self, least: float = 0.1) -> list["Surface"]:
        """The connected pieces, but for crumbs: those of less than a share ``least`` of the faces of the largest."""
        first, second, third = self.faces.T
        ends = np.concatenate([first, second]), np.concatenate([second, third])
        links = scipy.sparse.coo_array((np.ones(len(ends[0])), ends), shape=(self.origin.shape[0],) * 2)
        pieces = scipy.sparse.csgraph.connected_components(links, directed=False)[1][first]
        sizes = np.bincount(pieces)
        return [self.keep(pieces == piece) for piece in np.flatnonzero(sizes > least * (sizes.max() - 0.5))]


@dataclass(frozen=True, eq=False)
class Worn:
    """A part on a person at rest: a surface over ``places`` [source, 3], with ``weights`` [source, bone] of these."""

    surface: Surface
    places: NDArray[np.float64]
    weights: Matrix


def surface_of(quads: NDArray[np.int64], sources: int) -> Surface:
    """The surface of quads [quad, 4] that index ``sources`` vertices, each split along its first diagonal."""
    whole = Surface(triangles_of(quads), scipy.sparse.eye_array(sources, format="csr"))
    return whole.keep(np.ones(len(whole.faces), bool))


def cut(surface: Surface, level: NDArray[np.float64]) -> Surface:
    """The part of a surface where a function, linear along edges, is not negative.

    Parameters
    ----------
    surface
        What to cut.
    level
        Values [vertex] of the function. Where it passes close to a vertex, that vertex is moved onto it.
    """
    surface, level = _snapped(surface, level)
    corners = _rotated(surface.faces, level)
    signs = np.sign(level[corners])
    crossing = np.unique(np.sort(_crossing_edges(corners, signs), axis=1), axis=0)
    points = _points_between(surface.origin, crossing, level)
    numbers = {tuple(edge): len(level) + number for number, edge in enumerate(crossing.tolist())}
    faces = [face for corner, sign in zip(corners.tolist(), signs.tolist(), strict=True)
             for face in _inner(corner, sign, numbers)]  # fmt: skip
    whole = Surface(np.array(faces, np.int64).reshape(-1, 3), scipy.sparse.vstack([surface.origin, points]).tocsr())
    return whole.keep(np.ones(len(whole.faces), bool))


def subdivided(surface: Surface) -> Surface:
    """Each triangle split into four at the middles of its edges; the vertices that were there come first, in order."""
    faces, count = surface.faces, surface.origin.shape[0]
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    edges, numbers = np.unique(sides, axis=0, return_inverse=True)
    middles = count + numbers.reshape(-1, 3)
    a, b, c = faces.T
    ab, bc, ca = middles.T
    split = np.concatenate([np.stack(its, axis=1) for its in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    between = (surface.origin[edges[:, 0]] + surface.origin[edges[:, 1]]) * 0.5
    return Surface(split, scipy.sparse.vstack([surface.origin, between]).tocsr())


def borders(faces: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The vertices of each open border of triangles, as numbers in ascending order; the longest border comes first."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges, counts = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    open_edges, size = edges[counts == 1], int(faces.max()) + 1
    links = scipy.sparse.coo_array((np.ones(len(open_edges)), tuple(open_edges.T)), shape=(size, size))
    _, labels = scipy.sparse.csgraph.connected_components(links, directed=False)
    on_border = np.unique(open_edges)
    found = [on_border[labels[on_border] == label] for label in np.unique(labels[on_border])]
    return sorted(found, key=len, reverse=True)


def _snapped(surface: Surface, level: NDArray[np.float64]) -> tuple[Surface, NDArray[np.float64]]:
    sides = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    sides = np.concatenate([sides, sides[:, ::-1]])
    first, second = sides[level[sides[:, 0]] * level[sides[:, 1]] < 0].T
    share = level[first] / (level[first] - level[second])
    order = np.lexsort((second, share, first))
    first, second, share = first[order], second[order], share[order]
    moved, place = np.unique(first, return_index=True)
    near = share[place] < _SNAP
    moved, towards, share = moved[near], second[place][near], share[place][near]
    scale = np.ones(len(level))
    scale[moved] = 1 - share
    toward = scipy.sparse.csr_array((share, (moved, towards)), shape=(len(level), len(level)))
    mixing = scipy.sparse.diags_array(scale).tocsr() + toward
    level = level.copy()
    level[moved] = 0.0
    return Surface(surface.faces, scipy.sparse.csr_array(mixing @ surface.origin)), level


def _rotated(faces: NDArray[np.int64], level: NDArray[np.float64]) -> NDArray[np.int64]:
    """Corners of each face in their cyclic order, beginning with the one that a cut sets apart, if any."""
    signs = np.sign(level[faces])
    plus, minus = signs > 0, signs < 0
    alone = np.where((plus.sum(axis=1) == 1)[:, None], plus, np.where((minus.sum(axis=1) == 1)[:, None], minus, False))
    first = alone.argmax(axis=1)
    return np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)


def _crossing_edges(corners: NDArray[np.int64], signs: NDArray[np.float64]) -> NDArray[np.int64]:
    pairs = [corners[signs[:, a] * signs[:, b] < 0][:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]
    return np.concatenate(pairs)


def _points_between(origin: Matrix, edges: NDArray[np.int64], level: NDArray[np.float64]) -> Matrix:
    first, second = edges.T
    share = level[first] / (level[first] - level[second]) if len(edges) else np.empty(0)
    before, after = scipy.sparse.diags_array(1 - share), scipy.sparse.diags_array(share)
    return scipy.sparse.csr_array(before @ origin[first] + after @ origin[second])


def _inner(corner: list[int], sign: list[float], numbers: dict[tuple[int, int], int]) -> list[tuple[int, int, int]]:
    """The triangles of one face that lie where the function is positive."""

    def between(one: int, other: int) -> int:
        return numbers[min(one, other), max(one, other)]

    (a, b, c), (at_a, at_b, at_c) = corner, sign
    if min(sign) >= 0:
        return [(a, b, c)] if max(sign) > 0 else []
    if max(sign) <= 0:
        return []
    if at_a > 0:  # alone
        return [(a, between(a, b) if at_b < 0 else b, between(a, c) if at_c < 0 else c)]
    first, second = between(a, b), between(a, c)
    return [(first, b, c), (first, c, second)]
