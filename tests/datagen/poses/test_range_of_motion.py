"""Poses over people's whole range of motion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.poses import JOINTS, draw_poses, load_poses, range_of_motion
from datagen.poses.range_of_motion import ARM, FOLDED_ARM, FOLDED_LEG, LEG, TRUNK, Motion
from datagen.recipe import AnatomicalPoses, PoseRecipe

RECIPE = PoseRecipe(seen=600, unseen=200, distribution=AnatomicalPoses())


@pytest.fixture(scope="module")
def degrees() -> np.ndarray:
    """Axis-angle components [pose, 24, 3] in degrees."""
    return np.degrees(draw_poses(RECIPE, range(800)).rotations)


def test_every_joint_but_the_pelvis_moves_and_each_has_one_motion(degrees: np.ndarray) -> None:
    still = [name for joint, name in enumerate(JOINTS) if not degrees[:, joint].any()]
    assert still == ["pelvis"]
    for folded, limb in ((FOLDED_ARM, ARM), (FOLDED_LEG, LEG)):
        assert [motion.joints for motion in folded] == [motion.joints for motion in limb]
    named = [joint for motion in (*TRUNK, *ARM, *LEG) for joint in motion.joints]
    assert sorted(named) == sorted(joint for joint in JOINTS if not joint.startswith(("right", "pelvis")))


def test_hinges_fill_their_range_and_stay_inside(degrees: np.ndarray) -> None:
    knee = degrees[:, JOINTS.index("left_knee"), 0]
    assert knee.min() >= -1 and 145 < knee.max() < 157, "a swing of up to 155 degrees with a twist of up to 10"
    stretched = knee[degrees[:, JOINTS.index("left_hip"), 0] > -60]
    assert 125 < stretched.max() < 147, "of legs that are not folded one of up to 145"
    elbow = degrees[:, JOINTS.index("left_elbow"), 1]
    assert -155 < elbow.min() < -140 and elbow.max() <= 1
    raised = elbow[degrees[:, JOINTS.index("left_shoulder"), 1] > 17]
    assert -147 < raised.min() < -120, "of arms that are not folded one of up to 145"


def test_the_right_side_mirrors_the_left_ones_ranges(degrees: np.ndarray) -> None:
    assert degrees[:, JOINTS.index("right_elbow"), 1].max() > 125, "it bends the other way about y"
    assert degrees[:, JOINTS.index("right_knee"), 0].max() > 125, "and the same way about x"
    left, right = (degrees[:, JOINTS.index(f"{side}_shoulder")] for side in ("left", "right"))
    assert not np.allclose(left * [1, -1, -1], right), "each by a draw of its own"
    assert np.allclose(np.quantile(left, 0.9, axis=0), np.quantile(right * [1, -1, -1], 0.9, axis=0), atol=9)


def test_limbs_move_by_their_shares_and_a_quarter_are_folded_each_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = list[tuple[Motion, float]]()

    def record(motion: Motion, _: np.random.Generator, share: float) -> np.ndarray:
        drawn.append((motion, share))
        return np.zeros(3)

    monkeypatch.setattr(Motion, "draw", record)
    source, poses = range_of_motion.AnatomicalSource(RECIPE), list[dict[Motion, list[float]]]()
    for pose in range(2_000):
        drawn.clear()
        source.draw(pose)
        poses.append({motion: [share for other, share in drawn if other is motion] for motion, _ in drawn})

    def shares(motion: Motion) -> np.ndarray:
        return np.array([share for pose in poses for share in pose.get(motion, [])])

    spine, neck = (shares(motion) for motion in TRUNK)
    assert np.array_equal(spine, neck) and abs((spine == 1).mean() - 1 / 4) < 0.03
    assert np.allclose(np.quantile(spine[spine < 1], [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.04)
    assert np.allclose(np.quantile(shares(LEG[0]), [0.25, 0.5, 0.75]), np.sqrt([0.25, 0.5, 0.75]), atol=0.03)
    assert all(np.all(shares(motion) == 1) for motion in (ARM[1], FOLDED_ARM[1], FOLDED_LEG[0]))
    for limb, folded in ((ARM[1], FOLDED_ARM[1]), (LEG[0], FOLDED_LEG[0])):
        folds, stretched = (np.array([len(pose.get(motion, [])) for pose in poses]) for motion in (folded, limb))
        assert abs(folds.sum() / (folds + stretched).sum() - 1 / 4) < 0.03
        apart = folds + stretched == 2  # a third does the same on both sides, by one draw
        assert abs(apart.mean() - 2 / 3) < 0.04 and abs((folds[apart] == 1).mean() - 2 * 3 / 16) < 0.04
    whole, arm, leg = (
        np.array([test(pose) for pose in poses])
        for test in (
            lambda pose: pose[TRUNK[0]] == [1],
            lambda pose: FOLDED_ARM[1] in pose,
            lambda pose: FOLDED_LEG[0] in pose,
        )
    )
    for one, other in ((whole, arm), (whole, leg), (arm, leg)):
        assert abs((one & other).mean() - one.mean() * other.mean()) < 0.025, "independent of each other"


def test_folded_limbs_lie_before_the_body(degrees: np.ndarray) -> None:
    random = np.random.default_rng(0)
    arms, legs = (
        np.degrees([[motion.draw(random, 1.0) for motion in limb[:2]] for _ in range(1_000)])
        for limb in (FOLDED_ARM[1:], FOLDED_LEG)
    )
    assert arms[:, 0, 1].max() < 17 < degrees[:, JOINTS.index("left_shoulder"), 1].max() - 3, "others go behind it"
    assert arms[:, 1, 1].max() < -90 and legs[:, 0, 0].max() < -60 and legs[:, 1, 0].min() > 90


def test_joints_of_a_chain_share_its_motion_equally(degrees: np.ndarray) -> None:
    spine = degrees[:, [JOINTS.index(name) for name in ("spine1", "spine2", "spine3")]]
    assert np.ptp(spine, axis=1).max() == 0 and 20 < spine[..., 0].max() <= 25


def test_a_swing_stays_in_its_ellipse_and_a_twist_in_its_range() -> None:
    shoulder, random = ARM[1], np.random.default_rng(0)
    drawn = Rotation.from_rotvec([shoulder.draw(random, 1.0) for _ in range(2_000)])
    bone = np.array([1.0, 0, 0])
    moved = drawn.apply(bone)
    swing = np.degrees(np.cross(bone, moved) * (np.arccos(moved[:, 0]) / np.linalg.norm(moved[:, 1:], axis=1))[:, None])
    centre, half = np.array([-37.5, -7.5]), np.array([72.5, 87.5])
    radii = np.linalg.norm((swing[:, 1:] - centre) / half, axis=1)
    assert 0.97 < radii.max() <= 1 + 1e-6
    assert abs(np.mean(radii < 0.5) - 0.25) < 0.04, "even by area"


def test_a_share_of_a_motion_is_that_part_of_its_angles() -> None:
    bend = Motion(("left_knee",), 1, x=(0, 100))
    whole, half = (bend.draw(np.random.default_rng(3), share) for share in (1.0, 0.5))
    assert np.allclose(half, whole / 2) and whole[0] > 0 and not whole[1:].any()


def test_a_pose_is_a_function_of_seed_and_number_alone() -> None:
    other = PoseRecipe(seen=3, unseen=10, distribution=AnatomicalPoses())
    assert np.array_equal(load_poses(RECIPE).draw(7), load_poses(other).draw(7))
    again = PoseRecipe(seen=3, unseen=10, distribution=AnatomicalPoses(), seed=1)
    assert not np.array_equal(load_poses(RECIPE).draw(7), load_poses(again).draw(7))


def test_both_arms_do_the_same_in_a_third_of_the_poses_and_independently_both_legs(degrees: np.ndarray) -> None:
    mirror = np.array([1, -1, -1])
    alike = {
        name: np.all(
            degrees[:, JOINTS.index(f"left_{name}")] == degrees[:, JOINTS.index(f"right_{name}")] * mirror, axis=1
        )
        for name in ("shoulder", "elbow", "hip", "knee")
    }
    assert np.array_equal(alike["shoulder"], alike["elbow"]) and np.array_equal(alike["hip"], alike["knee"])
    arms, legs = alike["shoulder"], alike["hip"]
    assert abs(arms.mean() - 1 / 3) < 0.05 and abs(legs.mean() - 1 / 3) < 0.05
    assert abs((arms & legs).mean() - 1 / 9) < 0.04


def test_a_share_of_the_poses_may_be_npts() -> None:
    mixed = PoseRecipe(seen=400, unseen=0, distribution=AnatomicalPoses(npt=0.25))
    poses = np.degrees(draw_poses(mixed, range(400)).rotations)
    straight = np.abs(poses[:, [JOINTS.index(name) for name in ("head", "spine1")]]).max(axis=(1, 2)) <= 1
    of_npt = straight & (poses[:, JOINTS.index("pelvis")] != 0).all(axis=1)
    assert abs(of_npt.mean() - 0.25) < 0.06
    assert not poses[~of_npt, JOINTS.index("pelvis")].any()
