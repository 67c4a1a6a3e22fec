"""Pose distributions over named joints.

A pose is one axis-angle vector (radians) for each of the 24 SMPL joints, in SMPL's convention: body at rest in
a T-pose, Y up, facing +Z, +X to the body's left; each joint's rotation is relative to its parent, in axes
aligned with the rest pose. Bodies translate this to their own rig (see :mod:`datagen.bodies`).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from datagen.random import Stream, generator
from datagen.recipe import PoseRecipe, Range

JOINTS: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
"""SMPL's 24 joints in SMPL's order."""


@dataclass(frozen=True)
class Draw:
    """Uniform ranges, in degrees, of one draw that is given to every joint in ``joints``.

    ``equal`` draws one number for all three components; otherwise x, y and z are drawn independently.
    """

    joints: tuple[str, ...]
    x: Range = (0.0, 0.0)
    y: Range = (0.0, 0.0)
    z: Range = (0.0, 0.0)
    equal: Range | None = None

    def sample(self, random: np.random.Generator) -> NDArray[np.float64]:
        """One axis-angle vector [3] in degrees."""
        if self.equal is not None:
            return np.full(3, random.uniform(*self.equal))
        return np.array([random.uniform(*axis) for axis in (self.x, self.y, self.z)])


def _family(*, hip_spread: float, knee: float, wrist: float, left_ankle_x: Range) -> tuple[Draw, ...]:
    wrists = {axis: (-wrist, wrist) for axis in "xyz"}
    return (
        Draw(("left_collar", "left_shoulder"), y=(-30, 30), z=(-30, 30)),
        Draw(("left_elbow",), y=(-60, 0)),
        Draw(("left_wrist",), **wrists),
        Draw(("left_hand",), x=(-5, 5), y=(0, 10), z=(-10, 0)),
        Draw(("right_collar", "right_shoulder"), y=(-30, 30), z=(-30, 30)),
        Draw(("right_elbow",), y=(0, 60)),
        Draw(("right_wrist",), **wrists),
        Draw(("right_hand",), x=(-5, 5), y=(-10, 0), z=(0, 10)),
        Draw(("left_hip",), x=(-90, 0), z=(0, hip_spread)),
        Draw(("left_knee",), x=(0, knee)),
        Draw(("left_ankle",), x=left_ankle_x, y=(-10, 10), z=(-1, 1)),
        Draw(("right_hip",), x=(-90, 0), z=(-hip_spread, 0)),
        Draw(("right_knee",), x=(0, knee)),
        Draw(("right_ankle",), x=(-10, 10), y=(-10, 10), z=(-1, 1)),
        Draw(("neck", "head"), equal=(-1, 1)),
        Draw(("spine1", "spine2", "spine3"), equal=(-1, 1)),
        Draw(("pelvis",), x=(-2, 2), y=(-2, 2), z=(-2, 2)),
    )


NPT_FAMILIES: dict[str, tuple[Draw, ...]] = {
    "bent": _family(hip_spread=40, knee=100, wrist=20, left_ankle_x=(-10, 10)),
    "straight": _family(hip_spread=5, knee=10, wrist=10, left_ankle_x=(-10, 20)),
}
"""The two pose families of Neural Pose Transfer's published generator (data_generation.py), in degrees."""


def family_of(recipe: PoseRecipe, pose: int) -> str:
    """Which NPT family pose number ``pose`` is drawn from, under the recipe's arrangement."""
    if recipe.arrangement == "published":
        return "bent" if pose < (recipe.seen + recipe.unseen) / 2 else "straight"
    return ("bent", "straight")[pose % 2]


@lru_cache(maxsize=100_000)
def draw_pose(recipe: PoseRecipe, pose: int) -> NDArray[np.float64]:
    """Pose number ``pose`` of the recipe: axis-angle [24, 3] in radians, a function of (seed, pose) alone."""
    random = generator(recipe.seed, Stream.POSE, pose)
    degrees = np.zeros((len(JOINTS), 3))
    for draw in NPT_FAMILIES[family_of(recipe, pose)]:
        degrees[[JOINTS.index(joint) for joint in draw.joints]] = draw.sample(random)
    return np.radians(degrees)


def draw_poses(recipe: PoseRecipe, poses: NDArray[np.integer] | range) -> NDArray[np.float64]:
    """Axis-angle [pose, 24, 3] in radians for the given pose numbers."""
    return np.stack([draw_pose(recipe, int(pose)) for pose in poses])
