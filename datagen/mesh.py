"""Meshes: normalisation, edges, and files of vertices and faces alone, as data sets have them.

A person's own files, with all that is in them, are read and written by :mod:`datagen.mesh_files`.
"""

import io
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from datagen.errors import MeshError, storage_errors
from datagen.files import read_bounded, sync_folder
from datagen.obj import read_plain

_SMALLEST, _LARGEST = 1e-15, 1e15  # of a box and of coordinates, in any unit that a body is measured in
FORMATS = (".obj", ".ply", ".off", ".glb", ".stl")


@dataclass(frozen=True)
class Mesh:
    """Vertices [vertex, 3] and triangles [face, 3] that index them."""

    vertices: NDArray[np.floating]
    faces: NDArray[np.integer]


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


def bounds(vertices: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Lowest and highest coordinates [mesh, 3] of meshes [mesh, vertex, 3]; NaN where a mesh has any.

    NumPy reduces an axis before one of three numbers slowly; in groups of vertices it is some twenty times faster.
    """
    groups = vertices.shape[1] // _GROUP
    grouped = vertices[:, : groups * _GROUP].reshape(len(vertices), groups, 3 * _GROUP)
    rest = vertices[:, groups * _GROUP :]
    return _bound(np.minimum, grouped, rest), _bound(np.maximum, grouped, rest)


_GROUP = 128


def _bound(extreme: np.ufunc, grouped: NDArray[np.floating], rest: NDArray[np.floating]) -> NDArray[np.floating]:
    parts = [rest]
    if grouped.shape[1]:
        parts.append(extreme.reduce(grouped, axis=1).reshape(len(grouped), _GROUP, 3))
    found: NDArray[np.floating] = extreme.reduce(np.concatenate(parts, axis=1), axis=1)
    return found


def bounding_box(vertices: NDArray[np.floating]) -> Box:
    """Bounding box of vertices [..., vertex, 3], the normalisation of the DSFFNet paper and of NPT.

    Each mesh is moved so that its box is centred on the origin and divided by half the longest edge of the box.
    """
    low, high = vertices.min(axis=-2), vertices.max(axis=-2)
    return Box((low + high) / 2, (high - low).max(axis=-1) / 2)


def edges_of(faces: NDArray[np.integer]) -> NDArray[np.int64]:
    """Unique undirected edges [edge, 2] of triangles [face, 3], sorted."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(sides, axis=1), axis=0).astype(np.int64)


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh file, keeping its vertex order (nothing is merged or reordered).

    Raises
    ------
    MeshError
        The file is missing, of an unknown format, unreadable, or not one usable triangle mesh.
    """
    from datagen.mesh_limits import BYTE_LIMIT, refuse_huge, require_file

    path = Path(path)
    require_file(path)
    try:
        refuse_huge(path)
        content = read_bounded(path, limit=BYTE_LIMIT)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise MeshError(f"{path} cannot be read as a {path.suffix[1:].upper()} mesh: {error}") from error
    return check_mesh(_single_geometry(path, content), name=str(path))


def _single_geometry(path: Path, content: bytes) -> Mesh:
    import trimesh

    is_obj = path.suffix.lower() == ".obj"
    try:
        plain = read_plain(content) if is_obj else None
        if plain:
            return Mesh(*plain)
        source = io.BytesIO(_plain_obj(content) if is_obj else content)  # no path: trimesh would read what a file names
        scene = trimesh.load_scene(source, file_type=path.suffix[1:].lower(), process=False, maintain_order=True)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    except Exception as error:  # trimesh's readers raise whatever their parsers raise
        raise MeshError(f"{path} cannot be read as a {path.suffix[1:].upper()} mesh: {error}") from error
    if len(parts) > 1:
        raise MeshError(f"{path} holds {len(parts)} separate meshes; save the one to use as a file of its own")
    if not parts:
        raise MeshError(f"{path} holds no triangles (a point cloud, or an empty file?)")
    return Mesh(np.asarray(parts[0].vertices, np.float64), np.asarray(parts[0].faces, np.int64))


def _plain_obj(content: bytes) -> bytes:
    """Positions and faces of an OBJ file. Materials, groups and texture seams would split its one list of vertices."""
    kept = []
    for line in content.replace(b"\\\n", b" ").splitlines():
        words = line.split()
        if words and words[0] == b"v":
            kept.append(line)
        elif words and words[0] == b"f":
            kept.append(b" ".join([b"f", *(word.split(b"/")[0] for word in words[1:])]))
    return b"\n".join(kept) + b"\n"


def check_mesh(mesh: Mesh, *, name: str) -> Mesh:
    """Return the mesh if it is usable.

    Raises
    ------
    MeshError
        No vertices, no faces, coordinates that are not finite, faces that index nothing, or no extent.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or len(vertices) == 0:
        raise MeshError(f"{name} has no usable vertices (shape {vertices.shape})")
    if faces.ndim != 2 or faces.shape[1:] != (3,) or len(faces) == 0:
        raise MeshError(f"{name} has no faces (shape {faces.shape}); pose transfer needs a triangle mesh")
    wrong = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(wrong):
        raise MeshError(f"{name}: {len(wrong)} vertices are not finite, the first is number {wrong[0]}")
    if faces.min() < 0 or faces.max() >= len(vertices):
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


def save_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh; the format is the file name's. The file appears whole or not at all.

    Raises
    ------
    MeshError
        Unknown format.
    StorageError
        The file could not be written.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise MeshError(f"{path}: unknown mesh format {path.suffix!r}; known are {', '.join(FORMATS)}")
    import trimesh

    exported: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type=path.suffix[1:].lower())
    write_atomically(path, exported.encode() if isinstance(exported, str) else exported)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file that appears whole or not at all, creating its folder.

    Raises
    ------
    StorageError
        The disk is full, or the place cannot be written to.
    """
    with atomic_file(path) as file:
        file.write(content)


@contextmanager
def atomic_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing that appears at ``path`` whole when the block ends, or not at all; creates its folder.

    Raises
    ------
    StorageError
        The disk is full, or the place cannot be written to.
    """
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / f".{path.name}.{secrets.token_hex(8)}.partial"
        try:
            with open(temporary, "xb") as file:  # not mkstemp, whose files nobody but the owner may read
                yield file
                file.flush()
                os.fsync(file.fileno())  # renamed before its content is on the disk, a power failure leaves it empty
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)
