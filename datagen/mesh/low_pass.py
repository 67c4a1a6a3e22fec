"""A low-pass filter along the edges of a mesh: what changes from vertex to vertex goes, limbs keep their size."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from datagen.common.arrays import Floats, Integers

_THERE, _BACK = 0.5, 0.53
"""Shares of the way to the neighbours' mean, and away again, a little further: limbs keep their size."""


class LowPass:
    """The filter of a mesh's faces (Taubin, "A signal processing approach to fair surface design", 1995).

    Parameters
    ----------
    faces
        Triangles [f, 3].
    count
        How many vertices there are.
    """

    def __init__(self, faces: Integers, count: int) -> None:
        faces = np.asarray(faces, np.int64).reshape(-1, 3)
        ahead = csr_array((np.ones(3 * len(faces)), (faces.T.ravel(), np.roll(faces, -1, 1).T.ravel())), (count, count))
        sides = (ahead + ahead.T).tocsr()  # how many faces each edge has
        neighbours = np.diff(sides.indptr)
        row = np.repeat(np.arange(count), neighbours)
        self._free = ((np.bincount(row, sides.data == 1, count) == 0) & (neighbours > 0))[:, None]
        self._mean = csr_array((1 / neighbours[row], sides.indices, sides.indptr), (count, count))

    def __call__(self, vertices: Floats, times: int) -> NDArray[np.float64]:
        """Return vertices [n, 3] filtered so many times; those on open borders, or of no face, stay."""
        found = np.asarray(vertices, np.float64)
        for _ in range(times):
            for share in (_THERE, -_BACK):
                found = found + np.where(self._free, share * (self._mean @ found - found), 0)
        return found
