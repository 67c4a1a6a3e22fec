"""Files that a person sends to the page: what is taken, and the folder of the session in which they lie.

A file gets a name of harmless letters in a folder of its own, whatever it was called, and is then read as
``dsffnet transfer`` reads it. A zip holds the frames of a sequence, or a mesh with its materials and textures, in which
case these lie where they lay beside it.
"""

import io
import lzma
import re
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from datagen.common.errors import MeshError
from datagen.common.printable import printable
from datagen.mesh.formats import FORMATS
from datagen.mesh.sequences import frames_of

BYTE_LIMIT = 64 * 2**20
"""Of one upload."""
UNPACKED_LIMIT = 4 * BYTE_LIMIT
FRAME_LIMIT = 240
VERTEX_LIMIT = 100_000
"""Of a mesh on the page; ``dsffnet transfer`` takes more."""
ACCEPTED = ",".join((*FORMATS, ".zip"))
POSES = ".npz"
_BESIDE = (".mtl", ".png", ".jpg", ".jpeg")  # of an OBJ or PLY
_LONGEST_NAME, _DEEPEST = 60, 8
_UNREADABLE = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, ValueError,
    RuntimeError,  # of one with a password; its NotImplementedError of a compression that Python does not know
)  # fmt: skip


def require_size(name: str, size: int) -> None:
    """Refuse an upload by the size that is announced.

    Raises
    ------
    MeshError
        It is too large.
    """
    if size > BYTE_LIMIT:
        raise MeshError(
            f"{printable(name)} has {size / 2**20:,.0f} MB, the page takes {BYTE_LIMIT // 2**20}: decimate it, or use "
            "dsffnet transfer"
        )


def keep(name: str, content: bytes, folder: Path, *, most: int = FRAME_LIMIT) -> list[Path]:
    """Write an upload into a folder that is not there yet; its mesh files, at most ``most``, in their order.

    Raises
    ------
    MeshError
        It is too large, of an unknown format, or a zip that holds no meshes, too many, or too much.
    """
    require_size(name, len(content))
    suffix = _suffix(name)
    if suffix not in (*FORMATS, ".zip"):
        raise MeshError(f"{printable(name)} is none of {', '.join(FORMATS)}, nor a .zip of such frames")
    files = _unpacked(name, content, most) if suffix == ".zip" else {Path(_harmless(name).name): content}
    beside = {path.parent for path in files if _suffix(path.name) in FORMATS}
    if len(beside) > 1:
        raise MeshError(f"{printable(name)} holds meshes in {len(beside)} folders: put those of one sequence into one")
    for harmless, its in files.items():
        (folder / harmless).parent.mkdir(parents=True, exist_ok=True)
        (folder / harmless).write_bytes(its)
    return frames_of(folder / beside.pop())


def keep_poses(name: str, content: bytes, folder: Path) -> Path:
    """Write an upload of poses into a folder that is not there yet.

    Raises
    ------
    MeshError
        It is too large, or no .npz.
    """
    require_size(name, len(content))
    if _suffix(name) != POSES:
        raise MeshError(f"{printable(name)} is no {POSES} of poses (docs/demo.md)")
    folder.mkdir(parents=True)
    path = folder / _harmless(name).name
    path.write_bytes(content)
    return path


def _unpacked(name: str, content: bytes, most: int) -> dict[Path, bytes]:
    """Meshes, materials and textures of a zip, by the place that each gets."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            wanted = [entry for entry in archive.infolist() if _is_wanted(entry)]
            _require_few(name, wanted, most)
            files = {_harmless(entry.filename): archive.read(entry) for entry in wanted}
    except _UNREADABLE as error:
        raise MeshError(f"{printable(name)} cannot be read as a zip: {error}") from error
    if len(files) < len(wanted) or any(parent in files for path in files for parent in path.parents):
        raise MeshError(f"{printable(name)} holds two files of one name; frames need names of their own")
    return files


def _is_wanted(entry: zipfile.ZipInfo) -> bool:
    path = PurePosixPath(entry.filename.replace("\\", "/"))
    is_hidden = path.name.startswith(".") or "__MACOSX" in path.parts
    return not entry.is_dir() and not is_hidden and _suffix(path.name) in (*FORMATS, *_BESIDE)


def _require_few(name: str, entries: list[zipfile.ZipInfo], most: int) -> None:
    """Refuse by what the zip says of itself; no more than it says is ever unpacked."""
    meshes = sum(_suffix(entry.filename) in FORMATS for entry in entries)
    size = sum(entry.file_size for entry in entries)
    if not meshes:
        raise MeshError(f"{printable(name)} holds no mesh files ({', '.join(FORMATS)})")
    if meshes > most or len(entries) > 2 * FRAME_LIMIT:
        raise MeshError(f"{printable(name)} holds {meshes:,} meshes, {most:,} can be taken here: use dsffnet transfer")
    if size > UNPACKED_LIMIT:
        raise MeshError(
            f"{printable(name)} holds {size / 2**20:,.0f} MB, the page takes {UNPACKED_LIMIT // 2**20}: use dsffnet "
            "transfer"
        )


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()


def _harmless(name: str) -> Path:
    """A file's place below a folder that nothing leaves, of few letters; materials name each other with spaces."""
    parts = [part for part in re.split(r"[\\/]", name) if part not in ("", ".", "..")]
    return Path(*map(_harmless_part, parts[-_DEEPEST:]))


def _harmless_part(part: str) -> str:
    plain = re.sub(r"[^\w. -]+", "_", part, flags=re.ASCII)
    path = PurePosixPath(plain)
    return f"{path.stem.lstrip('.-')[-_LONGEST_NAME:] or 'mesh'}{path.suffix[:_LONGEST_NAME]}"
