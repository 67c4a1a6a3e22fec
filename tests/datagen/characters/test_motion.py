"""A GLB's mesh as its animations move it: by joints, nodes and morph targets."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from datagen.characters.motion import Motion, animation_names
from datagen.common.errors import BodyError, DsffnetError, MeshError
from datagen.mesh.files import read_mesh_file
from datagen.mesh.sequences import write_animation
from tests.support.shapes.rigged_files import Document, Rig, about, nodding, quaternion

SECOND, NONE = [0.0, 1.0], np.eye(3)
_HALF = 0.5**0.5  # of a unit square's diagonal


def motion(path: Path, animation: str, fps: float = 4.0) -> Motion:
    return Motion.of(read_mesh_file(path), animation, frames_per_second=fps)


def below(rig: Rig, joint: str) -> NDArray[np.bool_]:
    """Which vertices hang on a joint."""
    names = rig.surface()[2]
    chain = {joint} | {name for name, (parent, _) in rig.joints.items() if parent == joint}
    return np.array([name in chain for name in names])


def test_a_joint_turns_what_hangs_on_it_about_itself(tmp_path: Path) -> None:
    rig = Rig()
    nod = motion(nodding(tmp_path / "a.glb"), "Nod")
    rest, moved = rig.surface()[0], below(rig, "Neck")
    assert nod.count == 5
    for frame in range(5):
        turn = rig.bind()["Hips"][:3, :3] @ rig.local_rotation("Spine")  # a key turns in its parent's axes
        own = turn @ about("x", 15 * frame) @ turn.T
        pivot = np.array(rig.joints["Neck"][1])
        expected = np.where(moved[:, None], (rest - pivot) @ own.T + pivot, rest)
        assert np.allclose(nod.mesh(frame).vertices, expected, atol=1e-5)


def test_it_ends_with_its_last_key_and_every_animation_has_its_own_length(tmp_path: Path) -> None:
    path = nodding(tmp_path / "a.glb")
    assert animation_names(path) == ("Nod", "Kick")
    assert [motion(path, name, 30).count for name in ("Nod", "Kick")] == [31, 16]
    assert motion(path, "Nod", 0.3).count == 1


def test_units_and_an_armature_that_is_turned(tmp_path: Path) -> None:
    plain = motion(nodding(tmp_path / "a.glb"), "Nod").mesh(3)
    lying = about("x", 90)
    other = nodding(tmp_path / "b.glb", units=100.0, mesh_axes=lying, armature=lying.T, pieces=2, bones="turned")
    assert len(motion(other, "Nod").mesh(3).vertices) >= len(plain.vertices)
    assert np.allclose(motion(other, "Nod").mesh(3).vertices.max(axis=0), plain.vertices.max(axis=0), atol=1e-4)


def moving_box(path: Path, kind: str, values: list[list[float]], interpolation: str = "LINEAR") -> Path:
    """A box below a node that is moved."""
    document, box = Document(), trimesh.creation.box()
    attributes = {"POSITION": document.accessor(box.vertices)}
    indices = document.accessor(np.ravel(box.faces), "uint16")
    keys = {"input": document.accessor(SECOND), "output": document.accessor(np.ravel(values)[:, None])}
    width = len(values[0])
    if width > 1:
        keys["output"] = document.accessor(values)
    document.json |= {
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices}]}],
        "nodes": [{"children": [1]}, {"mesh": 0}],
        "animations": [{
            "name": "move", "samplers": [keys | {"interpolation": interpolation}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": kind}}],
        }],
    }  # fmt: skip
    return document.save(path)


@pytest.mark.parametrize(
    ("kind", "values", "least", "most"),
    [
        ("translation", [[0, 0, 0], [0, 4, 0]], [-0.5, 0.5, -0.5], [0.5, 1.5, 0.5]),
        ("scale", [[1, 1, 1], [1, 9, 1]], [-0.5, -1.5, -0.5], [0.5, 1.5, 0.5]),
        ("rotation", [quaternion(NONE), quaternion(about("z", 180))], [-_HALF, -_HALF, -0.5], [_HALF, _HALF, 0.5]),
    ],
)
def test_a_node_above_the_mesh_moves_it(
    tmp_path: Path, kind: str, values: list[list[float]], least: list[float], most: list[float]
) -> None:
    box = motion(moving_box(tmp_path / "box.glb", kind, values), "move").mesh(1).vertices  # a quarter of the way
    assert np.allclose([box.min(axis=0), box.max(axis=0)], [least, most], atol=1e-5)


def test_cameras_that_move_longer_add_no_frames_and_one_that_moves_alone_is_no_motion(tmp_path: Path) -> None:
    path = moving_box(tmp_path / "box.glb", "translation", [[0, 0, 0], [0, 4, 0]])
    scene = Document()
    times = scene.accessor([0.0, 9.0])
    box = trimesh.creation.box()
    attributes = {"POSITION": scene.accessor(box.vertices)}
    keys = {"input": times, "output": scene.accessor([[0.0, 0, 0], [1.0, 0, 0]])}
    short = {"input": scene.accessor(SECOND), "output": scene.accessor([[0.0, 0, 0], [0.0, 4, 0]])}
    camera, own = ({"sampler": number, "target": {"node": number, "path": "translation"}} for number in (0, 1))
    indices = scene.accessor(np.ravel(box.faces), "uint16")
    scene.json |= {
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices}]}],
        "nodes": [{"name": "camera"}, {"mesh": 0}],
        "animations": [
            {"name": "both", "samplers": [keys, short], "channels": [camera, own]},
            {"name": "camera alone", "samplers": [keys], "channels": [camera]},
        ],
    }
    both = scene.save(tmp_path / "both.glb")
    assert animation_names(both) == ("both",)
    assert motion(both, "both").count == motion(path, "move").count == 5


def test_steps_and_cubic_curves(tmp_path: Path) -> None:
    steps = moving_box(tmp_path / "steps.glb", "translation", [[0, 0, 0], [0, 4, 0]], "STEP")
    assert np.allclose([motion(steps, "move").mesh(at).vertices.mean(axis=0)[1] for at in (3, 4)], [0, 4])
    zero = [0.0, 0.0, 0.0]
    cubic = moving_box(
        tmp_path / "cubic.glb", "translation", [zero, zero, zero, zero, [0.0, 4.0, 0.0], zero], "CUBICSPLINE"
    )
    assert np.isclose(motion(cubic, "move").mesh(1).vertices.mean(axis=0)[1], 4 * (3 / 16 - 2 / 64))


def test_morph_targets_as_this_project_writes_them(tmp_path: Path) -> None:
    body = trimesh.creation.icosphere(subdivisions=1)
    body.export(tmp_path / "ball.obj")
    frames = [body.vertices * (1, stretch, 1) for stretch in (1.0, 1.5, 0.5, 2.0)]
    file = read_mesh_file(tmp_path / "ball.obj")
    write_animation(
        file, [frame[: len(file.mesh.vertices)] for frame in frames], tmp_path / "ball.glb", frames_per_second=10
    )
    (name,) = animation_names(tmp_path / "ball.glb")
    played = motion(tmp_path / "ball.glb", name, 10)
    assert played.count == 4
    for number, frame in enumerate(frames):
        assert np.allclose(played.mesh(number).vertices, frame, atol=1e-5)
    between = motion(tmp_path / "ball.glb", name, 20).mesh(1).vertices
    assert np.allclose(between, (frames[0] + frames[1]) / 2, atol=1e-5)


def test_an_animation_that_is_not_there_or_moves_no_mesh(tmp_path: Path) -> None:
    path = nodding(tmp_path / "a.glb")
    with pytest.raises(MeshError, match=r"a\.glb has no animation 'Run' that moves a mesh; it has 'Nod', 'Kick'"):
        motion(path, "Run")
    with pytest.raises(MeshError, match=r"no animation 'nod' that moves a mesh, did you mean 'Nod'\?; it has"):
        motion(path, "nod")
    rig = Rig()
    rig.clips["Nod"] = {"Neck": rig.keys("Neck", [NONE, about("x", 60)], SECOND)}
    document = rig.document()
    document.json["nodes"].append({"name": "lamp"})
    document.json["animations"][0]["channels"][0]["target"]["node"] = len(document.json["nodes"]) - 1
    assert animation_names(document.save(tmp_path / "lamp.glb")) == ()
    trimesh.creation.box().export(tmp_path / "box.obj")
    with pytest.raises(MeshError, match=r"box\.obj has no animation 'Nod' that moves a mesh; it has none"):
        motion(tmp_path / "box.obj", "Nod")


def test_too_many_frames_are_refused_before_any_is_made(tmp_path: Path) -> None:
    rig = Rig()
    rig.clips["Long"] = {"Neck": rig.keys("Neck", [NONE, about("x", 60)], [0.0, 3e38])}
    with pytest.raises(MeshError, match="frames at 30 a second, more than 2,000: take fewer a second"):
        motion(rig.save(tmp_path / "a.glb"), "Long", 30)


def test_a_body_that_is_flat_at_a_moment_or_nowhere_is_refused_there(tmp_path: Path) -> None:
    flat = motion(moving_box(tmp_path / "flat.glb", "scale", [[1, 1, 1], [1, 0, 1]]), "move")
    flat.mesh(3)
    with pytest.raises(MeshError, match=r"flat\.glb, animation 'move' at 1\.00 s is flat"):
        flat.mesh(4)
    nowhere = motion(moving_box(tmp_path / "no.glb", "translation", [[0, 0, 0], [0, np.nan, 0]]), "move")
    with pytest.raises(MeshError, match=r"no\.glb, animation 'move' at 1\.00 s: 8 vertices are not finite"):
        nowhere.mesh(4)


HOSTILE: dict[str, Any] = {
    "channels are a number": lambda file: file["animations"][0].update(channels=7),
    "a node that is none": lambda file: file["animations"][0]["channels"][0]["target"].update(node=99),
    "no output": lambda file: file["animations"][0]["samplers"][0].update(output=99),
    "a path that is none": lambda file: file["animations"][0]["channels"][0]["target"].update(path=["rotation"]),
    "a joint that is none": lambda file: file["skins"][0]["joints"].append(99),
}


@pytest.mark.parametrize("how", sorted(HOSTILE))
def test_damaged_animations_are_one_error_and_hide_nothing_at_rest(tmp_path: Path, how: str) -> None:
    rig = Rig()
    rig.clips["Nod"] = {"Neck": rig.keys("Neck", [NONE, about("x", 60)], SECOND)}
    document = rig.document()
    HOSTILE[how](document.json)
    path = document.save(tmp_path / "bad.glb")
    assert animation_names(path) == () or how == "a joint that is none"
    with pytest.raises(DsffnetError, match=r"bad\.glb"):
        motion(path, "Nod").mesh(1)


def test_a_key_without_length_is_said_with_its_file(tmp_path: Path) -> None:
    with pytest.raises((BodyError, MeshError), match=r"zero\.glb"):
        motion(moving_box(tmp_path / "zero.glb", "rotation", [[0, 0, 0, 1], [0, 0, 0, 0]]), "move").mesh(4)
