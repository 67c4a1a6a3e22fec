"""A person's own mesh files: read with everything in them, and written again with other positions.

Nothing is merged or reordered on the way. In the same format the file itself is written again, so that what a
:class:`Mesh` has no place for (quads, materials, groups, further properties) stays; in another format what it can hold
is kept, and the rest is named. Each format has a reader of its own: a general library would split the vertices of an
OBJ file at its seams, and take longer to import than this command has time.

Limits: files of up to 2,000,000 vertices and 1 GiB; polygons with more than three corners count as fans of triangles;
all geometries of a GLB file and all objects of an OBJ file are one mesh, unless some are chosen; glTF with compressed
geometry is refused.
"""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import BodyError, MeshError, StorageError, storage_errors
from datagen.common.files import write_atomically
from datagen.mesh.formats import format_of
from datagen.mesh.formats.surface import Content, Encoded, one_word
from datagen.mesh.geometries import require_one_body
from datagen.mesh.geometry import NEEDS_FACES, InFaces, Mesh, check_mesh
from datagen.mesh.limits import DAMAGE, refuse_huge, require_file, require_known, require_thickness

if TYPE_CHECKING:
    from datagen.mesh.formats.glb_writer import Draft


@dataclass(frozen=True)
class MeshFile:
    """A mesh file that was read.

    Attributes
    ----------
    path
        Where it is.
    name
        The object's name in the file, else the file's stem.
    geometries
        Names of those that the mesh is made of, as a GLB has them; none in formats that have no such names.
    mesh
        ``vertices`` [n, 3] float64 as they lie in the file, in its own unit and axes (GLB: in world space);
        ``faces`` [f, 3] int64, polygons as fans of triangles.
    """

    path: Path
    name: str
    mesh: Mesh
    content: Content = field(repr=False)

    @property
    def geometries(self) -> tuple[str, ...]:
        return self.content.geometries


def read_mesh_file(
    path: str | Path, *, geometries: Sequence[str] = (), is_body: bool = False, points: bool = False
) -> MeshFile:
    """Read a mesh file (OBJ, PLY, GLB, OFF or STL) with all that is needed to write it again.

    ``geometries`` names those to take of a GLB scene, or groups and objects of an OBJ; by default all are one mesh. Of
    what is to be a body objects of an OBJ are refused that do not make one, as geometries of a GLB always are.
    ``points``: an OBJ or a PLY without faces is taken, too.

    Raises
    ------
    MeshError
        One line for whatever is wrong: no such file, unknown format, damage, no faces, numbers that are not finite,
        faces without vertices, no extent, no thickness, too many vertices, geometries that are not one body.
    """
    read = _read(Path(path), geometries, points=points)
    seen = InFaces.checked(read.mesh, name=str(path), points=points).mesh
    require_thickness(np.asarray(seen.vertices, np.float64), read.path)
    if is_body and not geometries and read.path.suffix.lower() == ".obj":
        from datagen.mesh.formats.obj import ObjContent

        assert isinstance(read.content, ObjContent)
        require_one_body(read.content.extents, read.path)
    return read


def load_mesh(path: str | Path) -> Mesh:
    """Read vertices and faces alone, as data sets have them, in the file's order; they may be flat.

    Raises
    ------
    MeshError
        The file is missing, of an unknown format, unreadable, or not one usable mesh.
    """
    return _read(Path(path), ()).mesh


def geometry_names(path: str | Path) -> tuple[str, ...]:
    """Names that ``geometries`` of :func:`read_mesh_file` can be: a GLB's geometries, an OBJ's objects or groups.

    Raises
    ------
    MeshError
        As :func:`read_mesh_file`, as far as the file is read.
    """
    path = Path(path)
    with _reading(path):
        return format_of(path.suffix.lower()).names(path)


def _read(path: Path, geometries: Sequence[str], *, points: bool = False) -> MeshFile:
    with _reading(path):
        content = format_of(path.suffix.lower()).read(path, geometries)
        vertices, faces = content.vertices, _faces(content, path, points=points)
    mesh = check_mesh(Mesh(vertices, faces), name=str(path), points=points)
    return MeshFile(path, content.name or path.stem, mesh, content)


_DIGITS, _ROUNDED = 8, 1e-4
"""Digits of numbers in text files after the first; share of a mesh' longest extent by which its file may round."""


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Whatever is wrong with a file as MeshError, in one line."""
    try:
        require_file(path)
        refuse_huge(path)
        yield
    except MeshError:
        raise
    except BodyError as error:
        raise MeshError(str(error)) from error
    except OSError as error:
        raise MeshError(f"{path} cannot be read: {error.strerror or error}") from error
    except DAMAGE as error:
        reason = error if isinstance(error, ValueError) else f"{type(error).__name__} {error}"
        raise MeshError(f"{path} cannot be read as {path.suffix[1:].upper()}: {_one_line(reason)}") from error


def _one_line(reason: object) -> str:
    return " ".join(str(reason).split())[:300]


def _faces(content: Content, path: Path, *, points: bool) -> NDArray[np.int64]:
    surface = content.surface
    if surface.corners.size and not 0 <= surface.corners.min() <= surface.corners.max() < len(content.vertices):
        wrong = next(c for c in surface.corners.tolist() if not 0 <= c < len(content.vertices))
        raise MeshError(f"{path}: a face names vertex {wrong}, but there are {len(content.vertices)} (counted from 0)")
    if not len(content.vertices):
        raise MeshError(f"{path} holds no mesh")
    if not len(surface.faces) and not points:
        raise MeshError(f"{path} holds {len(content.vertices):,} vertices and no faces (a point cloud?); {NEEDS_FACES}")
    return surface.faces.reshape(-1, 3)


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


class Written(NamedTuple):
    """Files that were written, the mesh last, and what was left out because it has no place there; one line each."""

    files: list[Path]
    left_out: list[str]


def write_posed(original: MeshFile, vertices: NDArray[np.floating], out: Path, *, beside: bool = True) -> Written:
    """Write the original with other vertices [n, 3]; the file appears whole or not at all. The suffix tells the format.

    Normals are made anew where the file has them. Materials and textures are copied beside an OBJ or PLY file that goes
    to another folder; a different file of that name is left alone, unless it is called after ``out``. With ``beside``
    False nothing is written but the file.

    Raises
    ------
    MeshError
        Unknown suffix, or vertices that are not the original's in number or not finite.
    StorageError
        The file could not be written.
    """
    out = Path(out)
    require_known(out)
    made = _encoded(original, usable(original, vertices), out)
    files, left_out = list[Path](), list(made.left_out)
    for name, content in made.beside.items() if beside else ():
        if _write_beside(out, name, content):
            files.append(out.parent / name)
        else:
            left_out.append(f"{name}: another file of that name is in {out.parent} and was left as it is")
    write_atomically(out, made.content)
    return Written([*files, out], list(dict.fromkeys([*left_out, *lost_digits(original, np.asarray(vertices), out)])))


def lost_digits(original: MeshFile, vertices: NDArray[np.floating], out: Path) -> list[str]:
    """What to say where numbers of a file are too short for vertices [n, 3] that far from the origin; else nothing.

    Nor is anything said of a GLB, PLY or STL that stays one, as its numbers and nodes are those that the file had.
    """
    suffix = out.suffix.lower()
    if suffix == original.path.suffix.lower() and suffix not in (".obj", ".off"):
        return []
    far, size = float(np.abs(vertices).max()), float(np.ptp(vertices, axis=0).max())
    if suffix in (".obj", ".off"):
        off = 0.5 * 10.0 ** (np.floor(np.log10(max(far, 1e-300))) - _DIGITS)
    else:
        off = float(np.spacing(np.float32(far))) / 2
    if off <= _ROUNDED * size:
        return []
    return [f"positions to better than {off:.1g}, as coordinates reach {far:,.0f} (move the target near the origin)"]


def _encoded(original: MeshFile, vertices: NDArray[np.float64], out: Path) -> Encoded:
    suffix, content = out.suffix.lower(), original.content
    if suffix != original.path.suffix.lower():
        made = format_of(suffix).build(content.surface, vertices, original.name, out.stem)
        return Encoded(made.content, made.beside, [*made.left_out, *content.only_here])
    made = content.rewritten(vertices)
    along = content.companions() if _folder(out) != _folder(original.path) else Encoded(b"")
    return Encoded(made.content, along.beside, [*made.left_out, *along.left_out])


def _folder(path: Path) -> Path:
    return path.parent.resolve()


def _write_beside(out: Path, name: str, content: bytes) -> bool:
    """Whether the content stands there now; a different file of that name is left alone."""
    place = out.parent / name
    if place.is_file() and place.stat().st_size == len(content) and place.read_bytes() == content:
        return True
    called_after = re.fullmatch(rf"({re.escape(out.stem)}|{re.escape(one_word(out.stem))})(-\d+)?\.\w+", name)
    if place.exists() and not called_after:
        return False
    write_atomically(place, content)
    return True


def draft_of(original: MeshFile) -> tuple["Draft", list[str]]:
    """Return the original as a GLB file that lacks only its positions, and what has no place there, a line each."""
    from datagen.mesh.formats.glb import GlbContent
    from datagen.mesh.formats.glb_export import built_draft

    content = original.content
    if isinstance(content, GlbContent):
        return content.draft(), content.lost
    draft, left_out = built_draft(content.surface, len(original.mesh.vertices), original.name)
    return draft, [*left_out, *content.only_here]


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
    with storage_errors(f"to {out.parent}", advice=f"Choose another place for {out.name}"):
        out.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(out.parent, os.W_OK | os.X_OK):
        raise StorageError(f"the folder {out.parent} cannot be written to: choose another place for {out.name}")


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
    require_known(path)
    import trimesh

    exported: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type=path.suffix[1:].lower())
    write_atomically(path, exported.encode() if isinstance(exported, str) else exported)
