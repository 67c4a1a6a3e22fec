"""Poses drawn from uniform ranges of joints: Neural Pose Transfer's published generator, and a person's own ranges."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.common.assets import Asset
from datagen.common.errors import RecipeError
from datagen.common.seeding import Stream, generator
from datagen.poses.skeletons import JOINTS, PARENTS, SMAL_JOINTS, SMAL_PARENTS
from datagen.recipe import NptPoses, PoseRecipe, Range, RangePoses


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


_TURN = 360
NPT_FAMILIES: dict[str, tuple[Draw, ...]] = {
    "bent": _family(hip_spread=40, knee=100, wrist=20, left_ankle_x=(-10, 10)),
    "straight": _family(hip_spread=5, knee=10, wrist=10, left_ankle_x=(-10, 20)),
}
"""The two pose families of Neural Pose Transfer's published generator (data_generation.py), in degrees."""


class NptSource:
    """See :class:`datagen.poses.PoseSource`: both families of NPT's generator, over SMPL's joints."""

    joints, parents = JOINTS, PARENTS
    assets: tuple[Asset, ...] = ()

    def __init__(self, recipe: PoseRecipe) -> None:
        assert isinstance(recipe.distribution, NptPoses)
        self._seed, self._total = recipe.seed, recipe.seen + recipe.unseen
        self._published = recipe.distribution.arrangement == "published"

    def family_of(self, pose: int) -> str:
        """Which NPT family pose number ``pose`` is drawn from, under the recipe's arrangement."""
        if self._published and pose < self._total:
            return "bent" if pose < self._total / 2 else "straight"
        return ("bent", "straight")[pose % 2]

    def draw(self, pose: int) -> NDArray[np.float64]:
        """Axis-angle [24, 3] in radians."""
        return npt_pose(self.family_of(pose), generator(self._seed, Stream.POSE, pose))


def npt_pose(family: str, random: np.random.Generator) -> NDArray[np.float64]:
    """Axis-angle [24, 3] in radians, by chance, of one of :data:`NPT_FAMILIES`."""
    return _draw(NPT_FAMILIES[family], JOINTS, random)


class RangeSource:
    """See :class:`datagen.poses.PoseSource`: every named joint uniform within ranges of one's own."""

    assets: tuple[Asset, ...] = ()

    def __init__(self, recipe: PoseRecipe) -> None:
        wanted = recipe.distribution
        assert isinstance(wanted, RangePoses)
        self.joints, self.parents = skeleton(wanted.skeleton)
        unknown = sorted(wanted.degrees.keys() - set(self.joints))
        if unknown:
            raise RecipeError(
                f"data.poses.distribution.degrees: no joint {unknown[0]!r} in the skeleton {wanted.skeleton!r}; "
                f"it has {', '.join(self.joints)}"
            )
        self._seed = recipe.seed
        every = (-wanted.uniform, wanted.uniform)
        ranges = {joint: wanted.degrees.get(joint, (every, every, every)) for joint in self.joints}
        for joint, axes in ranges.items():
            if (largest := np.abs(axes).max()) > _TURN:
                raise RecipeError(
                    f"data.poses.distribution turns {joint!r} by up to {largest:g} degrees, more than a whole turn "
                    f"({_TURN}). Set degrees or uniform to less"
                )
        if recipe.seen + recipe.unseen > 1 and not any(low < high for axes in ranges.values() for low, high in axes):
            raise RecipeError(
                "data.poses.distribution: `ranges` without a range makes all poses the same. Set uniform=DEGREES for "
                "all joints of its skeleton, or degrees={JOINT: [[low, high], [low, high], [low, high]]} for some"
            )
        self._draws = tuple(Draw((joint,), *axes) for joint, axes in ranges.items())

    def draw(self, pose: int) -> NDArray[np.float64]:
        """Axis-angle [joint, 3] in radians."""
        return _draw(self._draws, self.joints, generator(self._seed, Stream.POSE, pose))


def skeleton(name: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Joint names and parents of a skeleton by name: smpl, smal, or animals (the CC0 glTF animals' shared joints)."""
    if name == "animals":
        from datagen.poses.animation_clips import shared_skeleton

        return shared_skeleton("animals")
    return (JOINTS, PARENTS) if name == "smpl" else (SMAL_JOINTS, SMAL_PARENTS)


def _draw(draws: tuple[Draw, ...], joints: tuple[str, ...], random: np.random.Generator) -> NDArray[np.float64]:
    degrees = np.zeros((len(joints), 3))
    for draw in draws:
        degrees[[joints.index(joint) for joint in draw.joints]] = draw.sample(random)
    return np.radians(degrees)
