"""What is refused: files that are too large, before they are read whole, and shapes that cannot be posed."""

import contextlib
import difflib
import json
import os
import struct
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import MeshError
from datagen.mesh.formats import FORMATS

if TYPE_CHECKING:
    from datagen.mesh.formats.ply_header import Header

VERTEX_LIMIT = 2_000_000
"""Vertices of a mesh at most; bodies for animation have a thousandth of it. What they take: docs/transfer.md."""
BYTE_LIMIT = 2**30
FRAME_LIMIT = 2_000
"""Frames of an animation at most."""
GLB_LIMIT = 2**32 - 2**16
"""Bytes of a GLB file that is written; it counts them in 32 bits."""
_CORNER_LIMIT = 12 * VERTEX_LIMIT  # of faces: a closed surface has two triangles a vertex, an open or torn one fewer
_LINE_LIMIT = 15 * VERTEX_LIMIT  # of a text: STL has seven lines a triangle
_WORD_LIMIT = 24 * VERTEX_LIMIT  # of a text: OBJ has some 19 words a vertex
_STL_WORD_LIMIT = 45 * VERTEX_LIMIT  # of 21 a triangle, most of which its reader passes over
_JSON_VALUES = 2**22  # of a glTF file; each takes some 100 bytes
_BLOCK = 2**22
_FLAT = 1e-6  # of the longest edge of the bounding box
_SPACES = bytes.maketrans(b"\t\r\n\v\f", b"     ")
DAMAGE = (
    LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RuntimeError, MemoryError, struct.error,
    np.linalg.LinAlgError,
)  # fmt: skip
"""What Python and NumPy raise on content that is not as its format wants it."""


def refuse_huge(path: Path) -> None:
    """Refuse a mesh file with too many vertices, by its header or by counting; a few MB of it are in memory.

    Raises
    ------
    MeshError
        More than ``VERTEX_LIMIT`` vertices, or more than ``BYTE_LIMIT`` bytes, or a text of far too many lines or words
        for so many vertices.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        advice = "decimate it (for example in Blender or MeshLab) and try again"
        if size > BYTE_LIMIT:
            raise MeshError(f"{path} has {size:,} bytes, more than {BYTE_LIMIT:,}: {advice}")
        found = _COUNTS[path.suffix.lower()](file, size)
        if found > VERTEX_LIMIT:
            raise MeshError(f"{path} has more than {VERTEX_LIMIT:,} vertices ({found:,} counted): {advice}")
        file.seek(0)
        if size > _LINE_LIMIT and _is_text(file.read(_BLOCK), path.suffix.lower(), size):
            file.seek(0)
            _refuse_long_text(file, path)


def _is_text(beginning: bytes, suffix: str, size: int) -> bool:
    if suffix == ".ply":
        return _ply_header(beginning).form == "ascii"
    return suffix != ".glb" and not (suffix == ".stl" and is_binary_stl(beginning[:84], size))


def _ply_header(beginning: bytes) -> "Header":
    from datagen.mesh.formats.ply_header import read_header

    return read_header(beginning)


def is_binary_stl(beginning: bytes, size: int) -> bool:
    """Whether an STL file of that size with that beginning (84 bytes) is binary: the length decides, texts vary."""
    return len(beginning) >= 84 and size == 84 + 50 * int.from_bytes(beginning[80:84], "little")


def _refuse_long_text(file: IO[bytes], path: Path) -> None:
    limit = _STL_WORD_LIMIT if path.suffix.lower() == ".stl" else _WORD_LIMIT
    lines = words = 0
    while block := file.read(_BLOCK):
        lines += block.count(b"\n") + block.count(b"\r")
        words += block.translate(_SPACES).count(b" ")
        if lines > _LINE_LIMIT or words > limit:
            raise MeshError(f"{path} has more lines or words than {VERTEX_LIMIT:,} vertices need: is it damaged?")


def require_counts(*, vertices: int = 0, corners: int = 0) -> None:
    """Refuse counts beyond those of the largest mesh, before memory is taken for them (ValueError)."""
    if not 0 <= vertices <= VERTEX_LIMIT:
        raise ValueError(f"it has {vertices:,} vertices, at most {VERTEX_LIMIT:,} are read")
    if not 0 <= corners <= _CORNER_LIMIT:
        raise ValueError(f"its faces have {corners:,} corners, at most {_CORNER_LIMIT:,} are read")


def parse_json(text: bytes) -> Any:
    """What a JSON text says; ValueError where it is none, or has so many values that they would fill the memory."""
    values = sum(text.count(mark) for mark in (b",", b"[", b"{"))
    if values > _JSON_VALUES:
        raise ValueError(f"its JSON has {values:,} values, more than {_JSON_VALUES:,}")
    return json.loads(text)


def _in_obj(file: IO[bytes], size: int) -> int:
    """Lines that begin with ``v``; counting ends where there are too many."""
    if size < 8 * VERTEX_LIMIT:  # "v 0 0 0\n"
        return 0
    found, end = 0, b"\n"
    while found <= VERTEX_LIMIT and (block := file.read(_BLOCK)):
        text = end + block.replace(b"\r", b"\n").replace(b"\t", b" ")
        found += text.count(b"\nv ")
        end = text[-2:]
    return found


def _in_ply(file: IO[bytes], size: int) -> int:
    header = _ply_header(file.read(_BLOCK))
    others = sum(element.count for element in header.elements if element.name != "vertex")
    return max(header.count("vertex"), others // 4)


def _in_off(file: IO[bytes], size: int) -> int:
    lines = [line.partition(b"#")[0].split() for line in file.read(_BLOCK).splitlines()]
    words = [word for line in lines for word in line][:3]
    numbers = [int(word) for word in words if word.isdigit()]
    return max(numbers[0], numbers[1] // 4) if len(numbers) > 1 else 0


def _in_stl(file: IO[bytes], size: int) -> int:
    """Corners are three a triangle, and six triangles meet in a vertex."""
    if is_binary_stl(file.read(84), size):
        return (size - 84) // 100
    return size // 500  # a facet of text has some 250 bytes


def _in_glb(file: IO[bytes], size: int) -> int:
    head = file.read(20)
    if head[:4] != b"glTF" or len(head) < 20:
        return 0
    length = struct.unpack_from("<I", head, 12)[0]
    described = parse_json(file.read(length))
    primitives = [each for mesh in described.get("meshes", ()) for each in mesh.get("primitives", ())]
    used = {each.get("attributes", {}).get("POSITION") for each in primitives}
    return max((described["accessors"][number]["count"] for number in used if number is not None), default=0)


_AS_GLB = "Export it as GLB (in Blender: File > Export > glTF 2.0)"
_BEGINNINGS = {
    b"glTF": ".glb", b"ply\n": ".ply", b"ply\r": ".ply", b"OFF\n": ".off", b"OFF\r": ".off",
    b"Kaydara FBX": "FBX", b"; FBX": "FBX", b"BLENDER": "a Blender file", b"PK\x03\x04": "a ZIP archive",
    b"\x1f\x8b": "a gzip archive", b"\x89PNG": "a PNG picture", b"\xff\xd8\xff": "a JPEG picture",
}  # fmt: skip
"""Of files whose first bytes tell what they are: suffixes of known formats, else what to call it."""
_HEAD = max(map(len, _BEGINNINGS))
_COUNTS = {".obj": _in_obj, ".ply": _in_ply, ".off": _in_off, ".stl": _in_stl, ".glb": _in_glb}


def require_file(path: Path) -> None:
    """Refuse what is no file, of no known format, or empty (MeshError)."""
    if os.path.isdir(path):
        raise MeshError(f"{path} is a folder; name a mesh file in it")
    if not os.path.isfile(path):  # Path's own raises on names that are too long
        if os.path.exists(path):
            raise MeshError(f"{path} is not a regular file")
        raise MeshError(f"no mesh file at {path}{_nearest_beside(path)}")
    if path.suffix.lower() not in FORMATS:
        raise MeshError(f"{_unknown_format(path)}. {_AS_GLB}")
    if path.stat().st_size == 0:
        raise MeshError(f"{path} is empty (0 bytes): export or copy it again")
    with path.open("rb") as file:
        content = _kind_of(file.read(_HEAD))
    if content in FORMATS and content != path.suffix.lower():
        raise MeshError(f"{path} is {content[1:].upper()} by its content: name it {path.with_suffix(content).name}")
    if content not in (*FORMATS, ""):
        raise MeshError(f"{path} is {content} by its content. {_AS_GLB}")


def _kind_of(head: bytes) -> str:
    """What a file is by its first bytes: a suffix of ours, the name of something else, or nothing that is known."""
    return next((kind for start, kind in _BEGINNINGS.items() if head.startswith(start)), "")


def require_known(path: Path) -> None:
    """Refuse a suffix of no known format (MeshError)."""
    if path.suffix.lower() not in FORMATS:
        raise MeshError(_unknown_format(path))


def _unknown_format(path: Path) -> str:
    return f"{path}: unknown mesh format {path.suffix!r}; known are {', '.join(FORMATS)}"


def _nearest_beside(path: Path) -> str:
    """Words that suggest the mesh file of the folder whose name is nearest, or none."""
    names = dict[str, Path]()
    with contextlib.suppress(OSError, ValueError):
        names = {each.stem: each for each in path.parent.iterdir() if each.suffix.lower() in FORMATS and each.exists()}
    close = difflib.get_close_matches(path.stem, names, n=1)
    return f", did you mean {names[close[0]]}?" if close else ""


def require_thickness(vertices: NDArray[np.float64], path: Path) -> None:
    """Refuse vertices [n, 3] in one plane (MeshError): they have no pose, and their normalised box would hide it."""
    extent = np.ptp(vertices, axis=0)
    flat = ["xyz"[axis] for axis in range(3) if extent[axis] <= _FLAT * extent.max()]
    if flat:
        raise MeshError(f"{path} is flat: it has no thickness along {' and '.join(flat)}; pose transfer needs a body")
    centred = (vertices - vertices.mean(axis=0)) / extent.max()
    if np.sqrt(max(np.linalg.eigvalsh(centred.T @ centred / len(centred))[0], 0)) <= _FLAT:
        raise MeshError(f"{path} is flat: all vertices lie in one slanted plane; pose transfer needs a body")
