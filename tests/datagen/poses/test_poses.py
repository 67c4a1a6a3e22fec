"""The NPT joint ranges, and poses as functions of (seed, number)."""

from typing import Any

import numpy as np
import pytest

from datagen.common.errors import RecipeError
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses, load_poses
from datagen.poses.joint_ranges import NptSource
from datagen.poses.skeletons import SMAL_JOINTS
from datagen.recipe import NptPoses, PoseRecipe, RangePoses

DEGREES = 180 / np.pi


def drawn(arrangement: str, count: int = 400) -> dict[str, np.ndarray]:
    """Degrees [pose, 24, 3] by family."""
    distribution = NptPoses(arrangement=arrangement)  # type: ignore[arg-type]
    recipe = PoseRecipe(seen=count // 2, unseen=count // 2, distribution=distribution)
    poses = draw_poses(recipe, range(count)).rotations * DEGREES
    families = np.array([NptSource(recipe).family_of(pose) for pose in range(count)])
    return {name: poses[families == name] for name in ("bent", "straight")}


# joint, axis, low, high: the published generator (data_generation.py of Neural Pose Transfer), typed in anew
BENT = [
    ("left_hip", 0, -90, 0), ("left_hip", 2, 0, 40), ("right_hip", 2, -40, 0), ("left_knee", 0, 0, 100),
    ("right_knee", 0, 0, 100), ("left_elbow", 1, -60, 0), ("right_elbow", 1, 0, 60), ("left_wrist", 0, -20, 20),
    ("left_ankle", 0, -10, 10), ("right_ankle", 2, -1, 1), ("left_collar", 1, -30, 30), ("right_shoulder", 2, -30, 30),
    ("left_hand", 1, 0, 10), ("right_hand", 1, -10, 0), ("neck", 0, -1, 1), ("pelvis", 1, -2, 2),
]  # fmt: skip
STRAIGHT = [
    ("left_hip", 0, -90, 0), ("left_hip", 2, 0, 5), ("right_hip", 2, -5, 0), ("left_knee", 0, 0, 10),
    ("left_wrist", 1, -10, 10), ("left_ankle", 0, -10, 20), ("right_ankle", 0, -10, 10),
]  # fmt: skip


@pytest.mark.parametrize("family, ranges", [("bent", BENT), ("straight", STRAIGHT)])
def test_every_joint_fills_its_published_range_and_stays_inside(family: str, ranges: list[tuple]) -> None:
    poses = drawn("mixed")[family]
    for joint, axis, low, high in ranges:
        values = poses[:, JOINTS.index(joint), axis]
        assert values.min() >= low and values.max() <= high, (joint, axis)
        assert values.max() - values.min() > 0.9 * (high - low), (joint, axis)


def test_unlisted_components_are_zero() -> None:
    poses = drawn("mixed")["bent"]
    for joint, axis in (("left_elbow", 0), ("left_knee", 1), ("left_collar", 0), ("left_foot", 0), ("left_hip", 1)):
        assert not poses[:, JOINTS.index(joint), axis].any()


def test_collar_and_shoulder_share_one_draw_and_the_spine_bends_equally() -> None:
    poses = drawn("mixed")["straight"]
    assert np.array_equal(poses[:, JOINTS.index("left_collar")], poses[:, JOINTS.index("left_shoulder")])
    assert not np.array_equal(poses[:, JOINTS.index("left_collar")], poses[:, JOINTS.index("right_collar")])
    spine = poses[:, [JOINTS.index(name) for name in ("spine1", "spine2", "spine3")]]
    assert np.ptp(spine.reshape(len(spine), -1), axis=1).max() == 0


def test_arrangements() -> None:
    mixed = NptSource(PoseRecipe(seen=400, unseen=400))
    published = NptSource(PoseRecipe(seen=400, unseen=400, distribution=NptPoses(arrangement="published")))
    assert [mixed.family_of(p) for p in (0, 1, 400, 401)] == ["bent", "straight", "bent", "straight"]
    assert {published.family_of(p) for p in range(400)} == {"bent"}
    assert {published.family_of(p) for p in range(400, 800)} == {"straight"}
    assert {published.family_of(p) for p in range(800, 802)} == {"bent", "straight"}, "appended poses are mixed"


def test_a_pose_is_a_function_of_seed_and_number_alone() -> None:
    small, large = load_poses(PoseRecipe(seen=10, unseen=5)), load_poses(PoseRecipe(seen=300, unseen=100))
    assert np.array_equal(small.draw(7), large.draw(7))
    assert not np.array_equal(small.draw(7), load_poses(PoseRecipe(seen=10, unseen=5, seed=1)).draw(7))


def test_slices_share_the_world_rotations_that_are_known() -> None:
    poses = draw_poses(PoseRecipe(seen=10, unseen=5), range(8))
    before = poses[3:5].world()
    assert np.array_equal(before, poses.world()[3:5]) and not np.shares_memory(before, poses.world())
    assert np.shares_memory(poses[3:5].world(), poses.world()) and np.array_equal(poses[3:5].world(), before)


def test_ranges_of_ones_own() -> None:
    knee = RangePoses(degrees={"left_knee": ((0, 90), (0, 0), (0, 0))})
    poses = draw_poses(PoseRecipe(distribution=knee), range(200)).rotations * DEGREES
    bent = poses[:, JOINTS.index("left_knee"), 0]
    assert 0 <= bent.min() < 9 and 81 < bent.max() <= 90
    assert np.count_nonzero(poses.any(axis=(0, 2))) == 1


def test_uniform_ranges_over_smal() -> None:
    poses = draw_poses(PoseRecipe(distribution=RangePoses(uniform=10, skeleton="smal")), range(100))
    assert poses.joints == SMAL_JOINTS and 9.5 < np.abs(poses.rotations * DEGREES).max() <= 10


def test_a_range_of_an_unknown_joint_is_refused() -> None:
    with pytest.raises(RecipeError, match="no joint 'wing'"):
        load_poses(PoseRecipe(distribution=RangePoses(degrees={"wing": ((0, 1), (0, 1), (0, 1))})))


@pytest.mark.parametrize(
    ("distribution", "says"),
    [
        ({}, "makes all poses the same. Set uniform=DEGREES .* or degrees="),
        ({"degrees": {"head": ((5, 5), (0, 0), (0, 0))}}, "makes all poses the same"),
        ({"uniform": 361}, "turns 'pelvis' by up to 361 degrees"),
        ({"degrees": {"head": ((0, 0), (-400, 0), (0, 0))}}, "turns 'head' by up to 400 degrees"),
    ],
)
def test_ranges_that_cannot_be_meant(distribution: dict[str, Any], says: str) -> None:
    """Where poses are drawn: a dataset that was made of such ranges can still be read."""
    with pytest.raises(RecipeError, match=says):
        load_poses(PoseRecipe.model_validate({"distribution": {"name": "ranges", **distribution}}))
    load_poses(PoseRecipe.model_validate({"distribution": {"name": "ranges"}, "seen": 1, "unseen": 0}))


def turned(joint: str, axis: int, degrees: float) -> Poses:
    rotations = np.zeros((1, len(JOINTS), 3))
    rotations[0, JOINTS.index(joint), axis] = np.radians(degrees)
    return Poses(JOINTS, PARENTS, rotations)


def test_world_rotations_follow_the_tree() -> None:
    world = turned("left_hip", 0, 90).world()[0]
    quarter = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    for joint, name in enumerate(JOINTS):
        below = name in ("left_hip", "left_knee", "left_ankle", "left_foot")
        assert np.allclose(world[joint], quarter if below else np.eye(3), atol=1e-6), name


def test_another_tree_takes_joints_by_name_and_lets_the_rest_follow() -> None:
    """A rig with a twist joint between hip and knee, and a tail that nobody poses."""
    names, parents = ["pelvis", "left_hip", None, "left_knee", "tail"], [-1, 0, 1, 2, 0]
    poses = turned("left_hip", 0, 40)
    carried, own = poses.on(names, parents)[0], poses.world()[0]
    hip, knee = JOINTS.index("left_hip"), JOINTS.index("left_knee")
    expected = [own[0], own[hip], own[hip], own[knee], own[0]]
    assert np.array_equal(carried, np.stack(expected))
