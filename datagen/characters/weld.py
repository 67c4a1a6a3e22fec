"""One surface from the pieces of a skinned mesh: exporters cut it where materials and normals change."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from datagen.characters.skin import Primitive, Skin
from datagen.common.errors import BodyError


@dataclass(frozen=True)
class WeldedSkin:
    """``vertices`` [vertex, 3], ``faces`` [face, 3] that use them all, ``weights`` [vertex, joint] that sum to one."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    weights: NDArray[np.float64]


def weld(skin: Skin, *, name: str) -> WeldedSkin:
    """Return the pieces of a skin as one surface, with every vertex once.

    Vertices are one where position and weights are the same, and at the ends of an edge without length. Their order is
    that of their first occurrence.

    Raises
    ------
    BodyError
        Coordinates or weights that cannot be used, or no face with an area.
    """
    positions = np.concatenate([piece.positions for piece in skin.primitives])
    weights = np.concatenate([_weights(piece, len(skin.joints)) for piece in skin.primitives])
    starts = np.cumsum([0, *(len(piece.positions) for piece in skin.primitives)])
    faces = np.concatenate([piece.faces + start for piece, start in zip(skin.primitives, starts[:-1], strict=True)])
    used = np.unique(faces)
    _require_usable(positions[used], weights[used], name)
    weights[used] /= weights[used].sum(axis=1, keepdims=True)
    alike = np.concatenate([positions, np.round(weights * 1e4)], axis=1)
    faces = first_of_equals(alike)[faces]
    faces = _without_edges_of_no_length(positions, faces)
    if not len(faces):
        raise BodyError(f"{name} has no face with an area. Export a triangle mesh")
    kept, faces = np.unique(faces, return_inverse=True)
    return WeldedSkin(positions[kept], faces.reshape(-1, 3).astype(np.int32), weights[kept])


def volume(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> float:
    """Signed volume that a surface encloses: positive where faces look outwards (counter-clockwise from outside)."""
    corners = vertices[faces] - vertices.mean(axis=0)
    return float((corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6)


def _weights(piece: Primitive, joints: int) -> NDArray[np.float64]:
    """Dense weights [vertex, joint] as in the file; a joint that is named twice gets both."""
    weights = np.zeros((len(piece.positions), joints))
    np.add.at(weights, (np.arange(len(weights))[:, None], piece.joints), piece.weights)
    return weights


def _require_usable(positions: NDArray[np.float64], weights: NDArray[np.float64], name: str) -> None:
    if not np.isfinite(positions).all():
        raise BodyError(f"{name} has vertices that are not finite. Repair the mesh and export it again")
    if not np.isfinite(weights).all() or (weights < 0).any():
        raise BodyError(f"{name} has weights that are negative or not finite. Repair them and export it again")
    lost = np.flatnonzero(weights.sum(axis=1) <= 0)
    if len(lost):
        raise BodyError(f"{name} has {len(lost)} vertices that no joint moves. Bind them to a joint, export it again")


def first_of_equals(rows: NDArray[np.float64]) -> NDArray[np.int64]:
    """For each row the number of the first row that equals it."""
    _, first, group = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first[group.ravel()]


def _without_edges_of_no_length(positions: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Faces whose corners differ, once the ends of every edge without length are one vertex."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    short = sides[(positions[sides[:, 0]] == positions[sides[:, 1]]).all(axis=1)]
    size = (len(positions), len(positions))
    links = scipy.sparse.coo_array((np.ones(len(short)), (short[:, 0], short[:, 1])), shape=size)
    _, group = scipy.sparse.csgraph.connected_components(links, directed=False)
    faces = first_of_equals(group[:, None])[faces]
    differ = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return faces[differ]
