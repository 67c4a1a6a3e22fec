"""Poses from AMASS (Mahmood et al. 2019): frames of recorded motions, over SMPL's joints.

AMASS bodies stand with Z up and turn to all sides. The root rotation R of a frame becomes A R with A = -90 degrees
about x, which takes Z up to our Y up: a person who stands has R = +90 degrees about x times a turn about the vertical.
"""

import hashlib
import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.assets import Asset
from datagen.errors import RecipeError
from datagen.poses.skeletons import JOINTS, PARENTS
from datagen.random import Stream, generator
from datagen.recipe import AmassPoses, PoseRecipe

_SPLIT_NAMES = ("root_orient.npy", "pose_body.npy")  # SMPL-X releases have these, mostly beside `poses`
_JOINTS_OF_WIDTH = {66: 22, 72: 24, 156: 22, 165: 22}  # body alone, SMPL, SMPL-H, SMPL-X: joints that are SMPL's
_TO_Y_UP = Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0])
_NAME_IT = "Name the folder of motions: --set data.poses.distribution.path=FOLDER"


@dataclass(frozen=True)
class Motion:
    """A motion file, its name within the set, and a fingerprint of its content."""

    name: str
    path: Path
    fingerprint: str


class AmassSource:
    """See :class:`datagen.poses.PoseSource`: each pose is a frame of a motion, both uniform.

    A motion is drawn first, then one of its frames at any of its times, so that long recordings weigh no more than
    short ones, and only the motions that are drawn are read.

    - SMPL's 24 joints; SMPL-H and SMPL-X have fingers instead of SMPL's hand joints, which then do not turn.
    - ``held_out``: that share of the motions gives all unseen poses, the others all seen ones. Which ones follows from
      the seed and their names, so that a motion that is added moves no other.
    - ``root: upright`` takes the turn about the vertical away. Training data faces +Z, and the network normalises
      position and size only: a body turned to the side would be another task than the one it learned.
    """

    joints, parents = JOINTS, PARENTS

    def __init__(self, recipe: PoseRecipe) -> None:
        wanted = recipe.distribution
        assert isinstance(wanted, AmassPoses)
        motions = find_motions(wanted.path)
        self._recipe, self._root = recipe, wanted.root
        self.assets = (Asset(f"AMASS motions ({len(motions)} files)", "as the files' owner states", _digest(motions)),)
        self._kept, self._held_out = _split(motions, wanted.held_out, recipe.seed)

    def draw(self, pose: int) -> NDArray[np.float64]:
        """Axis-angle [24, 3] in radians."""
        random = generator(self._recipe.seed, Stream.POSE, pose)
        motions = self._motions_for(pose)
        frames = _frames(motions[random.integers(len(motions))].path)
        return smpl_pose(frames[random.integers(len(frames))], root=self._root)

    def _motions_for(self, pose: int) -> list[Motion]:
        if not self._held_out or pose < self._recipe.seen:
            return self._kept
        if pose >= self._recipe.seen + self._recipe.unseen:
            # whether an appended pose is seen is not known here, and a held-out motion must not get into training
            raise RecipeError(
                "a dataset with held-out motions (data.poses.distribution.held_out) cannot get more poses. "
                "Append identities only, or make a new dataset"
            )
        return self._held_out


def smpl_pose(frame: NDArray[np.floating], *, root: str = "upright") -> NDArray[np.float64]:
    """One AMASS frame [66, 72, 156 or 165] as axis-angle [24, 3] in radians over SMPL's joints, Y up.

    ``root`` is that of :class:`datagen.recipe.AmassPoses`.
    """
    count = _JOINTS_OF_WIDTH[len(frame)]
    rotations = np.zeros((len(JOINTS), 3))
    rotations[:count] = frame[: 3 * count].reshape(count, 3)
    turned = _TO_Y_UP * Rotation.from_rotvec(rotations[0])
    if root == "upright":
        turned = without_heading(turned)
    # rounded because the last bits of arcus functions differ between machines
    rotations[0] = 0.0 if root == "drop" else np.round(turned.as_rotvec(), 9)
    return rotations


def without_heading(rotation: Rotation) -> Rotation:
    """A rotation R = T S without T, its twist about the vertical (Y); S turns about a horizontal axis.

    T is the quaternion of R restricted to (y, w). It is well defined also for a body that lies, whose forward axis has
    no heading; it is not for one exactly upside down, which stays as it is.
    """
    _, y, _, w = rotation.as_quat()
    if np.hypot(y, w) < 1e-6:
        return rotation
    return Rotation.from_quat([0.0, y, 0.0, w]).inv() * rotation


def find_motions(path: str) -> list[Motion]:
    """The motion files at a path, which is one or a folder of them at any depth, by name.

    Files without poses (AMASS keeps each subject's shape beside the motions) are passed over. Only the directory at
    the end of each .npz file is read: it holds every array's size and CRC-32, which make the fingerprint, and which
    are checked whenever an array is read. So a set of gigabytes is known without being read.

    Raises
    ------
    RecipeError
        Nothing there, or a file that is not .npz.
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
        with zipfile.ZipFile(path) as archive:
            members = {member.filename: member for member in archive.infolist()}
    except (OSError, zipfile.BadZipFile) as error:
        raise RecipeError(f"{path} is no .npz file ({error}). Fetch it again or take it away") from error
    if "poses.npy" in members:
        used = [members["poses.npy"]]
    elif members.keys() >= set(_SPLIT_NAMES):
        used = [members[each] for each in _SPLIT_NAMES]
    else:
        return None
    return Motion(name, path, " ".join(f"{each.filename} {each.file_size} {each.CRC:08x}" for each in used))


def _digest(motions: list[Motion]) -> str:
    lines = "".join(f"{motion.name}\0{motion.fingerprint}\n" for motion in motions)
    return f"sha256 of names, sizes, CRC-32:{hashlib.sha256(lines.encode()).hexdigest()}"


def _split(motions: list[Motion], held_out: float, seed: int) -> tuple[list[Motion], list[Motion]]:
    """Motions for seen poses, and those for unseen ones alone (none where nothing is held out)."""
    if not held_out:
        return motions, []
    count = max(1, round(held_out * len(motions)))
    if count >= len(motions):
        raise RecipeError(
            f"data.poses.distribution.held_out={held_out} of {len(motions)} motion files leaves none for seen poses. "
            "Hold out a smaller share, or none: --set data.poses.distribution.held_out=0"
        )
    shuffled = sorted(motions, key=lambda motion: hashlib.sha256(f"{seed} {motion.name}".encode()).digest())
    return shuffled[:-count], shuffled[-count:]


@lru_cache(maxsize=4)  # in a large set hardly a motion is drawn twice; in a small one this saves reading it each time
def _frames(path: Path) -> NDArray[np.float64]:
    """All frames [frame, 66, 72, 156 or 165] of a motion in radians."""
    try:
        with np.load(path, allow_pickle=False) as file:
            parts = [file["poses"]] if "poses" in file else [file[name.removesuffix(".npy")] for name in _SPLIT_NAMES]
            frames = np.concatenate(parts, axis=-1).astype(np.float64)
    except (OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise RecipeError(f"{path} cannot be read as a motion ({error}). Fetch it again or take it away") from error
    if frames.ndim != 2 or not len(frames) or frames.shape[1] not in _JOINTS_OF_WIDTH:
        raise RecipeError(
            f"{path}: poses have shape {frames.shape}; known are frames of {', '.join(map(str, _JOINTS_OF_WIDTH))} "
            "numbers (SMPL's body, SMPL, SMPL-H, SMPL-X). Take it away"
        )
    wrong = np.flatnonzero(~np.isfinite(frames).all(axis=1))
    if len(wrong):
        raise RecipeError(f"{path}: {len(wrong)} frames are not finite, the first is {wrong[0]}. Take it away")
    return frames
