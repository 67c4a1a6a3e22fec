"""Rigs: transforms by the textbook, folded bones, and the way back from posed vertices to those at rest."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.bodies.skinning import Rest, rig_of
from datagen.mesh.rig import Rig, drivers_of, part_transforms, rest_vertices, skinned, world_rotations

PARENTS = (-1, 0, 1, 1, 0)


def literally(rotations: np.ndarray, joints: np.ndarray, parents: Sequence[int]) -> np.ndarray:
    """One pose, one part at a time: G_k = [R_k | p_k - R_k j_k], p_k = p_parent + R_parent (j_k - j_parent)."""
    transforms = np.empty((*rotations.shape[:2], 3, 4))
    for pose, turns in enumerate(rotations):
        places = joints.astype(float).copy()
        for part, parent in enumerate(parents):
            if parent >= 0:
                places[part] = places[parent] + turns[parent] @ (joints[part] - joints[parent])
            transforms[pose, part] = np.c_[turns[part], places[part] - turns[part] @ joints[part]]
    return transforms


def body(seed: int = 0, vertices: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, joints and weights of a body of five joints."""
    random = np.random.default_rng(seed)
    weights = random.uniform(size=(vertices, 5)) ** 4
    return random.normal(size=(vertices, 3)), random.normal(size=(5, 3)), weights / weights.sum(axis=1, keepdims=True)


def turns(poses: int, joints: int = 5, seed: int = 1) -> np.ndarray:
    return Rotation.random(poses * joints, random_state=seed).as_matrix().reshape(poses, joints, 3, 3)


def test_transforms_are_forward_kinematics_along_the_parents() -> None:
    joints = body()[1]
    assert np.abs(part_transforms(turns(6), joints, PARENTS) - literally(turns(6), joints, PARENTS)).max() < 1e-12


def test_leading_axes_broadcast() -> None:
    """One pose of many identities, many poses of one, and pairs of both are the same numbers."""
    joints, rotations = np.stack([body(seed)[1] for seed in range(3)]), turns(3)
    pairs = part_transforms(rotations, joints, PARENTS)
    grid = part_transforms(rotations, joints[:, None], PARENTS)
    assert grid.shape == (3, 3, 5, 3, 4) and np.allclose(pairs, grid[range(3), range(3)], atol=1e-12)
    assert np.allclose(part_transforms(rotations[0], joints, PARENTS), grid[:, 0], atol=1e-12)


def test_world_rotations_are_products_from_the_root_on() -> None:
    vectors = np.random.default_rng(2).normal(size=(4, 5, 3))
    own = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(4, 5, 3, 3)
    world = world_rotations(vectors, PARENTS)
    for joint, chain in enumerate(((0,), (0, 1), (0, 1, 2), (0, 1, 3), (0, 4))):
        expected = np.stack([np.linalg.multi_dot([np.eye(3), np.eye(3), *own[pose, list(chain)]]) for pose in range(4)])
        assert np.abs(world[:, joint] - expected).max() < 1e-6


def test_bones_without_a_pose_joint_obey_their_parent_and_a_root_stays() -> None:
    names = (None, "hip", None, "knee", "tail")
    assert drivers_of(names, PARENTS, ("knee", "hip")) == (-1, 1, 1, 0, -1)


@pytest.mark.parametrize(
    ("drivers", "kept", "parents"),
    [
        ((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), PARENTS),
        ((0, 1, 1, 3, 0), (0, 1, 3), (-1, 0, 1)),
        ((-1, -1, -1, 2, 0), (0, 3, 4), (-1, 0, 0)),
        ((1, 1, 1, 1, 1), (0,), (-1,)),
    ],
)
def test_bones_that_move_as_their_parents_do_are_folded_exactly(
    drivers: tuple[int, ...], kept: tuple[int, ...], parents: tuple[int, ...]
) -> None:
    vertices, joints, weights = body()
    world = turns(7, joints=5)
    rig = rig_of(Rest(vertices, joints, weights, PARENTS), "abcde", drivers)
    assert rig.names == tuple("abcde"[bone] for bone in kept) and rig.parents == parents
    every = np.concatenate([world, np.broadcast_to(np.eye(3), (7, 1, 3, 3))], axis=1)[:, list(drivers)]
    expected = skinned(vertices, weights, literally(every, joints, PARENTS))
    assert np.abs(skinned(vertices, rig.weights, rig.transforms(world)) - expected).max() < 2e-6


def test_bones_of_one_joint_and_different_corrections_stay_apart() -> None:
    vertices, joints, weights = body()
    corrections = np.tile(np.eye(3), (5, 1, 1))
    corrections[[1, 2, 3]] = turns(1)[0, 0]
    rig = rig_of(Rest(vertices, joints, weights, PARENTS), "abcde", (0,) * 5, corrections)
    assert rig.names == ("a", "b") and np.array_equal(rig.corrections, corrections[:2])
    every = turns(3)[:, [0] * 5] @ corrections
    expected = skinned(vertices, weights, literally(every, joints, PARENTS))
    assert np.abs(skinned(vertices, rig.weights, rig.transforms(turns(3))) - expected).max() < 2e-6


def test_vertices_at_rest_come_back_from_a_few_poses() -> None:
    vertices, joints, weights = body()
    rig = Rig(tuple("abcde"), PARENTS, tuple(range(5)), np.tile(np.eye(3), (5, 1, 1)), weights, joints)
    transforms = rig.transforms(turns(4))
    assert np.abs(rest_vertices(skinned(vertices, weights, transforms), weights, transforms) - vertices).max() < 1e-9
