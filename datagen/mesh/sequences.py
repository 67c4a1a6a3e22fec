"""Sequences of meshes: files of frames, and one animated GLB of many frames."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import MeshError
from datagen.mesh.files import MeshFile, check_writable, draft_of, lost_digits, usable
from datagen.mesh.formats import FORMATS
from datagen.mesh.limits import FRAME_LIMIT, GLB_LIMIT


def frames_of(path: str | Path) -> list[Path]:
    """Return the mesh files of a folder, or of a pattern (``*.obj``, ``%04d.obj``, ``##.obj``).

    In natural order: 2 before 10. Mesh files of several formats are refused, for they would take turns.

    Raises
    ------
    MeshError
        No such file, no mesh files there, or several formats.
    """
    path = Path(path)
    if path.is_dir():
        found = [each for each in path.iterdir() if _is_mesh(each)]
    elif is_pattern(path):
        name = _NUMBER.sub("[0-9]*", path.name)
        found = [each for each in path.parent.glob(name) if _is_mesh(each)] if path.parent.is_dir() else []
    else:
        raise MeshError(f"no mesh file or folder at {path}")
    if not found:
        raise MeshError(f"{path} holds no mesh files ({', '.join(FORMATS)})")
    kinds = sorted({each.suffix.lower() for each in found})
    if len(kinds) > 1:
        raise MeshError(f"{path} holds meshes of several formats; choose one with a pattern, such as '*{kinds[0]}'")
    return sorted(found, key=_natural)


def is_pattern(path: Path) -> bool:
    """Return whether a path stands for several files; one that is there under this very name does not."""
    return not path.exists() and (any(sign in path.name for sign in "*?[") or bool(_NUMBER.search(path.name)))


_NUMBER = re.compile(r"%\d*d|#+")


def _is_mesh(path: Path) -> bool:
    return path.suffix.lower() in FORMATS and not path.name.startswith(".") and path.is_file()


def _natural(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part)) if part.isdigit() else (0, part.lower()) for part in parts if part], path.name


def require_animation(original: MeshFile, frames: int) -> None:
    """Refuse so many frames of a mesh as one animation, before any is made.

    Raises
    ------
    MeshError
        They are more than ``FRAME_LIMIT``, or than 4 GiB.
    """
    if frames > FRAME_LIMIT:
        raise MeshError(f"{frames:,} frames are more than {FRAME_LIMIT:,}: an animated GLB of so many plays nowhere")
    size = frames * draft_of(original)[0].frame_bytes
    if size > GLB_LIMIT:
        raise MeshError(f"{frames:,} frames of {original.path} need {size:,} bytes, an animated GLB holds 4 GiB")


def write_animation(
    original: MeshFile,
    frames: Iterable[NDArray[np.floating]],
    out: Path,
    *,
    frames_per_second: float,
) -> list[str]:
    """Write frames [frame, n, 3] of a mesh as one GLB with an animation; the file appears whole or not at all.

    Frame k is a morph target, the difference from frame 0, and shows alone at k / ``frames_per_second`` seconds;
    between them vertices move straight from one to the next. Materials, textures and texture coordinates are the
    original's; normals move along, so a file that has none becomes smooth. Frames may be made one by one: in memory are
    one frame and frames x frames weights of four bytes, the rest waits on disk (24 bytes a vertex and frame, as in the
    file).

    At most 2,000 frames and 4 GiB. Players keep all morph targets in a texture of the graphics card; WebGL promises
    room for 256 of them, usual cards have 2,048.

    Returns
    -------
    list of str
        What of the original is not in it, a line each.

    Raises
    ------
    MeshError
        ``out`` is no .glb, no frame or too many, frames that are not the mesh's in shape or not finite, or a rate that
        is none.
    StorageError
        The file could not be written.
    """
    out = Path(out)
    if out.suffix.lower() != ".glb":
        raise MeshError(f"{out}: an animation is a .glb file, not {out.suffix!r}")
    if not (np.isfinite(frames_per_second) and frames_per_second > 0):
        raise MeshError(f"frames per second must be above 0, not {frames_per_second}")
    check_writable(out)
    sound = (usable(original, frame) for frame in frames)
    draft, left_out = draft_of(original)
    draft.animated(sound, out, frames_per_second=frames_per_second)
    return [*left_out, *lost_digits(original, original.mesh.vertices, out)]
