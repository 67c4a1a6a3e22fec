"""A person's own mesh files: read with everything in them, and written again with other positions.

Nothing is merged or reordered on the way. In the same format the file itself is written again, so that what a
:class:`Mesh` has no place for (quads, materials, groups, further properties) stays; in another format what it can hold
is kept, and the rest is named. Each format has a reader of its own: a general library would split the vertices of an
OBJ file at its seams, and take longer to import than this command has time.

Limits: files of up to 2,000,000 vertices and 1 GiB; polygons with more than three corners count as fans of triangles;
all objects of an OBJ file are one mesh, as they share its vertices; glTF with compressed geometry is refused.
"""

import io
import os
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import BodyError, MeshError, StorageError
from datagen.common.files import read_bounded, write_atomically
from datagen.mesh.formats import FORMATS
from datagen.mesh.formats.glb_export import built_draft, built_glb
from datagen.mesh.formats.glb_writer import Draft
from datagen.mesh.formats.obj import ObjContent
from datagen.mesh.formats.obj_export import built_obj, one_word
from datagen.mesh.formats.obj_fast import read_plain
from datagen.mesh.formats.off_stl import OffContent, StlContent, built_off, built_stl
from datagen.mesh.formats.ply import PlyContent, built
from datagen.mesh.formats.surface import Content, Encoded, component_count
from datagen.mesh.geometry import Mesh, check_mesh
from datagen.mesh.limits import BYTE_LIMIT, refuse_huge, require_file, require_known, require_thickness

_TEXTS: dict[str, Callable[[bytes, Path], Content]] = {
    ".obj": ObjContent,
    ".ply": PlyContent,
    ".off": OffContent,
    ".stl": StlContent,
}
_DAMAGE = (
    LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RuntimeError, MemoryError, struct.error,
    np.linalg.LinAlgError,
)  # fmt: skip


@dataclass(frozen=True)
class MeshFile:
    """A mesh file that was read.

    Attributes
    ----------
    path
        Where it is.
    name
        The object's name in the file, else the file's stem.
    mesh
        ``vertices`` [n, 3] float64 as they lie in the file, in its own unit and axes (GLB: in world space);
        ``faces`` [f, 3] int64, polygons as fans of triangles.
    components
        Connected pieces of the mesh; vertices at one place count as connected.
    """

    path: Path
    name: str
    mesh: Mesh
    components: int
    content: Content = field(repr=False)


def read_mesh_file(path: str | Path, *, geometry: str | None = None) -> MeshFile:
    """Read a mesh file (OBJ, PLY, GLB, OFF or STL) with all that is needed to write it again.

    ``geometry`` names the one to take of a GLB scene that holds several; other formats are one mesh as a whole.

    Raises
    ------
    MeshError
        One line for whatever is wrong: no such file, unknown format, damage, no faces, numbers that are not finite,
        faces without vertices, no extent, no thickness, too many vertices, several geometries.
    """
    path = Path(path)
    require_file(path)
    try:
        refuse_huge(path)
        content = _content(path, geometry)
        vertices, faces = content.vertices, _faces(content, path)
    except MeshError:
        raise
    except BodyError as error:
        raise MeshError(str(error)) from error
    except OSError as error:
        raise MeshError(f"{path} cannot be read: {error.strerror or error}") from error
    except _DAMAGE as error:
        reason = error if isinstance(error, ValueError) else f"{type(error).__name__} {error}"
        raise MeshError(f"{path} cannot be read as {path.suffix[1:].upper()}: {_one_line(reason)}") from error
    mesh = check_mesh(Mesh(vertices, faces), name=str(path))
    require_thickness(vertices, path)
    return MeshFile(path, content.name or path.stem, mesh, component_count(vertices, faces), content)


def _one_line(reason: object) -> str:
    return " ".join(str(reason).split())[:300]


def _content(path: Path, geometry: str | None) -> Content:
    if path.suffix.lower() == ".glb":
        return _glb_content(path, geometry)
    content = _TEXTS[path.suffix.lower()](read_bounded(path, limit=BYTE_LIMIT), path)
    if geometry is not None:
        raise MeshError(
            f"{path} is one mesh as a whole; only a GLB has geometries to choose: save {geometry!r} by itself"
        )
    return content


def _glb_content(path: Path, geometry: str | None) -> Content:
    from datagen.mesh.formats.glb import (  # brings SciPy, which takes longer to import than to read
        GlbContent,
        GlbFile,
        solid_nodes,
    )

    with path.open("rb") as file:
        if file.read(4) != b"glTF":
            raise ValueError("it does not begin with 'glTF' (a text, or a .gltf by another name?)")
    scene = GlbFile(path)
    nodes = solid_nodes(scene)
    names = ", ".join(repr(name) for name in nodes)
    if not nodes:
        raise MeshError(f"{path} has no faces (a point cloud, lines, or an empty scene?); pose transfer needs a mesh")
    if geometry is not None and geometry not in nodes:
        raise MeshError(f"{path} has no geometry {geometry!r}; it has {names}")
    if geometry is None and len(nodes) > 1:
        how = "--source-geometry NAME or --target-geometry NAME"
        raise MeshError(f"{path} holds {len(nodes)} geometries: {names}. Choose one with {how}")
    name = geometry or next(iter(nodes))
    return GlbContent(scene, name, nodes[name])


def _faces(content: Content, path: Path) -> NDArray[np.int64]:
    surface = content.surface
    if surface.corners.size and not 0 <= surface.corners.min() <= surface.corners.max() < len(content.vertices):
        wrong = next(c for c in surface.corners.tolist() if not 0 <= c < len(content.vertices))
        raise MeshError(f"{path}: a face names vertex {wrong}, but there are {len(content.vertices)} (counted from 0)")
    if not len(surface.faces):
        what = (
            f"{len(content.vertices):,} vertices and no faces (a point cloud?)" if len(content.vertices) else "no mesh"
        )
        raise MeshError(f"{path} holds {what}; pose transfer needs faces")
    return surface.faces


def posed_bytes(original: MeshFile, vertices: NDArray[np.floating], suffix: str) -> bytes:
    """The original with other vertices [n, 3], as a file of the format of ``suffix``, without files beside it.

    Raises
    ------
    MeshError
        Unknown suffix, or vertices that are not the original's in number or not finite.
    """
    return _encoded(original, vertices, suffix.lower(), None).content


def _encoded(original: MeshFile, vertices: NDArray[np.floating], suffix: str, stem: str | None) -> Encoded:
    require_known(Path(f"mesh{suffix}"))
    positions = usable(original, vertices)
    if suffix == original.path.suffix.lower():
        return original.content.rewritten(positions)
    surface = original.content.surface
    if suffix == ".obj":
        made = built_obj(surface, positions, original.name, stem)
    elif suffix == ".glb":
        made = built_glb(surface, positions, original.name)
    else:
        made = {".ply": built, ".off": built_off, ".stl": built_stl}[suffix](surface, positions)
    return Encoded(made.content, made.beside, [*made.left_out, *original.content.only_here])


def usable(original: MeshFile, vertices: NDArray[np.floating]) -> NDArray[np.float64]:
    """Posed vertices [n, 3] as float64; MeshError where they are not the original's in number, or not finite."""
    found = np.asarray(vertices, np.float64)
    if found.shape != original.mesh.vertices.shape:
        raise MeshError(
            f"{original.path} has vertices {original.mesh.vertices.shape}, the posed ones are {found.shape}"
        )
    if not np.isfinite(found).all():
        wrong = int(np.flatnonzero(~np.isfinite(found).all(axis=1))[0])
        raise MeshError(f"posed vertices of {original.path} are not finite, the first is number {wrong}")
    return found


def write_posed(original: MeshFile, vertices: NDArray[np.floating], out: Path) -> list[str]:
    """Write the original with other vertices [n, 3]; the file appears whole or not at all. The suffix tells the format.

    Normals are made anew where the file has them. Materials and textures are copied beside an OBJ or PLY file that goes
    to another folder; a different file of that name is left alone, unless it is called after ``out``.

    Returns
    -------
    list of str
        What was left out because the format cannot hold it, or was not to be had; one line each.

    Raises
    ------
    MeshError
        Unknown suffix, or vertices that are not the original's in number or not finite.
    StorageError
        The file could not be written.
    """
    out = Path(out)
    made = _encoded(original, vertices, out.suffix.lower(), out.stem)
    notes = list(made.left_out)
    beside = dict(made.beside)
    if out.suffix.lower() == original.path.suffix.lower() and _folder(out) != _folder(original.path):
        along = original.content.companions()
        beside |= along.beside
        notes += along.left_out
    for name, content in beside.items():
        notes += _write_beside(out, name, content)
    write_atomically(out, made.content)
    return list(dict.fromkeys(notes))


def _folder(path: Path) -> Path:
    return path.parent.resolve()


def _write_beside(out: Path, name: str, content: bytes) -> list[str]:
    place = out.parent / name
    if place.is_file() and place.stat().st_size == len(content) and place.read_bytes() == content:
        return []
    called_after = re.fullmatch(rf"({re.escape(out.stem)}|{re.escape(one_word(out.stem))})(-\d+)?\.\w+", name)
    if place.exists() and not called_after:
        return [f"{name}: another file of that name is in {out.parent} and was left as it is"]
    write_atomically(place, content)
    return []


def draft_of(original: MeshFile) -> Draft:
    """The original as a GLB file that lacks only its positions."""
    from datagen.mesh.formats.glb import GlbContent

    if isinstance(original.content, GlbContent):
        return original.content.draft()
    return built_draft(original.content.surface, len(original.mesh.vertices), original.name)[0]


def check_writable(out: Path) -> None:
    """Refuse an output file that could not be written, before any work; its folder is made.

    Raises
    ------
    MeshError
        Unknown suffix, or a folder where the file is to be.
    StorageError
        The folder cannot be made or written to.
    """
    out = Path(out)
    if out.is_dir():
        raise MeshError(f"{out} is a folder; name the file to write, for example {out / 'posed.obj'}")
    require_known(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"the folder {out.parent} cannot be made: {error.strerror or error}") from error
    if not os.access(out.parent, os.W_OK | os.X_OK):
        raise StorageError(f"the folder {out.parent} cannot be written to: choose another place for {out.name}")


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh file, keeping its vertex order (nothing is merged or reordered).

    Raises
    ------
    MeshError
        The file is missing, of an unknown format, unreadable, or not one usable triangle mesh.
    """
    from datagen.mesh.limits import BYTE_LIMIT, refuse_huge, require_file

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
