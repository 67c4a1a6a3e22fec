"""Poses are read off meshes: a person posed by what was read stands as the mesh does, however it was turned."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body
from datagen.common.errors import CheckpointError, MeshError
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh
from datagen.mesh.rig import world_rotations
from datagen.poses import PARENTS, Poses, draw_poses
from datagen.recipe import AnnyBody, PoseRecipe
from training.inference.pose_reading import local_rotations, read_poses
from training.networks.parts import Parts
from workflows.pretrained import own_weights


def degrees_between(one: Poses, other: Poses) -> np.ndarray:
    turns = one.world().swapaxes(-1, -2) @ other.world()
    return np.degrees(Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude()).reshape(turns.shape[:2])


def test_local_rotations_are_those_that_world_ones_came_from() -> None:
    rotations = np.random.default_rng(0).normal(0, 0.4, (5, len(PARENTS), 3))
    assert local_rotations(world_rotations(rotations, PARENTS), PARENTS) == pytest.approx(rotations, abs=1e-4)


def test_the_pose_of_a_person_is_read() -> None:
    body, poses = load_body(AnnyBody(topology="notoes_collapse5pc")), draw_poses(PoseRecipe(seed=7), range(4))
    who = body.draw_identity(generator(7, Stream.IDENTITY, 0), 0)
    meshes = [Mesh(each, body.faces(who)) for each in body.vertices(who, poses)]
    found = Poses(*read_poses([own_weights("human")], meshes))
    assert set(found.joints) == set(poses.joints) and len(found) == 4
    order = [found.joints.index(name) for name in poses.joints]
    away = degrees_between(poses, Poses(poses.joints, poses.parents, found.rotations[:, order]))
    assert away.mean() < 8 and np.median(away) < 6
    again = body.vertices(who, found)
    posed, still = (
        np.linalg.norm(its - body.vertices(who, poses), axis=2).mean() for its in (again, body.vertices(who, poses[:1]))
    )
    assert posed < 0.03 and posed < 0.2 * still

    either = Poses(*read_poses([own_weights("animals"), own_weights("human")], meshes[:1]))
    assert either.joints == found.joints and np.array_equal(either.rotations, found.rotations[:1]), "who reads it best"

    quarter = Rotation.from_euler("y", 90, degrees=True)
    (turned,) = read_poses([own_weights("human")], [Mesh(quarter.apply(meshes[1].vertices), meshes[1].faces)]).rotations
    assert np.degrees((Rotation.from_rotvec(turned[0])).magnitude()) < 30, "people are read as they face"
    loose = Mesh(np.concatenate([meshes[1].vertices, [[0, 8, 0]]]), meshes[1].faces)
    (same,) = read_poses([own_weights("human")], [loose]).rotations
    assert (
        np.array_equal(same, found.rotations[1])
        or degrees_between(
            Poses(found.joints, found.parents, same[None]), Poses(found.joints, found.parents, found.rotations[1:2])
        ).max()
        < 12
    ), "a vertex in no face is not read"


def test_poses_are_what_is_read_again_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    body, poses = load_body(AnnyBody(topology="notoes_collapse5pc")), draw_poses(PoseRecipe(seed=7), range(1))
    who = body.draw_identity(generator(7, Stream.IDENTITY, 0), 0)
    mesh = Mesh(body.vertices(who, poses)[0], body.faces(who))
    monkeypatch.setattr(
        Parts, "read_again", lambda _, drawn, first: first._replace(rotations=torch.eye(3).expand_as(first.rotations))
    )
    np.testing.assert_allclose(read_poses([own_weights("human")], [mesh]).rotations, 0, atol=1e-6)


def test_what_is_no_person_and_weights_that_read_no_poses_are_refused() -> None:
    ball = trimesh.creation.icosphere(3)
    with pytest.raises(MeshError, match="mesh 0 is no body whose pose these weights know"):
        read_poses([own_weights("human")], [Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))])
    with pytest.raises(CheckpointError, match="holds no weights of network 'parts'"):
        read_poses([own_weights("human"), own_weights("dsffnet-people")], [])
