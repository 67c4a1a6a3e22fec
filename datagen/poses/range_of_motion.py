"""Poses over people's whole range of motion: bent trunks, turned heads, raised and folded arms, deep squats."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.assets import Asset
from datagen.common.seeding import Stream, generator
from datagen.poses.joint_ranges import npt_pose
from datagen.poses.skeletons import JOINTS, PARENTS
from datagen.recipe import AnatomicalPoses, PoseRecipe, Range

_MIRROR = {"left": np.ones(3), "right": np.array([1.0, -1.0, -1.0])}
"""What a rotation's components of the left side are multiplied by for a side."""


@dataclass(frozen=True)
class Motion:
    """How far a joint, or a chain of joints that share it equally, turns; degrees about SMPL's axes of the left side.

    A rotation is a swing, which moves the bone, after a twist about the bone itself (``bone``: which of x, y and z it
    lies along at rest). The swing's two components lie within an ellipse whose axes are the two ranges; that of a
    hinge, which has one, is seldom near its ends.
    """

    joints: tuple[str, ...]
    bone: int
    x: Range = (0.0, 0.0)
    y: Range = (0.0, 0.0)
    z: Range = (0.0, 0.0)

    def draw(self, random: np.random.Generator, share: float) -> NDArray[np.float64]:
        """Axis-angle [3] in radians of each of the joints: this share of a rotation by chance within the range."""
        low, high = np.transpose([self.x, self.y, self.z])
        unit = random.uniform(-1, 1, 3)
        swing = np.arange(3) != self.bone
        square = unit[swing]
        unit[swing] *= np.abs(square).max() / np.linalg.norm(square)  # drawn in towards the disc
        degrees = share / len(self.joints) * (low + high + unit * (high - low)) / 2
        swung, twisted = (Rotation.from_rotvec(degrees * part, degrees=True) for part in (swing, ~swing))
        return (swung * twisted).as_rotvec()


# Healthy grown-ups' ranges of motion, rounded, as in tables of the American Academy of Orthopaedic Surgeons (AAOS).
X, Y, Z = range(3)
TRUNK = (
    Motion(("spine1", "spine2", "spine3"), Y, x=(-25, 75), y=(-45, 45), z=(-35, 35)),
    Motion(("neck", "head"), Y, x=(-50, 45), y=(-70, 70), z=(-35, 35)),
)
ARM = (
    Motion(("left_collar",), X, y=(-15, 10), z=(-8, 25)),
    Motion(("left_shoulder",), X, x=(-60, 60), y=(-110, 35), z=(-95, 80)),
    Motion(("left_elbow",), X, x=(-30, 30), y=(-145, 0)),
    Motion(("left_wrist",), X, x=(-45, 45), y=(-25, 25), z=(-65, 55)),
    Motion(("left_hand",), X, y=(-10, 10), z=(-80, 10)),
)
FOLDED_ARM = (  # as one crosses the arms, covers the face or rests the chin on a hand
    ARM[0],
    Motion(("left_shoulder",), X, x=(-60, 60), y=(-110, -10), z=(-95, 45)),
    Motion(("left_elbow",), X, x=(-30, 30), y=(-150, -95)),
    *ARM[3:],
)
LEG = (
    Motion(("left_hip",), Y, x=(-125, 30), y=(-40, 40), z=(-20, 45)),
    Motion(("left_knee",), Y, x=(0, 145), y=(-10, 10)),
    Motion(("left_ankle",), Y, x=(-25, 50), y=(-15, 15), z=(-15, 15)),
    Motion(("left_foot",), Z, x=(-35, 15)),
)
FOLDED_LEG = (  # as one squats, sits on the heels or hugs the knees: weight or arms bend the joints further
    Motion(("left_hip",), Y, x=(-135, -75), y=(-30, 40), z=(-15, 45)),
    Motion(("left_knee",), Y, x=(95, 155), y=(-10, 10)),
    *LEG[2:],
)

_SIDES = ("left", "right")
_LIMBS = (  # what most are drawn from; the power of a uniform number that their share is; what others are; sides
    (TRUNK, 1.0, TRUNK, ("left",)),
    (ARM, 0.0, FOLDED_ARM, _SIDES),
    (LEG, 0.5, FOLDED_LEG, _SIDES),
)
_OTHERS = 1 / 4  # of each kind: drawn from the whole of their range, arms and legs folded tightly
_ALIKE = 1 / 3  # of poses: both arms do the same, and likewise both legs


class AnatomicalSource:
    """See :class:`datagen.poses.PoseSource`: each limb by a share of its range, over SMPL's joints.

    Of a quarter of the trunks, with neck and head, the share is the whole; of the others a uniform number in [0, 1]. A
    quarter of the arms and a quarter of the legs, each by itself, are folded tightly: drawn from the whole of narrower
    ranges. Of the others the share is the whole for an arm, as arms hang, reach and fold, and the root of a uniform
    number for a leg. In a third of the poses both arms do the same, and independently in a third both legs.

    There are poses that nobody takes, and limbs may go through the body. The recipe's ``npt`` is the share of poses, by
    chance, that are of NPT's generator instead.
    """

    joints, parents = JOINTS, PARENTS
    assets: tuple[Asset, ...] = ()

    def __init__(self, recipe: PoseRecipe) -> None:
        assert isinstance(recipe.distribution, AnatomicalPoses)
        self._seed, self._npt = recipe.seed, recipe.distribution.npt

    def draw(self, pose: int) -> NDArray[np.float64]:
        """Axis-angle [24, 3] in radians."""
        random = generator(self._seed, Stream.POSE, pose)
        if random.uniform() < self._npt:
            return npt_pose(("bent", "straight")[pose % 2], random)
        rotations = np.zeros((len(JOINTS), 3))
        for limb, power, other, sides in _LIMBS:
            alike, turned = random.uniform() < _ALIKE, list[NDArray[np.float64]]()
            for side in sides:
                if not turned or not alike:
                    motions, share = (other, 1.0) if random.uniform() < _OTHERS else (limb, random.uniform() ** power)
                    turned = [motion.draw(random, share) for motion in motions]
                for motion, turn in zip(limb, turned, strict=True):
                    for joint in motion.joints:
                        rotations[JOINTS.index(joint.replace("left", side))] = turn * _MIRROR[side]
        return rotations
