"""Poses that exist already as files: AMASS motions, a file of one's own, and the numbered poses of imported meshes."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.common.assets import Asset, file_asset
from datagen.common.errors import RecipeError, reason_of
from datagen.common.files import write_atomically
from datagen.common.npz import FAULTS, read_arrays
from datagen.common.printable import counted
from datagen.mesh.rig import drivers_of
from datagen.poses import Poses
from datagen.poses.skeletons import JOINTS, PARENTS, SMAL_JOINTS, SMAL_PARENTS
from datagen.recipe import FilePoses, PoseRecipe

NUMBER = "number"
"""The pseudo-joint of found poses."""

_LICENCE = "as the file's owner states"
_LARGEST_ANGLE = 1e6  # radians; sines of numbers far beyond are not finite
_TWO_TURNS = 4 * np.pi
_ARRAYS = ("poses", "joints", "parents")
_MOST_JOINTS = 10_000
MAKE_ONE = "datagen.poses.pose_files.write_pose_file makes one"
"""How errors end."""


class FoundSource:
    """See :class:`datagen.poses.PoseSource`: the poses that imported meshes are in, whose joints nobody knows.

    Pose p is one pseudo-joint, called :data:`NUMBER`, whose "rotation" [p, 0, 0] is no rotation but the number itself:
    that way it reaches :class:`datagen.bodies.imported.ImportedModel`, the only body that has such a joint, through
    the same calls as any pose. Other bodies refuse it, as they refuse any joint that they lack.
    """

    joints = (NUMBER,)
    parents = (-1,)
    assets: tuple[Asset, ...] = ()

    def __init__(self, recipe: PoseRecipe) -> None:
        pass

    def draw(self, pose: int) -> NDArray[np.float64]:
        """The pose's number as [[p, 0, 0]]."""
        return np.array([[float(pose), 0.0, 0.0]])


class FileSource:
    """See :class:`datagen.poses.PoseSource`: the poses of a .npz file, in its order.

    An unseen pose that equals a seen one is refused: it would be no unseen one.
    """

    def __init__(self, recipe: PoseRecipe) -> None:
        assert isinstance(recipe.distribution, FilePoses)
        self._path = Path(recipe.distribution.path)
        poses = read_pose_file(self._path)
        self.joints, self.parents, self._rotations = poses.joints, poses.parents, poses.rotations
        self.assets = (file_asset(self._path, licence=_LICENCE),)
        self._require(recipe.seen + recipe.unseen, f" ({recipe.seen} seen + {recipe.unseen} unseen)")
        self._require_new(recipe.seen, recipe.unseen)

    def draw(self, pose: int) -> NDArray[np.float64]:
        """Axis-angle [joint, 3] in radians."""
        self._require(pose + 1)
        return self._rotations[pose]

    def _require(self, wanted: int, why: str = "") -> None:
        if wanted > len(self._rotations):
            raise RecipeError(
                f"the recipe asks for {wanted} poses{why}, but {self._path} has {len(self._rotations)}. Ask for fewer: "
                "--set data.poses.seen=... or --set data.poses.unseen=..."
            )

    def _require_new(self, seen: int, unseen: int) -> None:
        first = {pose.tobytes(): number for number, pose in reversed(list(enumerate(self._rotations[:seen] + 0.0)))}
        for number, pose in enumerate(self._rotations[seen : seen + unseen] + 0.0, start=seen):
            if pose.tobytes() in first:
                raise RecipeError(
                    f"{self._path}: pose {number} is to be unseen, but equals pose {first[pose.tobytes()]}, which is "
                    "seen. Leave it out, or ask for other numbers: --set data.poses.seen=... data.poses.unseen=..."
                )


def read_pose_file(path: str | Path) -> Poses:
    """Read a .npz file: ``poses`` [pose, joint, 3], axis-angle in radians, ``joints`` [joint], ``parents`` [joint].

    ``parents`` (the parent's place, -1 for a root) may be left out where the names are SMPL's or SMAL's.

    Raises
    ------
    RecipeError
        No such file, or one that holds no such poses.
    """
    arrays = _arrays(Path(path))
    for name in ("poses", "joints"):
        if name not in arrays:
            raise RecipeError(f"{path} has no array {name!r}; it has {', '.join(arrays) or 'none'}. {MAKE_ONE}")
    joints = _names(path, arrays["joints"])
    return Poses(joints, _parents(path, joints, arrays.get("parents")), _rotations(path, arrays["poses"], joints))


def write_pose_file(path: str | Path, poses: Poses) -> None:
    """Write poses so that the source ``file`` draws them (StorageError where that is not possible)."""
    content = io.BytesIO()
    np.savez(content, poses=poses.rotations, joints=np.array(poses.joints), parents=np.array(poses.parents, np.int32))
    write_atomically(Path(path), content.getvalue())


def _arrays(path: Path) -> dict[str, NDArray[np.generic]]:
    if not path.is_file():
        raise RecipeError(
            f"no pose file at {str(path)!r}. Name it: --set data.poses.distribution.path=FILE.npz; {MAKE_ONE}"
        )
    try:
        return read_arrays(path, _ARRAYS)
    except FAULTS as error:
        raise RecipeError(f"{path} is no .npz file of plain arrays ({reason_of(error)}). {MAKE_ONE}") from error


def _rotations(path: str | Path, poses: NDArray[np.generic], joints: Sequence[str]) -> NDArray[np.float64]:
    if poses.ndim != 3 or poses.shape[1:] != (len(joints), 3) or poses.dtype.kind not in "fiu":
        raise RecipeError(
            f"{path}: `poses` has shape {poses.shape} and type {poses.dtype}; with {counted(len(joints), 'joint')} it "
            f"must be numbers [pose, {len(joints)}, 3]. {MAKE_ONE}"
        )
    rotations = poses.astype(np.float64)
    wrong = np.flatnonzero(~(np.abs(rotations) <= _LARGEST_ANGLE).all(axis=(1, 2)))
    if len(wrong):
        raise RecipeError(
            f"{path}: not finite, or far from any angle in radians: {counted(len(wrong), 'pose')}, the first is number "
            f"{wrong[0]}. Leave them out"
        )
    lengths = np.linalg.norm(rotations, axis=2)
    if lengths.size and lengths.max() > _TWO_TURNS:
        pose, joint = np.argwhere(lengths > _TWO_TURNS)[0].tolist()
        raise RecipeError(
            f"{path}: pose {pose} turns joint {joint} ({joints[joint]!r}) by {lengths[pose, joint]:.4g}, more than two "
            "turns (12.57): are these degrees? they must be radians. Convert them: numpy.radians(poses)"
        )
    return rotations


def _names(path: str | Path, joints: NDArray[np.generic]) -> tuple[str, ...]:
    if joints.ndim > 1 or joints.dtype.kind != "U":
        raise RecipeError(
            f"{path}: `joints` has shape {joints.shape} and type {joints.dtype}; it must be names [joint]. {MAKE_ONE}"
        )
    if joints.size > _MOST_JOINTS:
        raise RecipeError(f"{path}: `joints` has {joints.size:,} names, at most {_MOST_JOINTS:,} are read. {MAKE_ONE}")
    return tuple(str(joint) for joint in np.atleast_1d(joints))


def _numbers(path: str | Path, parents: NDArray[np.generic]) -> tuple[int, ...]:
    if parents.ndim > 1 or parents.dtype.kind not in "iu":
        raise RecipeError(
            f"{path}: `parents` has shape {parents.shape} and type {parents.dtype}; it must be whole numbers [joint]. "
            f"{MAKE_ONE}"
        )
    return tuple(int(parent) for parent in np.atleast_1d(parents))


def _parents(path: str | Path, joints: Sequence[str], given: NDArray[np.generic] | None) -> tuple[int, ...]:
    repeated = sorted({joint for joint in joints if joints.count(joint) > 1})
    if repeated:
        raise RecipeError(f"{path}: `joints` names {repeated[0]!r} twice. {MAKE_ONE}")
    parents = _known_parents(joints) if given is None else _numbers(path, given)
    if parents is None:
        strange = next(joint for joint in joints if joint not in JOINTS)
        raise RecipeError(
            f"{path} has no `parents`, and its joints are neither SMPL's nor SMAL's ({strange!r}). Add the parents: "
            f"{MAKE_ONE}"
        )
    if len(parents) != len(joints):
        raise RecipeError(f"{path}: {len(parents)} parents for {len(joints)} joints. {MAKE_ONE}")
    for joint, parent in enumerate(parents):
        if not -1 <= parent < joint:
            raise RecipeError(
                f"{path}: joint {joint} ({joints[joint]!r}) has parent {parent}; parents come before their children, "
                f"and a root's is -1. {MAKE_ONE}"
            )
    return parents


def _known_parents(joints: Sequence[str]) -> tuple[int, ...] | None:
    """Each joint's nearest ancestor among ``joints`` in SMPL's tree, or else SMAL's: joints left out do not turn."""
    for names, parents in ((JOINTS, PARENTS), (SMAL_JOINTS, SMAL_PARENTS)):
        if set(joints) <= set(names):
            nearest = (*drivers_of(names, parents, joints), -1)
            return tuple(nearest[parents[names.index(joint)]] for joint in joints)
    return None
