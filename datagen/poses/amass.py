"""Poses from AMASS (Mahmood et al. 2019): frames of recorded motions, over SMPL's joints.

AMASS bodies stand with Z up and turn to all sides. The root rotation R of a frame becomes A R with A = -90 degrees
about x, which takes Z up to our Y up: a person who stands has R = +90 degrees about x times a turn about the vertical.
"""

import hashlib

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.assets import Asset
from datagen.common.errors import RecipeError
from datagen.common.seeding import Stream, generator
from datagen.poses.amass_files import JOINTS_OF_WIDTH, Motion, find_motions, read_frames
from datagen.poses.skeletons import JOINTS, PARENTS
from datagen.recipe import AmassPoses, PoseRecipe

_TO_Y_UP = Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0])
_MOTIONS = 2**32  # numbers of random generators: of rounds below this, of motions from here on


class AmassSource:
    """See :class:`datagen.poses.PoseSource`: each pose is a frame of a motion, and no two are the same one.

    Frames come in rounds: each takes one frame at any time of every motion that has some left, in random order. So
    long recordings weigh no more than short ones, poses are of as many motions as can be, and only those are read.

    - SMPL's 24 joints; SMPL-H and SMPL-X have fingers instead of SMPL's hand joints, which then do not turn.
    - ``held_out``: that share of the motions gives all unseen poses, the others all seen ones. Which ones follows from
      the seed and their names, so that a motion that is added moves no other. Without it unseen poses are frames of
      the same motions, and neighbouring frames hardly differ. Poses that are appended are unseen ones then
      (:func:`datagen.generate.append` refuses others).
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
        kept, held_out = _split(motions, wanted.held_out, recipe.seed)
        self._drawn_from = FramesInRounds(kept, recipe.seed)
        self._held_out = FramesInRounds(held_out, recipe.seed) if held_out else None
        self._require(recipe.seen + (0 if held_out else recipe.unseen), recipe.unseen if held_out else 0)

    def draw(self, pose: int) -> NDArray[np.float64]:
        """Axis-angle [24, 3] in radians."""
        if self._held_out is None or pose < self._recipe.seen:
            self._require(pose + 1, 0)
            motion, frame = self._drawn_from[pose]
        else:
            self._require(0, pose + 1 - self._recipe.seen)
            motion, frame = self._held_out[pose - self._recipe.seen]
        return smpl_pose(read_frames(motion)[frame], root=self._root)

    def _require(self, wanted: int, held_out: int) -> None:
        """Refuse to take more frames than there are, from the motions for all (or for seen) poses and held-out ones."""
        for count, frames, whose in (
            (wanted, self._drawn_from, "for seen poses" if self._held_out else "there"),
            (held_out, self._held_out, "held out for unseen poses"),
        ):
            if frames is not None and count > len(frames):
                raise RecipeError(
                    f"{count} poses are to be drawn without repetition from the {len(frames.motions)} motion files "
                    f"{whose}, which have {len(frames)} frames. Add motions, or ask for fewer poses: "
                    "--set data.poses.seen=... or --set data.poses.unseen=..."
                )


class FramesInRounds:
    """All frames of some motions as one sequence: round by round, in each one frame of every motion that has more.

    Which motions come first in a round, and the order of each one's frames, follow from the seed.
    """

    def __init__(self, motions: list[Motion], seed: int) -> None:
        self.motions, self._seed = motions, seed
        self._counts = np.array([motion.frames for motion in motions], np.int64)
        by_count = np.bincount(self._counts)
        in_round = len(motions) - np.cumsum(by_count)[:-1]  # how many motions have more frames than the round's number
        self._ends = np.cumsum(in_round)

    def __len__(self) -> int:
        return int(self._counts.sum())

    def __getitem__(self, place: int) -> tuple[Motion, int]:
        turn = int(np.searchsorted(self._ends, place, side="right"))
        within = place - (int(self._ends[turn - 1]) if turn else 0)
        left = np.flatnonzero(self._counts > turn)
        motion = int(generator(self._seed, Stream.POSE, turn).permutation(left)[within])
        order = generator(self._seed, Stream.POSE, _MOTIONS + motion).permutation(self._counts[motion])
        return self.motions[motion], int(order[turn])


def smpl_pose(frame: NDArray[np.floating], *, root: str = "upright") -> NDArray[np.float64]:
    """One AMASS frame [66, 72, 156 or 165] as axis-angle [24, 3] in radians over SMPL's joints, Y up.

    ``root`` is that of :class:`datagen.recipe.AmassPoses`.
    """
    count = JOINTS_OF_WIDTH[len(frame)]
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
