"""Fewer vertices for a skinned surface, by quadric edge collapse (Garland and Heckbert, 1997; fast-simplification)."""

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.common.errors import BodyError


def simplify(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], weights: scipy.sparse.csr_array, count: int, *, name: str
) -> tuple[NDArray[np.float64], NDArray[np.int32], scipy.sparse.csr_array]:
    """Return the same surface with about ``count`` vertices; one that has no more is returned as it is.

    Parameters
    ----------
    vertices
        ``[vertex, 3]`` at rest.
    faces
        ``[face, 3]``.
    weights
        ``[vertex, joint]``, each row sums to one; a new vertex has those of the old one nearest to it.
    count
        Vertices to keep. A surface cannot always be brought to an exact number, so up to a tenth more may stay.
    name
        Whose surface it is, for errors.

    Raises
    ------
    BodyError
        It cannot be brought so low: its parts would vanish.
    """
    from fast_simplification import simplify as collapse

    if len(vertices) <= count:
        return vertices, faces, weights
    points, corners = vertices.astype(np.float32), faces
    for _ in range(_ROUNDS):
        wanted = int(len(corners) * count / len(points))
        points, corners = collapse(points, corners, target_count=wanted, agg=_EXACT)
        points, corners = _used(points, corners)
        if len(points) <= count:
            break
    if not count / 2 <= len(points) <= 1.1 * count:
        raise BodyError(
            f"{name}: {len(vertices):,} vertices cannot be simplified to {count:,}, only to {len(points):,}"
        )
    _, nearest = cKDTree(vertices).query(points)
    return points.astype(np.float64), corners, weights[nearest]


_ROUNDS = 4  # the number of faces does not tell that of vertices where a surface has holes
_EXACT = 3.0  # few collapses at a time: slower, and closer to the surface


def _used(points: NDArray[np.float32], faces: NDArray[np.integer]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The vertices that faces use, and the faces over those; faces without three corners are left out."""
    sides = faces != np.roll(faces, 1, axis=1)
    kept, indices = np.unique(faces[sides.all(axis=1)], return_inverse=True)
    return points[kept], indices.reshape(-1, 3).astype(np.int32)
