"""Pulling an output's edges back to the lengths and the surface of its target, for targets that the network has worn.

Departure from the DSFFNet paper, which ends at the network's output: this is an option, off by default. What is
minimised is ``sum_i |x_i - o_i|^2 + w sum_(i,j) |(x_i - x_j) - R_ij (t_i - t_j)|^2`` over the vertices x, where o is
the output, t the target, and R_ij the mean of the rotations of the two ends: as-rigid-as-possible deformation (Sorkine
and Alexa 2007, uniform weights) with the output as a soft goal. Each step fits a rotation to the edges around every
vertex, then solves one sparse linear system, whose matrix never changes and is factorised once.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, edges_of, places_of

_STEPS = 8


class Refinement:
    """What keeps the edges of one target, to be used for any number of outputs.

    Vertices at the same place of the target (:func:`datagen.mesh.geometry.places_of`) are one point here, so that no
    seam opens.
    """

    def __init__(self, target: Mesh, *, weight: float, steps: int = _STEPS) -> None:
        """``target``: vertices [n, 3] and faces; ``weight``: of the edges, 0 leaves the output as it is.

        It is w for a thousand points: w grows with their number, for edges shorten as points grow more, and the same
        dent then spreads over more of them.
        """
        self._point_of = places_of(target.vertices)
        self._members = np.bincount(self._point_of)[:, None]
        points = self._of_points(target.vertices)
        edges = edges_of(self._point_of[target.faces])
        edges = edges[edges[:, 0] != edges[:, 1]]
        self._both = np.concatenate([edges, edges[:, ::-1]])
        self._rest = points[self._both[:, 0]] - points[self._both[:, 1]]
        self._gather = _sums_of_rows(self._both[:, 0], len(points))
        self._weight, self._steps = weight * len(points) / 1000, steps
        self._solve = splu(_matrix(self._both, len(points), self._weight)).solve

    def __call__(self, output: Floats) -> NDArray[np.float64]:
        """The output [n, 3], in the target's unit and vertex order, with the target's edges."""
        found = goal = self._of_points(output)
        for _ in range(self._steps):
            found = self._solve(goal + self._weight * self._pulled(found))
        return np.asarray(found[self._point_of])

    def _of_points(self, vertices: Floats) -> Floats:
        """The mean [point, 3] of the vertices [n, 3] of each point."""
        return np.asarray(_sums_of_rows(self._point_of, len(self._members)) @ vertices / self._members)

    def _pulled(self, vertices: Floats) -> Floats:
        """What the turned edges of the target add to the right side of the system [point, 3]."""
        start, end = self._both.T
        sides = vertices[start] - vertices[end]
        spread = (self._gather @ (sides[:, :, None] * self._rest[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
        turns = _nearest_rotations(spread)
        turned = np.einsum("eij,ej->ei", turns[start] + turns[end], self._rest) / 2
        return np.asarray(self._gather @ turned)


def _matrix(both: NDArray[np.integer], count: int, weight: float) -> csc_matrix:
    """Identity plus ``weight`` times the graph's Laplacian."""
    neighbours = csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    degrees = np.asarray(neighbours.sum(axis=1)).ravel()
    return csc_matrix(diags(1 + weight * degrees) - weight * neighbours)


def _sums_of_rows(groups: NDArray[np.integer], count: int) -> csr_matrix:
    """A matrix that sums the rows of each group."""
    places = np.arange(len(groups))
    return csr_matrix((np.ones(len(groups)), (groups, places)), shape=(count, len(groups)))


def _nearest_rotations(spread: Floats) -> Floats:
    """The rotation nearest to each matrix [n, 3, 3] (Kabsch); never a reflection."""
    left, _, right = np.linalg.svd(spread)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return np.asarray(left @ right)
