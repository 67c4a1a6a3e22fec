"""The contract that every body family keeps. What is particular to each is in tests/datagen/bodies/."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.bodies import BodyModel, load_body, part_labels, require_joints
from datagen.common.errors import BodyError
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh, bounding_box, check_mesh
from datagen.mesh.rig import rest_vertices, skinned, world_rotations
from datagen.poses import JOINTS, Poses, draw_poses, load_poses
from datagen.recipe import AnnyBody, DatasetRecipe, LegBody, MixedBody, PoseRecipe, RangePoses
from tests.support.shapes.bodies import COARSE, FAMILIES, PEOPLE, recipe_parts


class Family(NamedTuple):
    name: str
    body: BodyModel
    poses: PoseRecipe
    expected_vertices: float | None

    def identity(self, number: int) -> np.ndarray:
        return self.body.draw_identity(generator(0, Stream.IDENTITY, number), number)

    def drawn(self, count: int) -> Poses:
        return draw_poses(self.poses, range(count))

    def still(self, count: int = 1) -> Poses:
        source = load_poses(self.poses)
        return Poses(source.joints, source.parents, np.zeros((count, len(source.joints), 3)))


@pytest.fixture(params=FAMILIES, scope="module")
def family(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Family:
    parts = recipe_parts(request.param, tmp_path_factory.mktemp(request.param))
    poses = {"seen": 4, "unseen": 2, "distribution": parts["distribution"]}
    recipe = DatasetRecipe.model_validate({"body": parts["body"], "poses": poses})
    return Family(request.param, load_body(recipe.body), recipe.poses, recipe.body.expected_vertices)


def test_parameters_are_named_and_drawn_from_their_seed(family: Family) -> None:
    first = family.identity(0)
    assert first.shape == (len(family.body.parameter_names),) and np.isfinite(first).all()
    assert len(set(family.body.parameter_names)) == len(family.body.parameter_names)
    assert np.array_equal(first, family.identity(0)) and not np.array_equal(first, family.identity(2))


def test_every_mesh_is_usable_and_every_vertex_belongs_to_a_face(family: Family) -> None:
    parameters = family.identity(3)
    faces = family.body.faces(parameters)
    for vertices in family.body.vertices(parameters, family.drawn(5)):
        check_mesh(Mesh(vertices, faces), name="body")
    assert faces.dtype == np.int32 and np.array_equal(np.unique(faces), np.arange(faces.max() + 1))


def test_a_vertex_count_that_is_known_before_loading_is_right(family: Family) -> None:
    made = family.body.vertices(family.identity(0), family.drawn(1)).shape[1]
    assert family.expected_vertices in (None, made)
    assert family.expected_vertices is not None or family.name not in ("anny", "leg")


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "imported"], indirect=True)
def test_outward_faces(family: Family) -> None:
    """Signed volume is positive: faces are counter-clockwise seen from outside (files may list them as they like)."""
    parameters = family.identity(0)
    corners = family.body.vertices(parameters, family.drawn(1))[0][family.body.faces(parameters)].astype(float)
    assert np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0


def test_poses_and_identities_change_the_mesh(family: Family) -> None:
    here, there = (family.body.vertices(family.identity(number), family.drawn(2)) for number in (1, 3))
    assert np.abs(here[0] - here[1]).max() > 0.02
    assert here.shape != there.shape or np.abs(here - there).max() > 0.01


def test_a_batch_gives_what_single_poses_give_to_the_bit(family: Family) -> None:
    count = 8 if family.name == "imported" else 40
    parameters, poses = family.identity(2), family.drawn(count)
    batch = family.body.vertices(parameters, poses)
    assert batch.dtype == np.float32 and len(batch) == count
    for row in (0, 5, count - 1):
        assert np.array_equal(batch[row], family.body.vertices(parameters, poses[row : row + 1])[0])


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "imported"], indirect=True)
@settings(max_examples=15)
@given(number=st.integers(0, 50), seed=st.integers(0, 99))
def test_its_rig_gives_its_vertices_without_it(family: Family, number: int, seed: int) -> None:
    """Within ten micrometres, for random identities and random rotations of every joint that its poses turn.

    Vertices at rest are found from four poses; the rig then has to give all of eight.
    """
    parameters, still = family.identity(number), family.still(8)
    turns = np.random.default_rng(seed).normal(0, 0.3, still.rotations.shape)
    poses = Poses(still.joints, still.parents, turns)
    vertices, rig = family.body.vertices(parameters, poses), family.body.rig(parameters, poses.joints)
    assert rig is not None and rig.weights.shape == (vertices.shape[1], len(rig.names)) and len(set(rig.names)) > 1
    assert len(rig.joints) == len(rig.names) == len(set(rig.names)) == len(rig.parents) == len(rig.drivers)
    transforms = rig.transforms(world_rotations(poses.rotations, poses.parents))
    rest = rest_vertices(vertices[:4], rig.weights, transforms[:4])
    labels = part_labels(family.body, parameters)
    bare = slice(None) if labels is None else labels == 0
    assert np.abs(skinned(rest, rig.weights, transforms) - vertices)[:, bare].max() < 1e-5, "draped cloth goes its way"


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "imported"], indirect=True)
def test_its_rig_has_a_part_for_each_that_some_poses_turn(family: Family) -> None:
    """Of joints that the poses do not have, bones are folded into those that they follow."""
    parameters, joints = family.identity(0), family.still(1).joints
    every = family.body.rig(parameters, joints)
    assert every is not None
    for some in (joints[:1], joints[:2]):
        rig = family.body.rig(parameters, some)
        assert rig is not None and 1 <= len(rig.names) <= len(every.names)
        assert rig.joints.shape == (len(rig.names), 3) and rig.weights.shape[1] == len(rig.names)
        heads = dict(zip(every.names, every.joints.tolist(), strict=True))
        assert all(
            heads[name] == joint for name, joint in zip(rig.names, rig.joints.tolist(), strict=True) if name in heads
        )


def test_its_assets_say_what_it_is_made_from(family: Family) -> None:
    assert family.body.assets and all(asset.name and asset.licence and asset.version for asset in family.body.assets)


def test_it_understands_the_joints_of_its_poses(family: Family) -> None:
    require_joints(family.body, load_poses(family.poses), family=family.name)


@pytest.mark.parametrize("family", PEOPLE, indirect=True)
def test_people_are_in_metres_and_stand_upright(family: Family) -> None:
    vertices = family.body.vertices(family.identity(0), family.still())[0]
    height = np.ptp(vertices[:, 1])
    assert 0.5 < height < 2.5 and height == pytest.approx(2 * bounding_box(vertices).half, rel=0.3)


@pytest.mark.parametrize("family", [*PEOPLE, "leg"], indirect=True)
def test_bending_the_left_knee_moves_the_left_foot_backwards(family: Family) -> None:
    """SMPL's convention: +X is the body's left, +Z its front; a positive turn about x at the knee swings back."""
    poses = family.still(2)
    poses.rotations[1, JOINTS.index("left_knee"), 0] = np.radians(90)
    straight, bent = family.body.vertices(family.identity(0), poses)
    foot = straight[:, 1] < straight[:, 1].min() + 0.1 * np.ptp(straight[:, 1])
    left = foot & (straight[:, 0] >= straight[foot, 0].mean())
    moved = (bent - straight)[left].mean(axis=0)
    assert moved[2] < -0.2 and moved[1] > 0.05


def test_a_mixed_body_gives_each_identity_its_own_body() -> None:
    recipes = (LegBody(), AnnyBody(topology=COARSE))
    mixed, parts = load_body(MixedBody(bodies=recipes)), [load_body(recipe) for recipe in recipes]
    poses = draw_poses(PoseRecipe(), range(2))
    for number in range(4):
        own = parts[number % 2]
        expected = own.draw_identity(generator(0, Stream.IDENTITY, number), number // 2)
        parameters = mixed.draw_identity(generator(0, Stream.IDENTITY, number), number)
        assert np.array_equal(mixed.faces(parameters), own.faces(expected))
        assert np.array_equal(mixed.vertices(parameters, poses), own.vertices(expected, poses))


def test_poses_that_turn_joints_which_a_body_lacks_are_refused() -> None:
    animal = load_poses(PoseRecipe(distribution=RangePoses(uniform=5, skeleton="smal")))
    with pytest.raises(BodyError, match=r"lacks: root, pelvis0, .*It has pelvis, left_hip"):
        require_joints(load_body(LegBody()), animal, family="leg")
