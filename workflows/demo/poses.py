"""Poses of made-up bodies: at rest, random ones, those of a person's own file, and joints turned by hand.

Random poses come from the distributions of the recipes ``human`` and, without its jitter, ``animals``, with a seed of
the page's own.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.errors import MeshError, RecipeError, reason_of
from datagen.common.npz import FAULTS, member_header, opened, read_arrays
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.poses.amass import smpl_pose
from datagen.poses.amass_files import find_motions, read_frames
from datagen.poses.pose_files import read_pose_file
from datagen.recipe import AnatomicalPoses, ClipPoses, PoseRecipe
from training.viz.style import short

PERSON, ANIMAL = "person", "animal"
LAST_POSE = 200
_LIMBS = ("shoulder", "elbow", "hip", "knee")
TURNED = {
    "pelvis": "pelvis", "spine": "spine2", "head": "head",
    **{f"{side} {part}": f"{side}_{part}" for part in _LIMBS for side in ("left", "right")},
}  # fmt: skip
"""Joints that can be turned by hand, by what the page calls them."""
Turns = tuple[tuple[str, tuple[float, float, float]], ...]
NUMBER_LIMIT = 20_000_000
"""Of poses in one file; 18 minutes of SMPL-H at 120 frames a second."""
_OF_POSES = {"poses.npy", "root_orient.npy", "pose_body.npy"}
_ABOUT_POSES = {"joints.npy", "parents.npy", "mocap_framerate.npy", "mocap_frame_rate.npy"}
_ABOUT_LIMIT = 100_000  # bytes
_SEED = 20_000  # no recipe of the project draws from it
_WALK, _STEPS = 3, 12  # random poses of a walk, and frames from one to the next
_FRAMES, _FRAMES_PER_SECOND = 60, 15  # of a file that is played
_DISTRIBUTIONS = {PERSON: AnatomicalPoses(), ANIMAL: ClipPoses(path="animals", jitter=0)}


@dataclass(frozen=True, eq=False)
class PoseFile:
    """Poses of somebody's file: how many, and ``draw`` gives one [joint, 3]; each ``apart``-th is a frame."""

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    count: int
    draw: Callable[[int], NDArray[np.float64]]
    apart: int = 1


@dataclass(frozen=True)
class Pose:
    """How a made-up body stands.

    Of random poses ``number`` 0 is at rest, 1 to LAST_POSE are random, and what lies between two whole numbers lies on
    the way from the one to the other; of a ``file`` it is the place of one of its poses. ``turns`` are joints of SMPL
    and degrees about X, Y and Z, one after the other, by which each is turned further, as its parent sees it.
    """

    number: float = 0.0
    file: PoseFile | None = None
    turns: Turns = ()

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{f'{self.file.name}-' if self.file else 'pose-'}{self.number:g}"

    def on_the_way(self) -> "list[Pose]":
        """The frames that are played: through the next random poses, or through the file from here on."""
        if self.file:
            numbers = range(int(self.number), self.file.count, self.file.apart)[:_FRAMES]
            return [replace(self, number=float(number)) for number in numbers]
        return [replace(self, number=round(self.number + step / _STEPS, 4)) for step in range(_WALK * _STEPS + 1)]


def poses_of(kind: str, pose: Pose) -> Poses:
    """The one pose, over joints of people or of animals."""
    if (file := pose.file) is not None:
        drawn = Poses(file.joints, file.parents, file.draw(int(pose.number))[None])
    else:
        drawn = _random(kind, pose.number)
    rotations = drawn.rotations.copy()
    for joint, degrees in pose.turns:
        if joint in drawn.joints:
            place = drawn.joints.index(joint)
            turned = Rotation.from_euler("xyz", degrees, degrees=True) * Rotation.from_rotvec(rotations[0, place])
            rotations[0, place] = turned.as_rotvec()
    return Poses(drawn.joints, drawn.parents, rotations)


def read_poses(path: Path) -> PoseFile:
    """Read a .npz of AMASS, or of ``poses`` [pose, joint, 3] and ``joints``, as the recipes' ``amass`` and ``file`` do.

    Raises
    ------
    MeshError
        It holds no poses, or none of a person.
    """
    try:
        names = _arrays_within_limits(path)
        if "joints.npy" in names:
            return _named(path)
        if names & {"poses.npy", "pose_body.npy"}:
            return _recorded(path)
    except RecipeError as error:
        raise MeshError(short(str(error), 400)) from error
    except FAULTS as error:
        raise MeshError(f"{path} cannot be read as .npz ({reason_of(error)})") from error
    raise MeshError(f"{path} holds no poses: neither AMASS's, nor `poses` with `joints` (docs/demo.md)")


def _arrays_within_limits(path: Path) -> set[str]:
    """Names of the arrays; MeshError where those of poses have more numbers than the page keeps."""
    with opened(path) as archive:
        names = set(archive.namelist())
        numbers = sum(math.prod(member_header(archive, name)[0]) for name in sorted(names & _OF_POSES))
        about = sum(archive.getinfo(name).file_size for name in names & _ABOUT_POSES)
    if about > _ABOUT_LIMIT:
        raise MeshError(f"{path} has {about:,} bytes of names of joints, more than {_ABOUT_LIMIT:,}")
    if numbers > NUMBER_LIMIT:
        raise MeshError(
            f"{path} holds {numbers:,} numbers of poses, the page takes {NUMBER_LIMIT:,}: cut it into pieces"
        )
    return names


def _named(path: Path) -> PoseFile:
    poses = read_pose_file(path)
    if set(poses.joints).isdisjoint(JOINTS):
        raise MeshError(
            f"{path}: none of its joints is a person's ({short(poses.joints[0])!r}); they are called {JOINTS[0]!r}, ..."
        )
    if not len(poses):
        raise MeshError(f"{path} holds no poses: `poses` is empty")
    return PoseFile(path.stem, poses.joints, poses.parents, len(poses), poses.rotations.__getitem__)


def _recorded(path: Path) -> PoseFile:
    """A motion of AMASS, thinned to the page's frames a second when it is played."""
    frames = read_frames(find_motions(str(path))[0])
    read_frames.cache_clear()  # it is kept as long as its page
    rate = next(iter(read_arrays(path, ("mocap_framerate", "mocap_frame_rate")).values()), np.array(0.0))
    apart = round(float(rate) / _FRAMES_PER_SECOND) if rate.size == 1 and 0 < float(rate) < 1e4 else 1
    return PoseFile(path.stem, JOINTS, PARENTS, len(frames), lambda number: smpl_pose(frames[number]), max(apart, 1))


def _random(kind: str, number: float) -> Poses:
    """At rest, a random pose, or on the way, on which every joint starts and ends gently."""
    whole = int(number)
    drawn = draw_poses(PoseRecipe(distribution=_DISTRIBUTIONS[kind], seed=_SEED), range(whole, whole + 2))
    if whole == 0:
        drawn.rotations[0] = 0
    share = number - whole
    begin, end = (Rotation.from_rotvec(rotations) for rotations in drawn.rotations)
    moment = begin * (begin.inv() * end) ** (share * share * (3 - 2 * share))
    return Poses(drawn.joints, drawn.parents, moment.as_rotvec()[None])
