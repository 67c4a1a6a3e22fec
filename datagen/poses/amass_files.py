"""The motion files of AMASS (Mahmood et al. 2019): finding them, and reading their frames."""

import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import RecipeError, reason_of
from datagen.common.npz import FAULTS, Header, member_header, opened, read_arrays
from datagen.common.printable import counted

JOINTS_OF_WIDTH = {66: 22, 72: 24, 156: 22, 165: 22}
"""Numbers in a frame (body alone, SMPL, SMPL-H, SMPL-X) -> how many of its first joints are SMPL's."""

_SPLIT_NAMES = ("root_orient.npy", "pose_body.npy")  # SMPL-X releases have these, mostly beside `poses`
_NAMES = (("poses.npy",), _SPLIT_NAMES)
_LARGEST_ANGLE = 1e6  # radians; sines of numbers far beyond are not finite
_NAME_IT = "Name the folder of motions: --set data.poses.distribution.path=FOLDER"


@dataclass(frozen=True)
class Motion:
    """A motion file, its name within the set, a fingerprint of its content, and how many ``frames`` it has."""

    name: str
    path: Path
    fingerprint: str
    frames: int


def find_motions(path: str) -> list[Motion]:
    """The motion files at a path, which is one or a folder of them at any depth, by name.

    Files without poses (AMASS keeps each subject's shape beside the motions) are passed over. Only the directory at
    the end of each .npz file is read, and the arrays' headers: the directory holds every array's size and CRC-32,
    which make the fingerprint, and which are checked whenever an array is read. So a set of gigabytes is known without
    being read.

    Raises
    ------
    RecipeError
        Nothing there, or a file that is not .npz, or poses of a shape that is not known.
    """
    place = Path(path)
    if not path or not place.exists():
        raise RecipeError(f"no motions at {path!r}. {_NAME_IT}")
    files = [place] if place.is_file() else sorted(place.rglob("*.npz"), key=lambda file: file.as_posix())
    folder = place.parent if place.is_file() else place
    found = (_motion(file, file.relative_to(folder).as_posix()) for file in files)
    motions = [motion for motion in found if motion]
    if not motions:
        raise RecipeError(f"{path} has no .npz file with `poses` (of {len(files)} .npz files). {_NAME_IT}")
    return motions


def _motion(path: Path, name: str) -> Motion | None:
    try:
        with opened(path) as archive:
            used = _used(archive)
            headers = [member_header(archive, each.filename) for each in used]
    except FAULTS as error:
        raise RecipeError(f"{path} is no .npz file ({reason_of(error)}). Fetch it again or take it away") from error
    if not used:
        return None
    fingerprint = " ".join(f"{each.filename} {each.file_size} {each.CRC:08x}" for each in used)
    return Motion(name, path, fingerprint, _frame_count(path, headers))


def _used(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """The members that hold a motion; none where there is no motion."""
    members = {member.filename: member for member in archive.infolist()}
    names = next((names for names in _NAMES if members.keys() >= set(names)), ())
    return [members[name] for name in names]


def _frame_count(path: Path, headers: list[Header]) -> int:
    for _, kind in headers:
        if kind.kind not in "fiu":
            raise RecipeError(
                f"{path} cannot be read as a motion (its poses are of type {kind}). Fetch it again or take it away"
            )
    shapes = [shape for shape, _ in headers]
    flat = all(len(shape) == 2 and shape[0] == shapes[0][0] for shape in shapes)
    shape = (shapes[0][0], sum(size[1] for size in shapes)) if flat else shapes[0]
    if not flat or not shape[0] or shape[1] not in JOINTS_OF_WIDTH:
        raise RecipeError(
            f"{path}: poses have shape {shape}; known are frames of {', '.join(map(str, JOINTS_OF_WIDTH))} "
            "numbers (SMPL's body, SMPL, SMPL-H, SMPL-X). Take it away"
        )
    return shape[0]


@lru_cache(maxsize=32)  # in a large set hardly a motion is drawn twice; in a small one this saves reading it each time
def read_frames(motion: Motion) -> NDArray[np.float64]:
    """All frames [frame, 66 or 72] of a motion in radians, without what is not SMPL's."""
    path = motion.path
    try:
        arrays = read_arrays(path, ("poses",)) or read_arrays(path, tuple(n.removesuffix(".npy") for n in _SPLIT_NAMES))
        frames = np.concatenate(list(arrays.values()), axis=-1).astype(np.float64)
    except FAULTS as error:
        raise RecipeError(
            f"{path} cannot be read as a motion ({reason_of(error)}). Fetch it again or take it away"
        ) from error
    if frames.ndim != 2 or len(frames) != motion.frames or frames.shape[1] not in JOINTS_OF_WIDTH:
        raise RecipeError(f"{path} has changed while it was in use. Run the same command again")
    wrong = np.flatnonzero(~(np.abs(frames) <= _LARGEST_ANGLE).all(axis=1))
    if len(wrong):
        raise RecipeError(
            f"{path}: not finite, or far from any angle: {counted(len(wrong), 'frame')}, the first is {wrong[0]}. "
            "Take it away"
        )
    return frames[:, : 3 * JOINTS_OF_WIDTH[frames.shape[1]]].copy()
