"""Bodies from rigged characters: identities of every character, in proportions of their own."""

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from datagen.bodies import load_body
from datagen.bodies.proportions import Stretchable
from datagen.bodies.rigged import RiggedModel, part_scales
from datagen.characters.character import Character, load_character, load_characters
from datagen.characters.simplify import simplify
from datagen.characters.weld import volume
from datagen.common.errors import BodyError, RecipeError
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh, check_mesh, edges_of
from datagen.poses import Poses
from datagen.recipe import DatasetRecipe, RiggedBody
from tests.support.shapes.real_animals import require_animals
from tests.support.shapes.rigged_files import BOXES, JOINTS, Floats, Rig

REST = Poses(("Hips",), (-1,), np.zeros((1, 1, 3)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A person, and a taller one with a tail and more vertices."""
    Rig().save(tmp_path / "person.glb")
    joints = JOINTS | {"Tail1": ("Hips", (0.0, 1.0, -0.1)), "Tail2": ("Tail1", (0.0, 1.0, -0.4))}
    boxes = [*BOXES, ((-0.02, 0.98, -0.6), (0.02, 1.02, -0.1), "Tail1", "Tail2")]
    Rig(joints=joints, boxes=boxes, units=0.8).save(tmp_path / "devil.glb")
    return tmp_path


def model(folder: Path, **options: object) -> RiggedModel:
    return RiggedModel(RiggedBody.model_validate({"path": str(folder)} | options))


def identity(body: RiggedModel, number: int, *, seed: int = 0) -> Floats:
    return body.draw_identity(generator(seed, Stream.IDENTITY, number), number)


def bent(joint: str, degrees: float, axis: int = 0) -> Poses:
    names = tuple(JOINTS)
    parents = tuple(-1 if parent is None else names.index(parent) for parent, _ in JOINTS.values())
    rotations = np.zeros((1, len(names), 3))
    rotations[0, names.index(joint), axis] = np.radians(degrees)
    return Poses(names, parents, rotations)


def test_identities_are_of_every_character_in_turn(folder: Path) -> None:
    body = model(folder)
    assert [identity(body, number)[0] for number in range(4)] == [0, 1, 0, 1]
    counts = [body.vertices(identity(body, number), REST).shape[1] for number in range(4)]
    assert counts[0] == counts[2] > counts[1] == counts[3]
    for number in range(4):
        parameters = identity(body, number)
        check_mesh(Mesh(body.vertices(parameters, REST)[0], body.faces(parameters)), name="body")
        assert np.array_equal(np.unique(body.faces(parameters)), np.arange(counts[number]))


def test_parameters_are_named_and_drawn_from_their_seed(folder: Path) -> None:
    body = model(folder, bone_scale=0.3)
    drawn = np.stack([identity(body, number) for number in range(300)])
    assert body.parameter_names[0] == "character" and len(body.parameter_names) == drawn.shape[1]
    assert "tail length" in body.parameter_names and "ear size" not in body.parameter_names
    assert np.abs(drawn[:, 1:] - 1).max() <= 0.3 and np.ptp(drawn[:, 1:], axis=0).max() > 0.55
    assert np.array_equal(drawn[7], identity(body, 7)) and not np.array_equal(drawn[7], identity(body, 7, seed=1))


def test_without_scaling_the_files_own_bodies_come_out(folder: Path) -> None:
    body = model(folder, bone_scale=0.0)
    for number, character in enumerate(load_characters(str(folder))):
        vertices = body.vertices(identity(body, number), REST)[0]
        assert np.abs(vertices - character.vertices).max() < 1e-6


def test_height_is_that_of_the_character_before_its_parts_are_scaled(folder: Path) -> None:
    body = model(folder, bone_scale=0.0, height=1.5)
    heights = [np.ptp(body.vertices(identity(body, number), REST)[0, :, 1]) for number in range(2)]
    assert heights == pytest.approx([1.5, 1.5], abs=1e-5)


def test_joints_are_those_that_all_characters_have(folder: Path) -> None:
    assert set(model(folder).joints) == set(JOINTS)
    assert set(model(folder, characters=["devil"]).joints) == {*JOINTS, "Tail1", "Tail2"}
    with pytest.raises(RecipeError, match="no character 'angel'"):
        model(folder, characters=["angel"])


def test_characters_without_a_common_joint_are_refused(folder: Path) -> None:
    joints = {f"b{name}": (parent and f"b{parent}", place) for name, (parent, place) in JOINTS.items()}
    boxes = [(low, high, f"b{below}", f"b{above}") for low, high, below, above in BOXES]
    Rig(joints=joints, boxes=boxes).save(folder / "robot.glb")
    with pytest.raises(BodyError, match=r"devil\.glb and .*robot\.glb have no joint in common"):
        model(folder)


def test_a_bent_hip_carries_the_foot_and_nothing_else(folder: Path) -> None:
    """A positive turn about x swings what hangs down backwards."""
    body = model(folder, bone_scale=0.0, characters=["person"])
    moved = (body.vertices(identity(body, 0), bent("Leg.L", 60)) - body.vertices(identity(body, 0), REST))[0]
    rest = body.vertices(identity(body, 0), REST)[0]
    leg = (rest[:, 0] > 0.05) & (rest[:, 1] < 0.91)
    assert np.abs(moved[~leg]).max() < 1e-6
    assert (moved[leg & (rest[:, 1] < 0.2)][:, 2] < -0.3).all()


class TestProportions:
    """What each factor does."""

    @pytest.fixture
    def person(self, folder: Path) -> Character:
        return load_character(folder / "person.glb")

    def stretched(self, person: Character, **factors: float) -> tuple[Floats, Floats]:
        named = {name.replace("_", " "): factor for name, factor in factors.items()}
        return Stretchable(person).stretched(part_scales(named))

    def test_no_scaling_changes_nothing(self, person: Character) -> None:
        vertices, joints = self.stretched(person)
        assert np.abs(vertices - person.vertices).max() < 1e-9 and np.abs(joints - person.joints).max() < 1e-12

    def test_longer_limbs_make_longer_legs_alone(self, person: Character) -> None:
        _, joints = self.stretched(person, limb_length=1.4)
        foot, leg, head, hips = (person.names.index(name) for name in ("Foot.L", "Leg.L", "Head", "Hips"))
        grown, before = joints[leg] - joints[foot], person.joints[leg] - person.joints[foot]
        assert np.allclose(grown, 1.4 * before) and np.allclose(joints[head], person.joints[head])
        assert np.allclose(joints[hips], person.joints[hips])

    def test_girth_makes_thicker_not_longer(self, person: Character) -> None:
        vertices, joints = self.stretched(person, limb_girth=1.5)
        shin = (person.vertices[:, 0] > 0.05) & (np.abs(person.vertices[:, 1] - 0.5) < 0.41)
        assert np.allclose(joints, person.joints)
        assert np.ptp(vertices[shin, 0]) == pytest.approx(1.5 * np.ptp(person.vertices[shin, 0]), rel=0.02)
        assert np.ptp(vertices[shin, 1]) == pytest.approx(np.ptp(person.vertices[shin, 1]), rel=0.02)

    def test_head_size_scales_the_head_about_its_joint(self, person: Character) -> None:
        vertices, _ = self.stretched(person, head_size=0.7, neck_length=0.7, neck_girth=0.7)
        head = person.vertices[:, 1] > 1.551
        assert np.ptp(vertices[head], axis=0) == pytest.approx(0.7 * np.ptp(person.vertices[head], axis=0), rel=1e-6)

    def test_left_and_right_stay_alike(self, person: Character) -> None:
        vertices, _ = self.stretched(person, limb_length=1.3, limb_girth=0.8, torso_length=0.8, torso_girth=1.2)
        mirrored = vertices * [-1, 1, 1]
        distance = np.linalg.norm(vertices[:, None] - mirrored[None], axis=2).min(axis=1)
        assert distance.max() < 1e-6


def test_impossible_ranges_are_refused() -> None:
    for wrong in ({"bone_scale": 0.6}, {"bone_scale": -0.1}, {"height": -1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            RiggedBody.model_validate(wrong)


@pytest.mark.slow
class TestAnimals:
    """The twelve CC0 animals."""

    @pytest.fixture
    def animals(self) -> RiggedModel:
        require_animals()
        model = load_body(RiggedBody())
        assert isinstance(model, RiggedModel)
        return model

    def test_their_surfaces(self, animals: RiggedModel) -> None:
        """Closed but for the mouths of cow and bull and the antlers of the stag, and facing +Z."""
        for character in load_characters("animals"):
            sides = np.sort(np.concatenate([character.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]), axis=1)
            _, uses = np.unique(sides, axis=0, return_counts=True)
            assert (uses == 1).sum() <= (18 if character.name in ("bull", "cow", "stag") else 0), character.name
            assert 900 < len(character.vertices) < 1900 and volume(character.vertices, character.faces) > 0.01
            head, tail = (character.joints[character.names.index(name)] for name in ("Head", "Tail3"))
            assert head[2] - tail[2] > 0.3 and abs(head[0]) < 0.02 and abs(character.vertices[:, 1].min()) < 0.03

    def test_shared_skeleton_and_feet(self, animals: RiggedModel) -> None:
        assert len(animals.joints) == 34 and "Head" in animals.joints and "Tail4" not in animals.joints
        for character in load_characters("animals"):
            for foot, leg in (("IKBackLeg.L", "BackLowerLeg.L"), ("IKFrontLeg.R", "FrontLowerLeg.R")):
                assert character.names[character.parents[character.names.index(foot)]] == leg

    def test_no_identity_is_degenerate(self, animals: RiggedModel) -> None:
        """No face turns over and no edge leaves the range that its factors allow, in ten identities of each."""
        characters = load_characters("animals")
        for number in range(120):
            parameters, before = identity(animals, number), characters[number % 12]
            after = animals.vertices(parameters, Poses(("Body",), (-1,), np.zeros((1, 1, 3))))[0].astype(float)
            edges = edges_of(before.faces)
            ratio = length(after, edges) / length(before.vertices, edges)
            assert ratio.min() > 0.5 and ratio.max() < 1.6
            turned = (normals(after, before.faces) * normals(before.vertices, before.faces)).sum(axis=1)
            assert (turned > 0).all() and volume(after, before.faces) > 0.4 * volume(before.vertices, before.faces)


def length(vertices: Floats, edges: np.ndarray) -> Floats:
    return np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)


def normals(vertices: Floats, faces: np.ndarray) -> Floats:
    corners = vertices[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def test_simplified_animals_keep_their_volume_and_are_posed_like_the_whole_ones() -> None:
    path = str(require_animals())
    whole, coarse = (RiggedModel(RiggedBody(path=path, vertices=count)) for count in (None, 300))
    for number in range(12):
        parameters = identity(whole, number)
        assert np.array_equal(parameters, identity(coarse, number)), "the same identities"
        assert coarse.vertices(parameters, REST).shape[1] <= 330 < whole.vertices(parameters, REST).shape[1]
        volumes = [volume(body.vertices(parameters, REST)[0], body.faces(parameters)) for body in (whole, coarse)]
        assert volumes[1] == pytest.approx(volumes[0], rel=0.05)
    parameters, bent = identity(whole, 3), Poses(whole.joints[:1], (-1,), np.array([[[0.0, 0.7, 0.0]]]))
    fine, few = (body.vertices(parameters, bent)[0] for body in (whole, coarse))
    distance = np.linalg.norm(few[:, None] - fine[None], axis=2).min(axis=1)
    assert distance.max() < 0.05 * np.ptp(fine, axis=0).max()


def test_a_surface_whose_parts_would_vanish_is_refused() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    sides = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)
    vertices = np.concatenate([corners + 3 * number for number in range(100)])
    faces = np.concatenate([sides + 4 * number for number in range(100)])
    weights = scipy.sparse.csr_array(np.ones((400, 1)))
    with pytest.raises(BodyError, match=r"cloud.glb: 400 vertices cannot be simplified to 50, only to \d+"):
        simplify(vertices, faces, weights, 50, name="cloud.glb")


def test_a_recipe_without_the_number_of_vertices_means_what_it_meant() -> None:
    made = DatasetRecipe.model_validate({"body": {"family": "rigged"}})
    assert "vertices" in made.model_dump()["body"] and "vertices" not in made.identifying()["body"]
    fewer = DatasetRecipe.model_validate({"body": {"family": "rigged", "vertices": 300}})
    assert fewer.sha256() != made.sha256()
