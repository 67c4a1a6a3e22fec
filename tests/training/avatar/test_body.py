"""The canonical pose is where the hips are turned outwards, and transforms from there pose a body as its model does."""

import numpy as np
import pytest

from datagen.mesh.rig import skinned, world_rotations
from datagen.poses import JOINTS, PARENTS
from tests.support.shapes.canonical import posed_leg


def test_the_left_hip_is_turned_outwards_by_fifteen_degrees() -> None:
    hip, knee = posed_leg().body.joints
    down = (knee - hip) / np.linalg.norm(knee - hip)
    assert down == pytest.approx([np.sin(np.pi / 12), -np.cos(np.pi / 12), 0], abs=1e-5), "+X is to the body's left"


def test_the_canonical_pose_is_where_nothing_moves() -> None:
    body, axes = posed_leg().body, np.zeros((1, len(JOINTS), 3))
    axes[0, JOINTS.index("left_hip"), 2] = np.pi / 12
    identity = np.tile(np.eye(3, 4), (2, 1, 1))
    assert body.transforms(world_rotations(axes, PARENTS), JOINTS)[0] == pytest.approx(identity, abs=1e-5)


def test_transforms_pose_what_is_rigid_as_the_model_does() -> None:
    leg = posed_leg()
    posed = skinned(leg.body.vertices, leg.body.weights, leg.transforms)
    rigid = leg.body.weights.max(axis=1) > 0.9999
    assert 50 < rigid.sum() < len(rigid)
    assert np.abs(posed - leg.posed)[:, rigid].max() < 1e-4
    assert np.linalg.norm(posed - leg.posed, axis=2).max() < 1e-3, "only the hip has turned, which all of it follows"


def test_pose_joints_are_found_by_name() -> None:
    body, world = posed_leg().body, posed_leg().poses.world()
    order = np.random.default_rng(0).permutation(len(JOINTS))
    shuffled = body.transforms(world[:, order], [JOINTS[number] for number in order])
    assert np.array_equal(shuffled, posed_leg().transforms)
    assert body.drivers == ("left_hip", "left_knee") and not body.hands.any()
