"""The contract that every body family keeps. What is particular to each is in tests/datagen/bodies/."""

import numpy as np
import pytest

from datagen.bodies import BodyModel, load_body, require_joints
from datagen.errors import BodyError
from datagen.mesh import Mesh, bounding_box, check_mesh
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses, load_poses
from datagen.random import Stream, generator
from datagen.recipe import AnnyBody, LegBody, MixedBody, PoseRecipe, RangePoses

RECIPES = {
    "anny": AnnyBody(topology="notoes_collapse3pc"),
    "leg": LegBody(),
    "mixed": MixedBody(bodies=(LegBody(), AnnyBody(topology="notoes_collapse3pc"))),
}
POSES = PoseRecipe()


@pytest.fixture(params=sorted(RECIPES), scope="module")
def body(request: pytest.FixtureRequest) -> BodyModel:
    return load_body(RECIPES[request.param])


def identity(body: BodyModel, number: int) -> np.ndarray:
    return body.draw_identity(generator(0, Stream.IDENTITY, number), number)


def drawn(count: int) -> Poses:
    return draw_poses(POSES, range(count))


def still(count: int = 1) -> Poses:
    return Poses(JOINTS, PARENTS, np.zeros((count, len(JOINTS), 3)))


def test_parameters_are_named_and_drawn_from_their_seed(body: BodyModel) -> None:
    first = identity(body, 0)
    assert first.shape == (len(body.parameter_names),) and np.isfinite(first).all()
    assert len(set(body.parameter_names)) == len(body.parameter_names)
    assert np.array_equal(first, identity(body, 0)) and not np.array_equal(first, identity(body, 2))


def test_every_mesh_is_usable_and_every_vertex_belongs_to_a_face(body: BodyModel) -> None:
    parameters = identity(body, 3)
    faces = body.faces(parameters)
    for vertices in body.vertices(parameters, drawn(5)):
        check_mesh(Mesh(vertices, faces), name="body")
    assert faces.dtype == np.int32 and np.array_equal(np.unique(faces), np.arange(faces.max() + 1))


def test_outward_faces(body: BodyModel) -> None:
    """Signed volume is positive: faces are counter-clockwise seen from outside."""
    parameters = identity(body, 0)
    corners = body.vertices(parameters, drawn(1))[0][body.faces(parameters)].astype(float)
    assert np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0


def test_poses_and_identities_change_the_mesh(body: BodyModel) -> None:
    here, there = (body.vertices(identity(body, number), drawn(2)) for number in (1, 3))
    assert np.abs(here[0] - here[1]).max() > 0.05 and np.abs(here - there).max() > 0.01


def test_a_batch_gives_what_single_poses_give_to_the_bit(body: BodyModel) -> None:
    parameters, poses = identity(body, 2), drawn(40)
    batch = body.vertices(parameters, poses)
    assert batch.dtype == np.float32
    for row in (0, 17, 39):
        assert np.array_equal(batch[row], body.vertices(parameters, poses[row : row + 1])[0])


def test_metres_and_y_up(body: BodyModel) -> None:
    vertices = body.vertices(identity(body, 0), still())[0]
    height = np.ptp(vertices[:, 1])
    assert 0.5 < height < 2.5 and height == pytest.approx(2 * bounding_box(vertices).half, rel=0.3)


def test_its_assets_say_what_it_is_made_from(body: BodyModel) -> None:
    assert body.assets and all(asset.name and asset.licence and asset.version for asset in body.assets)


def test_bending_the_left_knee_moves_the_left_foot_backwards(body: BodyModel) -> None:
    """SMPL's convention: +X is the body's left, +Z its front; a positive turn about x at the knee swings back."""
    poses = still(2)
    poses.rotations[1, JOINTS.index("left_knee"), 0] = np.radians(90)
    straight, bent = body.vertices(identity(body, 0), poses)
    foot = straight[:, 1] < straight[:, 1].min() + 0.1 * np.ptp(straight[:, 1])
    left = foot & (straight[:, 0] >= straight[foot, 0].mean())
    moved = (bent - straight)[left].mean(axis=0)
    assert moved[2] < -0.2 and moved[1] > 0.05


def test_a_mixed_body_gives_each_identity_its_own_body() -> None:
    mixed, parts = load_body(RECIPES["mixed"]), [load_body(RECIPES[name]) for name in ("leg", "anny")]
    for number in range(4):
        own = parts[number % 2]
        expected = own.draw_identity(generator(0, Stream.IDENTITY, number), number // 2)
        parameters = identity(mixed, number)
        assert np.array_equal(mixed.faces(parameters), own.faces(expected))
        assert np.array_equal(mixed.vertices(parameters, drawn(2)), own.vertices(expected, drawn(2)))


def test_poses_that_turn_joints_which_a_body_lacks_are_refused() -> None:
    animal = load_poses(PoseRecipe(distribution=RangePoses(uniform=5, skeleton="smal")))
    with pytest.raises(BodyError, match=r"lacks: root, pelvis0, .*It has pelvis, left_hip"):
        require_joints(load_body(RECIPES["leg"]), animal, family="leg")
