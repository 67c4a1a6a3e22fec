"""A low-pass filter along the edges of a mesh: what changes from vertex to vertex goes, limbs keep their size."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from datagen.common.arrays import Floats, Integers
from datagen.mesh.geometry import Mesh, edges_of

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
        self._faces = faces
        self._free = ((np.bincount(row, sides.data == 1, count) == 0) & (neighbours > 0))[:, None]
        self._mean = csr_array((1 / neighbours[row], sides.indices, sides.indptr), (count, count))

    def __call__(self, vertices: Floats, times: int) -> NDArray[np.float64]:
        """Return vertices [n, 3] filtered so many times; those on open borders, or of no face, stay."""
        found = np.asarray(vertices, np.float64)
        for _ in range(times):
            for share in (_THERE, -_BACK):
                found = found + np.where(self._free, share * (self._mean @ found - found), 0)
        return found

    def roughness(self, vertices: Floats) -> tuple[float, float]:
        """Return how rough vertices [n, 3] are: 0.5 to 0.87 on smooth bodies, some 1.25 where all is noise.

        How far a vertex lies from the mean of its neighbours, along its normal, is much the same at its neighbours on a
        smooth surface, however irregular the mesh, and differs at random under noise. Returned are the differences
        relative to the distances, and the differences themselves in the unit of the vertices; of both the root of the
        mean square, where the largest twentieth, spikes say, counts as what is just below it. Vertices on open borders,
        of no face or that are not numbers are not judged; (0, 0) without others.
        """
        vertices = np.asarray(vertices, np.float64)
        with np.errstate(invalid="ignore"):
            one, two, three = vertices[self._faces].swapaxes(0, 1)
            across, corners = np.tile(np.cross(two - one, three - one), (3, 1)), self._faces.T.ravel()
            sums = np.stack([np.bincount(corners, each, len(vertices)) for each in across.T], axis=1)
            normals = sums / np.linalg.norm(sums, axis=1, keepdims=True).clip(1e-300)
            away = self._mean @ vertices - vertices
            along, around = ((each * normals).sum(axis=1) for each in (away, self._mean @ away))
        some = self._free[:, 0] & np.isfinite(along) & np.isfinite(around)
        if not some.any():
            return 0.0, 0.0
        size, change = (_typical(each[some]) for each in (along, around - along))
        return (change / size, change) if size > 0 else (0.0, 0.0)


def _typical(values: NDArray[np.float64]) -> float:
    """Root of the mean square of values [n], the largest twentieth of which counts as what is just below it."""
    sizes = np.abs(values)
    return float(np.sqrt(np.square(sizes.clip(max=np.quantile(sizes, 0.95))).mean()))


class LowPassWhereTorn:
    """The filter (:class:`LowPass`) where vertices lie further from their neighbours than at rest; the others stay.

    Parameters
    ----------
    rest
        Whose faces and edges' lengths are taken.
    torn
        How many times as long as at rest the edges at a vertex are together where it begins to be filtered. At one more
        it is filtered wholly.
    """

    def __init__(self, rest: Mesh, *, torn: float) -> None:
        self._edges, self._torn = edges_of(rest.faces), torn
        self._lengths = self._lengths_at(rest.vertices)
        self._low_passed = LowPass(rest.faces, len(rest.vertices))

    def __call__(self, vertices: Floats, times: int) -> NDArray[np.float64]:
        """Return vertices [n, 3] filtered so many times where they are torn."""
        longer = self._lengths_at(vertices) / self._lengths.clip(1e-9)
        share = np.clip(longer - self._torn, 0, 1)[:, None]
        filtered = vertices + share * (self._low_passed(vertices, times) - vertices)
        return np.where(share > 0, filtered, vertices)

    def _lengths_at(self, vertices: Floats) -> NDArray[np.float64]:
        """The sum of the lengths of the edges at each vertex [n]."""
        lengths = np.linalg.norm(vertices[self._edges[:, 0]] - vertices[self._edges[:, 1]], axis=1)
        return np.asarray(np.bincount(self._edges.T.ravel(), np.tile(lengths, 2), len(vertices)), np.float64)
