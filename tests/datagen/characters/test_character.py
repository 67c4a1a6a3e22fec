"""Characters: whatever a file's units, axes, pieces and rig, the same body comes out."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.bodies.skinning import Rest, skin
from datagen.characters.cc0_animals import SHA256
from datagen.characters.character import Character, load_character, load_characters, shared_joints
from datagen.characters.joint_names import pairs, parts, side
from datagen.common.errors import BodyError, RecipeError
from tests.support.shapes.rigged_files import BOXES, JOINTS, Floats, Rig, about

Z_UP = about("x", 90)


def character(rig: Rig, folder: Path, name: str = "person.glb") -> Character:
    return load_character(rig.save(folder / name))


def parent_of(body: Character, joint: str) -> str | None:
    parent = body.parents[body.names.index(joint)]
    return body.names[parent] if parent >= 0 else None


def same_body(one: Character, other: Character, *, within: float = 1e-6) -> bool:
    order = [other.names.index(name) for name in one.names]
    return (
        np.array_equal(one.faces, other.faces)
        and np.allclose(one.vertices, other.vertices, atol=within)
        and np.allclose(one.joints, other.joints[order], atol=within)
        and np.allclose(one.weights.toarray(), other.weights.toarray()[:, order])
    )


def test_the_surface_and_the_joints_of_a_file(tmp_path: Path) -> None:
    body, rig = character(Rig(), tmp_path), Rig()
    vertices, faces, joints = rig.surface()
    assert np.allclose(body.vertices, vertices) and np.array_equal(body.faces, faces)
    assert [body.names[joint] for joint in body.weights.toarray().argmax(axis=1)] == joints
    assert {name: parent_of(body, name) for name in body.names} == {
        name: parent for name, (parent, _) in JOINTS.items()
    }
    assert np.allclose(body.joints, [JOINTS[name][1] for name in body.names], atol=1e-6)
    assert all(parent < joint for joint, parent in enumerate(body.parents)), "parents come first"


MEANT_ALIKE = {
    "centimetres": Rig(units=100.0),
    "Z up, turned by the armature": Rig(mesh_axes=Z_UP, armature=Z_UP.T),
    "Z up, in centimetres": Rig(mesh_axes=Z_UP, armature=Z_UP.T, units=100.0),
    "facing -Z": Rig(mesh_axes=about("y", 180)),
    "facing +X": Rig(mesh_axes=about("y", 90)),
    "turned in the scene": Rig(armature=about("y", -90)),
    "shown in another pose": Rig(shown={"Spine": about("x", 40), "Leg.L": about("z", 50), "Hips": about("y", 15)}),
    "bones along the axes": Rig(bones="straight"),
    "weights of 0.2": Rig(factor=0.2),
    "weights as bytes": Rig(weights="uint8"),
    "weights as shorts": Rig(weights="uint16"),
    "eight influences": Rig(weights="two sets"),
    "in pieces": Rig(pieces=3),
    "a skin for each mesh": Rig(skins=2),
}


@pytest.mark.parametrize("how", MEANT_ALIKE)
def test_files_that_mean_the_same_give_the_same_body(tmp_path: Path, how: str) -> None:
    plain, other = character(Rig(), tmp_path), character(MEANT_ALIKE[how], tmp_path, "other.glb")
    if how in ("in pieces", "a skin for each mesh"):
        assert len(plain.vertices) == len(other.vertices), "cut vertices are one again"
    assert same_body(plain, other)


@pytest.mark.parametrize("how", ["centimetres", "Z up, in centimetres", "facing +X", "turned in the scene"])
def test_clips_turn_alike_whatever_the_axes(tmp_path: Path, how: str) -> None:
    """The head looks down by 50 degrees about the body's own left, in the middle of the clip."""
    rig = MEANT_ALIKE[how]
    bind, left = rig.bind(), rig.mesh_axes @ [1.0, 0, 0]
    spine = bind["Spine"][:3, :3]
    axis = spine.T @ left
    nod = Rotation.from_rotvec(np.radians(100) * axis).as_matrix()
    rig.clips = {"Nod": {"Neck": rig.keys("Neck", [np.eye(3), nod], [0.0, 1.0])}}
    body = character(rig, tmp_path)
    moment = body.pose("Nod", 0.5)
    expected = {"Neck": about("x", 50), "Head": about("x", 50)}
    if how == "turned in the scene":
        assert same_body(character(Rig(), tmp_path, "plain.glb"), body)
    for name, turned in zip(body.names, moment, strict=True):
        assert np.allclose(turned, expected.get(name, np.eye(3)), atol=1e-6), name


def test_skinning_by_a_clip_is_what_the_file_shows(tmp_path: Path) -> None:
    """Against the standard's own formula (3.7.3.1): sum of weight x joint matrix x inverse bind matrix x vertex."""
    rig = Rig(units=100.0)
    turn = {"Hips": about("y", 70), "Spine": about("z", 20), "Head": about("x", -35), "Leg.L": about("x", 60)}
    rig.clips = {"Move": {name: rig.keys(name, [its], [0.0]) for name, its in turn.items()}}
    body = character(rig, tmp_path)
    bind = rig.bind()
    world: dict[str, Floats] = {}
    shown: dict[str, Floats] = {}
    for name, (parent, _) in rig.joints.items():
        local = bind[name] if parent is None else np.linalg.inv(bind[parent]) @ bind[name]
        local = local.copy()
        local[:3, :3] = turn.get(name, np.eye(3)) @ local[:3, :3]
        world[name] = local if parent is None else world[parent] @ local
        shown[name] = world[name] @ np.linalg.inv(bind[name])
    vertices, _, joints = rig.surface()
    posed = [shown[joint] @ [*(100 * vertex), 1] for vertex, joint in zip(vertices, joints, strict=True)]
    expected = np.array(posed)[:, :3] / 100
    ours = skin(Rest(body.vertices, body.joints, body.weights, body.parents), body.pose("Move", 0.0)[None])[0]
    assert np.abs(ours - expected).max() < 1e-5


def test_feet_that_hang_off_the_armature_go_to_their_legs(tmp_path: Path) -> None:
    """Inverse kinematics: the weights that a stray joint shares with the body say where it belongs."""
    joints = dict(JOINTS) | {side: (None, JOINTS[side][1]) for side in ("Foot.L", "Foot.R")}
    joints |= {"Toe.L": ("Foot.L", (0.2, 0.1, 0.2)), "PoleTarget.L": ("Hips", (0.2, 1.0, 3.0))}
    rig = Rig(joints=joints)
    rig.boxes = [*BOXES, ((0.1, 0.0, 0.3), (0.3, 0.14, 0.35), "Toe.L", "Toe.L")]
    body = character(rig, tmp_path)
    assert parent_of(body, "Toe.L") == "Foot.L" and "PoleTarget.L" not in body.names
    assert [parent for parent in body.parents if parent < 0] == [-1]
    nearest = {side: parent_of(body, f"Foot.{side}") for side in "LR"}
    assert nearest == {"L": "Leg.L", "R": "Leg.R"}


def test_ears_beside_the_head_go_along_with_it(tmp_path: Path) -> None:
    joints = JOINTS | {"Ear1.L": ("Neck", (0.1, 1.8, 0.1)), "Ear2.L": ("Ear1.L", (0.1, 1.9, 0.1))}
    boxes = [*BOXES, ((0.05, 1.9, 0.0), (0.1, 2.0, 0.1), "Ear1.L", "Ear2.L")]
    body = character(Rig(joints=joints, boxes=boxes), tmp_path)
    assert parent_of(body, "Ear1.L") == "Head" and parent_of(body, "Ear2.L") == "Ear1.L"


def without_skin(path: Path) -> Path:
    document = Rig().document()
    for node in document.json["nodes"]:
        node.pop("skin", None)
    return document.save(path)


def two_skeletons(path: Path) -> Path:
    document = Rig(skins=2).document()
    nodes = document.json["nodes"]
    copies = [dict(node, name=f"other {node['name']}", children=[]) for node in nodes[: len(JOINTS)]]
    document.json["skins"][1]["joints"] = list(range(len(nodes), len(nodes) + len(copies)))
    nodes += copies
    return document.save(path)


def unweighted_vertex(path: Path) -> Path:
    return Rig(factor=0.0).save(path)


def mirrored(path: Path) -> Path:
    document = Rig().document()
    document.json["nodes"][len(JOINTS)]["scale"] = [-1, 1, 1]
    return document.save(path)


def twins(path: Path) -> Path:
    document = Rig().document()
    document.json["nodes"][3]["name"] = document.json["nodes"][2]["name"]
    return document.save(path)


def missing_joint(path: Path) -> Path:
    document = Rig().document()
    document.json["skins"][0]["joints"] = [0, 1]
    return document.save(path)


UNUSABLE: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no skin": (without_skin, "has no skin"),
    "two skeletons": (two_skeletons, "2 skeletons"),
    "vertices without a joint": (unweighted_vertex, "no joint moves"),
    "mirrored": (mirrored, "mirrored"),
    "inwards": (lambda path: Rig(inwards=True).save(path), "look inwards"),
    "one name twice": (twins, "two joints called 'Neck'"),
    "a joint that is not there": (missing_joint, "names joint"),
}


@pytest.mark.parametrize("what", UNUSABLE)
def test_what_cannot_be_used_is_said_in_one_sentence(tmp_path: Path, what: str) -> None:
    write, message = UNUSABLE[what]
    path = write(tmp_path / "person.glb")
    with pytest.raises(BodyError, match=message) as caught:
        load_character(path)
    assert str(path) in str(caught.value)


def test_a_damaged_tree_is_no_traceback(tmp_path: Path) -> None:
    document = Rig().document()
    document.json["nodes"][0]["children"] = [99]
    with pytest.raises(BodyError, match="is damaged"):
        load_character(document.save(tmp_path / "person.glb"))


def test_a_licence_follows_from_the_bytes_and_not_from_the_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An animal that was copied is the same asset; a file that was put among the animals is not CC0 for that."""
    monkeypatch.setenv("DSFFNET_CACHE", str(tmp_path / "cache"))
    inside, copied = (character(Rig(), tmp_path / place) for place in ("cache", "elsewhere"))
    assert inside.assets == copied.assets and inside.assets[0].licence == "the file's own"
    digest = hashlib.sha256((tmp_path / "cache" / "person.glb").read_bytes()).hexdigest()
    monkeypatch.setitem(SHA256, "person", digest)
    assert inside.assets == copied.assets and inside.assets[0].licence == "CC0-1.0"
    assert inside.assets[0].name == "person.glb"


def test_zero_edges_are_closed(tmp_path: Path) -> None:
    """Two vertices in one place with different joints, on one edge: the edge would have no length to compare with."""
    boxes = [((0.0, 0.0, 0.0), (0.1, 1.0, 0.1), "Hips", "Spine"), ((0.0, 1.0, 0.0), (0.1, 1.0, 0.1), "Neck", "Head")]
    body = character(Rig(boxes=[*BOXES, *boxes]), tmp_path)
    lengths = np.linalg.norm(body.vertices[body.faces] - body.vertices[np.roll(body.faces, 1, axis=1)], axis=2)
    assert lengths.min() > 0
    assert np.array_equal(np.unique(body.faces), np.arange(len(body.vertices))), "no vertex without a face"


class TestFolders:
    """Characters by folder and name."""

    def test_in_alphabetical_order_or_as_chosen(self, tmp_path: Path) -> None:
        for name in ("b.glb", "a.gltf", "c.glb"):
            Rig().save(tmp_path / name)
        assert [each.name for each in load_characters(str(tmp_path))] == ["a", "b", "c"]
        assert [each.name for each in load_characters(str(tmp_path), ("c", "a"))] == ["c", "a"]
        assert [each.name for each in load_characters(str(tmp_path / "b.glb"))] == ["b"]
        with pytest.raises(RecipeError, match=r"no character 'd' among .*; there are a, b, c"):
            load_characters(str(tmp_path), ("d",))

    def test_an_empty_folder_says_so(self, tmp_path: Path) -> None:
        with pytest.raises(BodyError, match=r"no \.glb or \.gltf files in"):
            load_characters(str(tmp_path))

    def test_one_name_twice_is_refused(self, tmp_path: Path) -> None:
        Rig().save(tmp_path / "a.glb")
        Rig().save(tmp_path / "a.gltf")
        with pytest.raises(BodyError, match="have one name"):
            load_characters(str(tmp_path))

    def test_shared_joints_pass_over_those_that_some_lack(self, tmp_path: Path) -> None:
        joints = {name: place for name, place in JOINTS.items() if name != "Neck"} | {
            "Head": ("Spine", (0.0, 1.7, 0.1))
        }
        boxes = [(low, high, *(name.replace("Neck", "Head") for name in names)) for low, high, *names in BOXES]
        bodies = [character(Rig(), tmp_path), character(Rig(joints=joints, boxes=boxes), tmp_path, "other.glb")]
        names, parents = shared_joints(bodies)
        assert "Neck" not in names and names[parents[names.index("Head")]] == "Spine"

    def test_no_joint_in_common_names_both(self, tmp_path: Path) -> None:
        joints = {f"b{name}": (parent and f"b{parent}", place) for name, (parent, place) in JOINTS.items()}
        boxes = [(low, high, f"b{below}", f"b{above}") for low, high, below, above in BOXES]
        bodies = [character(Rig(), tmp_path), character(Rig(joints=joints, boxes=boxes), tmp_path, "beast.glb")]
        with pytest.raises(BodyError, match=r"person\.glb and .*beast\.glb have no joint in common.*Hips.*bHips"):
            shared_joints(bodies)

    def test_files_beside_a_gltf_are_part_of_what_it_is(self, tmp_path: Path) -> None:
        body = load_character(Rig().save(tmp_path / "person.gltf"))
        assert [asset.name for asset in body.assets] == ["person.gltf", "person data.bin"]
        assert all(asset.version.startswith("sha256:") for asset in body.assets)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("FF.L", 1),
        ("FrontUpperLeg.R", -1),
        ("mixamorig:LeftArm", 1),
        ("hand_r", -1),
        ("lThigh", 1),
        ("Tail1", 0),
        ("Lower", 0),
    ],
)
def test_sides_of_names(name: str, expected: int) -> None:
    assert side(name) == expected


def test_pairs_differ_in_their_side_only() -> None:
    assert pairs(["Arm.L", "Arm.R", "Leg.L", "LeftHand", "RightHand", "Finger1.L", "Finger2.R"]) == [(0, 1), (3, 4)]


def test_parts_of_a_quadruped_and_of_a_person() -> None:
    animal = {
        "Body": -1, "Back": 0, "Neck1": 1, "Head": 2, "Ear1.L": 3, "Tail1": 1, "FrontShoulder.L": 1,
        "FrontUpperLeg.L": 6, "IKFrontLeg.L": 7, "FF.L": 8, "BackShoulder.R": 1, "BackLeg.R": 10, "FFB.R": 11,
    }  # fmt: skip
    assert parts(list(animal), list(animal.values())) == [
        "torso", "torso", "neck", "head", "ears", "tail", "torso", "forelimbs", "forelimbs", "forelimbs", "torso",
        "hindlimbs", "hindlimbs",
    ]  # fmt: skip
    person = {"mixamorig:Hips": -1, "mixamorig:LeftShoulder": 0, "mixamorig:LeftForeArm": 1, "mixamorig:LeftUpLeg": 0}
    assert parts(list(person), list(person.values())) == ["torso", "torso", "forelimbs", "hindlimbs"]
