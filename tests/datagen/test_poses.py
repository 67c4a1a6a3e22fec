"""The NPT joint ranges, and poses as functions of (seed, number)."""

import numpy as np
import pytest

from datagen.poses import JOINTS, draw_pose, draw_poses, family_of
from datagen.recipe import PoseRecipe

DEGREES = 180 / np.pi


def drawn(arrangement: str, count: int = 400) -> dict[str, np.ndarray]:
    """Degrees [pose, 24, 3] by family."""
    recipe = PoseRecipe(seen=count // 2, unseen=count // 2, arrangement=arrangement)  # type: ignore[arg-type]
    poses = draw_poses(recipe, range(count)) * DEGREES
    families = np.array([family_of(recipe, pose) for pose in range(count)])
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
    mixed, published = PoseRecipe(seen=400, unseen=400), PoseRecipe(seen=400, unseen=400, arrangement="published")
    assert [family_of(mixed, p) for p in (0, 1, 400, 401)] == ["bent", "straight", "bent", "straight"]
    assert {family_of(published, p) for p in range(400)} == {"bent"}
    assert {family_of(published, p) for p in range(400, 800)} == {"straight"}


def test_a_pose_is_a_function_of_seed_and_number_alone() -> None:
    small, large = PoseRecipe(seen=10, unseen=5), PoseRecipe(seen=300, unseen=100)
    draw_pose.cache_clear()
    assert np.array_equal(draw_pose(small, 7), draw_pose(large, 7))
    assert not np.array_equal(draw_pose(small, 7), draw_pose(PoseRecipe(seen=10, unseen=5, seed=1), 7))
