"""Meshes: normalisation, edges, and files of vertices and faces alone, as data sets have them.

A person's own files, with all that is in them, are read and written by :mod:`datagen.mesh.files`.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from datagen.common.arrays import Floats, Integers
from datagen.common.errors import MeshError

_SMALLEST, _LARGEST = 1e-15, 1e15  # of a box and of coordinates, in any unit that a body is measured in


@dataclass(frozen=True)
class Mesh:
    """Vertices [vertex, 3] and triangles [face, 3] that index them."""

    vertices: NDArray[np.floating]
    faces: NDArray[np.integer]


NEEDS_FACES = "triangles are needed; only the source of dsffnet transfer may be points (an OBJ or a PLY without faces)"


class InFaces:
    """A mesh as it is seen, without vertices that are a corner of no triangle, as exporters leave behind.

    Attributes
    ----------
    rows, loose
        Numbers of the vertices that remain, and of the others: none of them where there are no triangles, as of points.
    mesh
        The mesh of these alone.
    """

    def __init__(self, mesh: Mesh) -> None:
        first, second, third = mesh.faces.T
        is_seen = np.zeros(len(mesh.vertices), np.bool_)
        is_seen[mesh.faces[(first != second) & (second != third) & (third != first)]] = True
        self.rows, self.loose = np.flatnonzero(is_seen | ~is_seen.any()), np.flatnonzero(~is_seen & is_seen.any())
        self._whole = self.mesh = mesh
        if len(self.loose):
            kept = mesh.faces[is_seen[mesh.faces].all(axis=1)]
            self.mesh = Mesh(mesh.vertices[self.rows], np.searchsorted(self.rows, kept))

    @classmethod
    def checked(cls, mesh: Mesh, *, name: str, points: bool = False) -> "InFaces":
        """Of a mesh that is usable, and is so without what is in no face; MeshError as :func:`check_mesh`."""
        found = cls(check_mesh(mesh, name=name, points=points))
        check_mesh(found.mesh, name=name, points=points)
        return found

    def of_all(self, vertices: Floats) -> Floats:
        """Where the vertices of ``mesh`` [n, 3] came to lie -> all; those in no face move as the nearest other does."""
        return vertices[self._nearest] + self._off if len(self.loose) else vertices

    @cached_property
    def _nearest(self) -> NDArray[np.integer]:
        from scipy.spatial import cKDTree

        found = np.zeros(len(self._whole.vertices), np.int64)
        found[self.rows] = np.arange(len(self.rows))
        found[self.loose] = cKDTree(self.mesh.vertices).query(self._whole.vertices[self.loose])[1]
        return found

    @cached_property
    def _off(self) -> Floats:
        return self._whole.vertices - self.mesh.vertices[self._nearest]


@dataclass(frozen=True)
class Box:
    """Centre [..., 3] and half the longest edge [...] of an axis-aligned bounding box, in the mesh's own unit."""

    centre: NDArray[np.floating]
    half: NDArray[np.floating]

    def normalise(self, vertices: NDArray[np.floating]) -> NDArray[np.floating]:
        """Mesh coordinates -> the box's coordinates, in [-1, 1]."""
        return (vertices - self.centre[..., None, :]) / self.half[..., None, None]

    def restore(self, vertices: NDArray[np.floating]) -> NDArray[np.floating]:
        """The box's coordinates -> mesh coordinates."""
        return vertices * self.half[..., None, None] + self.centre[..., None, :]


Bounds = tuple[NDArray[np.floating], NDArray[np.floating]]
"""Lowest and highest coordinates [mesh, 3] of meshes."""


def bounds(vertices: NDArray[np.floating]) -> Bounds:
    """Lowest and highest coordinates [mesh, 3] of meshes [mesh, vertex, 3]; NaN where a mesh has any.

    NumPy reduces an axis before one of three numbers slowly; groups of vertices, and halves of a group, are quick.
    """
    return _bound(np.minimum, vertices), _bound(np.maximum, vertices)


_GROUP = 128


def _bound(extreme: np.ufunc, vertices: NDArray[np.floating]) -> NDArray[np.floating]:
    """The extreme coordinates [mesh, 3] of meshes [mesh, vertex, 3]."""
    found, groups = vertices, vertices.shape[1] // _GROUP
    if groups:
        grouped = vertices[:, : groups * _GROUP].reshape(len(vertices), groups, 3 * _GROUP)
        found, rest = extreme.reduce(grouped, axis=1).reshape(-1, _GROUP, 3), vertices[:, groups * _GROUP :]
        part = found[:, : rest.shape[1]]
        extreme(part, rest, out=part)
    while (count := found.shape[1]) > 1:
        half = (count + 1) // 2
        found = extreme(found[:, :half], found[:, -half:])
    return found[:, 0]


def bounding_box(vertices: NDArray[np.floating]) -> Box:
    """Bounding box of vertices [..., vertex, 3], the normalisation of the DSFFNet paper and of NPT.

    Each mesh is moved so that its box is centred on the origin and divided by half the longest edge of the box.
    """
    found = bounds(vertices.reshape(-1, *vertices.shape[-2:]))
    low, high = (each.reshape(*vertices.shape[:-2], 3) for each in found)
    return Box((low + high) / 2, (high - low).max(axis=-1) / 2)


def closest_on_triangle(points: Floats, corners: Floats) -> NDArray[np.float64]:
    """Barycentric coordinates [..., 3] of the places on triangles [..., 3, 3] that are nearest to points [..., 3].

    That of the plane where it lies within the triangle, and else the nearest of its three sides'.
    """
    first, second, third = (corners[..., corner, :] for corner in range(3))
    along, beside, to = second - first, third - first, points - first
    aa, ab, bb = (along**2).sum(-1), (along * beside).sum(-1), (beside**2).sum(-1)
    pa, pb = (to * along).sum(-1), (to * beside).sum(-1)
    area = np.maximum(aa * bb - ab**2, 1e-30)
    two, three = (bb * pa - ab * pb) / area, (aa * pb - ab * pa) / area
    inner = np.stack([1 - two - three, two, three], axis=-1)
    sides = np.stack([_on_side(points, corners, start) for start in range(3)], axis=-2)
    places = (sides[..., None] * corners[..., None, :, :]).sum(-2)
    nearest = ((places - points[..., None, :]) ** 2).sum(-1).argmin(-1)
    outer = np.take_along_axis(sides, nearest[..., None, None], -2)[..., 0, :]
    return np.where((inner >= 0).all(-1, keepdims=True), inner, outer)


def _on_side(points: Floats, corners: Floats, start: int) -> NDArray[np.float64]:
    end = (start + 1) % 3
    side = corners[..., end, :] - corners[..., start, :]
    along = ((points - corners[..., start, :]) * side).sum(-1) / np.maximum((side**2).sum(-1), 1e-30)
    share = np.clip(along, 0, 1)
    found = np.zeros((*share.shape, 3))
    found[..., start], found[..., end] = 1 - share, share
    return found


def standing_point(vertices: Floats) -> NDArray[np.float64]:
    """The point [3] of the ground below the middle of the box of vertices [n, 3] with Y up, at their lowest height."""
    low, high = (each[0] for each in bounds(vertices[None]))
    return np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])


def vertex_normals(vertices: Floats, faces: Integers) -> NDArray[np.float64]:
    """Return area-weighted unit normals [v, 3]; a vertex without area points up."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    across = np.cross(second - first, third - first)
    total = np.stack([np.bincount(faces.ravel(), np.repeat(axis, 3), len(vertices)) for axis in across.T], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-30), (0.0, 1.0, 0.0))


def triangles_of(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles [2 quad, 3] of quads [quad, 4], split along the first diagonal: all first halves, then all second."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


_ONE_PLACE = 3e-6  # of the size of the body: more than six decimals leave of one in metres


def places_of(vertices: Floats) -> NDArray[np.int64]:
    """The number [n] of the place that each vertex [n, 3] is at; those at one place but for rounding share it.

    Seams of textures are such, which some formats store as several vertices, and parts that were placed apart.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    points, point_of = np.unique(vertices, axis=0, return_inverse=True)
    low, high = np.quantile(points, (0.05, 0.95), axis=0)  # a few vertices far away are no measure of the body
    if not (cell := 2 * _ONE_PLACE * float((high - low).max())) > 0:
        return np.asarray(point_of.ravel(), np.int64)
    links = list[NDArray[np.int64]]()
    for shift in product((0.0, 0.5), repeat=3):  # what is nearer than half a cell shares one in some of these grids
        cells = np.floor((points - low) / cell + shift)
        order = np.lexsort(cells.T)
        shared = (cells[order[1:]] == cells[order[:-1]]).all(axis=1)
        links.append(np.stack([order[:-1][shared], order[1:][shared]]))
    both = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(both.shape[1], np.bool_), both), shape=(len(points), len(points)))
    return np.asarray(connected_components(graph, directed=False)[1][point_of.ravel()], np.int64)


def edges_of(faces: NDArray[np.integer]) -> NDArray[np.int64]:
    """Unique undirected edges [edge, 2] of triangles [face, 3], sorted."""
    corners = np.asarray(faces, np.int64).T
    first, second, count = corners.ravel(), np.roll(corners, -1, axis=0).ravel(), int(corners.max(initial=0)) + 1
    keys = np.sort(np.minimum(first, second) * count + np.maximum(first, second))  # np.unique's hashes take longer
    return np.stack(np.divmod(keys[np.diff(keys, prepend=-1) > 0], count), axis=1)


def check_mesh(mesh: Mesh, *, name: str, points: bool = False) -> Mesh:
    """Return the mesh if it is usable; ``points``: it may be points without faces.

    Raises
    ------
    MeshError
        No vertices, no triangles where there must be some, coordinates that are not finite, faces that index nothing,
        or no extent.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) == 0:
        raise MeshError(f"{name} has no usable vertices (shape {vertices.shape})")
    if faces.size == 0 and not points:
        raise MeshError(f"{name} has no faces (shape {faces.shape}); {NEEDS_FACES}")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"{name} has faces of shape {faces.shape}, not triangles [f, 3]: triangulate it")
    wrong = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(wrong):
        are = "1 vertex is" if len(wrong) == 1 else f"{len(wrong):,} vertices are"
        raise MeshError(
            f"{name}: {are} not finite, the first is number {wrong[0]}, counted from 0, at "
            f"{vertices[wrong[0]].tolist()}. Repair or remove it"
        )
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise MeshError(f"{name}: faces name vertex {faces.max()}, but there are {len(vertices)}")
    _require_extent(vertices, name)
    return mesh


def _require_extent(vertices: NDArray[np.floating], name: str) -> None:
    largest = float(np.abs(vertices).max())
    if largest > _LARGEST:  # its square may not be finite
        raise MeshError(f"{name} has coordinates up to {largest:.3g}: scale it to metres or millimetres")
    edge = 2 * float(bounding_box(vertices).half)
    if not edge > 0:
        raise MeshError(f"{name} has no extent: all vertices are at {vertices[0].tolist()}")
    if edge < _SMALLEST:
        raise MeshError(f"{name} is {edge:.3g} long at most: scale it to metres or millimetres")
