"""GLB files of a person: what a viewer shows is what is posed, and the rest of the file stays."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from datagen.common.errors import MeshError
from datagen.mesh.files import geometry_names, read_mesh_file, write_posed
from datagen.mesh.formats import glb
from datagen.mesh.formats.gltf import Gltf
from datagen.mesh.sequences import write_animation
from tests.support.shapes.mesh_files import FACES, PNG, POINTS, scene, sound
from tests.support.shapes.rigged_files import Document

MIRRORED = FACES[:, ::-1]  # as the node of the scene does: what is in front would be behind else


def saved(document: Document, folder: Path) -> Path:
    return document.save(folder / "scene.glb")


def test_vertices_are_those_of_the_world_and_come_back_through_the_nodes(tmp_path: Path) -> None:
    read = read_mesh_file(saved(scene(), tmp_path))
    expected = (POINTS * (2, 2, -2))[:, [1, 0, 2]] * (-1, 1, 1) + (10, 0, 0)
    assert np.allclose(read.mesh.vertices, expected, atol=1e-6)
    moved = read.mesh.vertices * (1, 2, 3) + 1
    assert write_posed(read, moved, tmp_path / "out.glb").left_out == []
    again = read_mesh_file(tmp_path / "out.glb")
    assert np.allclose(again.mesh.vertices, moved, atol=1e-5) and np.array_equal(again.mesh.faces, MIRRORED)
    loaded = trimesh.load(tmp_path / "out.glb", process=False, force="mesh")
    assert np.allclose(np.sort(loaded.triangles.ravel()), np.sort(moved[FACES].ravel()), atol=1e-5)


def test_nodes_materials_textures_and_attributes_stay(tmp_path: Path) -> None:
    document = scene()
    read = read_mesh_file(saved(document, tmp_path))
    write_posed(read, read.mesh.vertices * 2, tmp_path / "out.glb")
    after = sound(tmp_path / "out.glb")
    assert after["nodes"] == document.json["nodes"] and after["materials"] == document.json["materials"]
    file = Gltf(tmp_path / "out.glb")
    pieces = after["meshes"][0]["primitives"]
    assert len({piece["attributes"]["POSITION"] for piece in pieces}) == 1
    for piece, before in zip(pieces, document.json["meshes"][0]["primitives"], strict=True):
        original = Gltf(tmp_path / "scene.glb")
        assert piece["material"] == before["material"]
        for name in ("TEXCOORD_0", "_MARK"):
            kept = file.accessor(piece["attributes"][name])
            assert np.array_equal(kept, original.accessor(before["attributes"][name]))
    assert PNG in (tmp_path / "out.glb").read_bytes()
    assert POINTS.tobytes() not in (tmp_path / "out.glb").read_bytes()  # nothing of the old shape is left in it


def test_normals_follow_the_pose_and_are_one_across_a_seam(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3)
    seam = 2 * len(ball.vertices)
    document = Document()
    attributes = {
        "POSITION": document.accessor(np.tile(ball.vertices, (2, 1))),
        "NORMAL": document.accessor(np.tile(ball.vertices, (2, 1))),
    }
    halves = np.where(ball.triangles_center[:, :1] > 0, ball.faces, ball.faces + len(ball.vertices))
    piece = {"attributes": attributes, "indices": document.accessor(halves.ravel(), "uint16")}
    document.json |= {"nodes": [{"mesh": 0}], "meshes": [{"name": "ball", "primitives": [piece]}]}
    read = read_mesh_file(saved(document, tmp_path))
    assert len(read.mesh.vertices) == seam and read.name == "ball"
    stretched = read.mesh.vertices * (1, 1, 4)
    write_posed(read, stretched, tmp_path / "out.glb")
    written = sound(tmp_path / "out.glb")["meshes"][0]["primitives"][0]["attributes"]
    normals = Gltf(tmp_path / "out.glb").accessor(written["NORMAL"])
    expected = stretched / (1, 1, 16)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.allclose(normals, expected, atol=0.06)
    assert np.array_equal(normals[: seam // 2], normals[seam // 2 :])


def test_skin_animation_and_morphs_are_applied_at_rest_then_dropped_and_named(tmp_path: Path) -> None:
    document = scene()
    joints, weights = (
        document.accessor(np.tile([0, 1, 0, 0], (4, 1)), "uint8"),
        document.accessor([[0.5, 0.5, 0, 0]] * 4),
    )
    target = {"POSITION": document.accessor(np.ones((4, 3)))}
    for piece in document.json["meshes"][0]["primitives"]:
        piece["attributes"] |= {"JOINTS_0": joints, "WEIGHTS_0": weights}
        piece["targets"] = [target]
    document.json["meshes"][0]["weights"] = [0.25]
    document.json["nodes"] += [{"name": "a", "translation": [0, 4, 0]}, {"name": "b", "scale": [3, 3, 3]}]
    document.json["nodes"][1]["skin"] = 0
    document.json["skins"] = [{"joints": [2, 3]}]
    times = document.accessor([0.0, 1.0])
    sampler = {"input": times, "output": document.accessor(np.zeros((2, 3)))}
    channel = {"sampler": 0, "target": {"node": 2, "path": "translation"}}
    document.json["animations"] = [{"samplers": [sampler], "channels": [channel]}]
    read = read_mesh_file(saved(document, tmp_path))
    rest = POINTS + 0.25
    assert np.allclose(read.mesh.vertices, (rest + np.array([0, 4, 0])) / 2 + 3 * rest / 2, atol=1e-6)
    notes = write_posed(read, read.mesh.vertices, tmp_path / "out.glb").left_out
    assert notes == ["skins", "animations", "morph targets"]
    again = read_mesh_file(tmp_path / "out.glb")
    assert np.allclose(again.mesh.vertices, read.mesh.vertices, atol=1e-5)
    after = sound(tmp_path / "out.glb")
    assert not {"skins", "animations"} & set(after) and "weights" not in after["meshes"][0]
    assert [node["name"] for node in after["nodes"]] == ["root", "body", "a", "b"]


def character(folder: Path) -> Path:
    """A body, two eyes that share a mesh, one of them mirrored and turned, and a coloured hat without normals."""
    document = scene()
    ball, box = trimesh.creation.icosphere(2), trimesh.creation.box()
    eye = {"attributes": {"POSITION": document.accessor(ball.vertices), "NORMAL": document.accessor(ball.vertices)}}
    hat = {"POSITION": document.accessor(box.vertices), "COLOR_0": document.accessor(np.full((8, 3), 0.25))}
    document.json["meshes"] += [
        {"name": "eye", "primitives": [eye | {"indices": document.accessor(ball.faces.ravel(), "uint16")}]},
        {"name": "hat", "primitives": [{"attributes": hat, "indices": document.accessor(box.faces.ravel(), "uint16")}]},
    ]
    document.json["nodes"][0]["children"] += [2, 3, 4]
    document.json["nodes"] += [
        {"name": "left", "mesh": 1, "translation": [1, 2, 0]},
        {"name": "right", "mesh": 1, "translation": [-1, 2, 0], "scale": [-1, 1, 1], "rotation": [0.5, 0.5, 0.5, 0.5]},
        {"name": "hat", "mesh": 2, "translation": [0, 3, 0], "scale": [1, 2, 1]},
        {"name": "elsewhere", "mesh": 2},
        {"name": "hidden", "mesh": 2, "scale": [0, 0, 0]},
    ]
    return saved(document, folder)


def outward(triangles: Any, middle: Any) -> bool:
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return bool((np.einsum("fi,fi->f", normals, triangles.mean(axis=1) - middle) > 0).all())


def test_geometries_that_make_one_body_are_one_mesh_and_come_back_whole(tmp_path: Path) -> None:
    path = character(tmp_path)
    read = read_mesh_file(path)
    assert read.geometries == ("body", "left", "right", "hat") and read.name == "scene"
    shown = trimesh.load(path, process=False, force="mesh")  # another reader's idea of the same scene
    assert np.allclose(*(np.unique(each.round(4), axis=0) for each in (read.mesh.vertices, shown.vertices)))
    moved = read.mesh.vertices * (1, 2, 3) + 1
    assert write_posed(read, moved, tmp_path / "out.glb").left_out == ["other geometries: elsewhere, hidden"]
    after, before = sound(tmp_path / "out.glb"), Gltf(path).json
    assert [node | {"mesh": 0} for node in after["nodes"][:5]] == [node | {"mesh": 0} for node in before["nodes"][:5]]
    assert [mesh.get("name") for mesh in after["meshes"]] == [None, "eye", "eye", "hat"]
    assert after["materials"] == before["materials"] and PNG in (tmp_path / "out.glb").read_bytes()
    again = read_mesh_file(tmp_path / "out.glb")
    assert again.geometries == read.geometries and np.array_equal(again.mesh.faces, read.mesh.faces)
    assert np.allclose(again.mesh.vertices, moved, atol=1e-5)
    for kept in ("uvs", "colours", "material_of"):
        assert np.array_equal(getattr(again.content.surface, kept), getattr(read.content.surface, kept))


def test_mirrored_geometries_point_outwards_as_do_their_normals(tmp_path: Path) -> None:
    read = read_mesh_file(character(tmp_path), geometries=["left", "right"])
    assert read.geometries == ("left", "right") and len(read.mesh.vertices) == 2 * 162
    stretched = read.mesh.vertices * (1, 1, 3)
    for half in (slice(0, 320), slice(320, 640)):
        triangles = stretched[read.mesh.faces[half]]
        assert outward(triangles, triangles.mean(axis=(0, 1)))
    write_posed(read, stretched, tmp_path / "out.glb")
    file = Gltf(tmp_path / "out.glb")
    for node, mesh in zip((2, 3), file.json["meshes"], strict=True):
        attributes, world = mesh["primitives"][0]["attributes"], file.world[node][:3, :3]
        positions = file.accessor(attributes["POSITION"]) @ world.T
        normals = file.accessor(attributes["NORMAL"]) @ np.linalg.inv(world)
        expected = (positions - positions.mean(axis=0)) / (1, 1, 9)
        assert (np.einsum("vi,vi->v", normals, expected) > 0.98 * np.linalg.norm(expected, axis=1)).all()


def test_every_geometry_moves_in_an_animation(tmp_path: Path) -> None:
    read = read_mesh_file(character(tmp_path))
    frames = [read.mesh.vertices + step for step in (0, 1, 2)]
    write_animation(read, frames, tmp_path / "moving.glb", frames_per_second=10)
    after = sound(tmp_path / "moving.glb")
    assert [channel["target"]["node"] for channel in after["animations"][0]["channels"]] == [1, 2, 3, 4]
    assert all(len(primitive["targets"]) == 2 for mesh in after["meshes"] for primitive in mesh["primitives"])
    file = Gltf(tmp_path / "moving.glb")
    last = file.json["meshes"][2]["primitives"][0]["targets"][1]["POSITION"]
    assert np.allclose(file.accessor(last) @ file.world[3][:3, :3].T, 2, atol=1e-5)


def two(folder: Path, at: tuple[float, float, float], other: Any) -> Path:
    both = trimesh.Scene({"body": trimesh.creation.icosphere(1)})
    both.add_geometry(
        other, geom_name="other", node_name="other", transform=trimesh.transformations.translation_matrix(at)
    )
    both.export(folder / "both.glb")
    return folder / "both.glb"


def test_geometries_apart_or_on_a_ground_are_refused_until_some_are_chosen(tmp_path: Path) -> None:
    path = two(tmp_path, (3, 0, 0), trimesh.creation.box())
    with pytest.raises(MeshError, match=r"'body', 'other', which .* \(apart: 'other'\). Choose with --source-geom"):
        read_mesh_file(path)
    with pytest.raises(MeshError, match="no geometry 'shoe'; it has 'body', 'other'"):
        read_mesh_file(path, geometries=["body", "shoe"])
    assert geometry_names(path) == ("body", "other")
    read = read_mesh_file(path, geometries=["other"])
    assert len(read.mesh.faces) == 12 and read.name == "other"
    assert write_posed(read, read.mesh.vertices, tmp_path / "box.glb").left_out == ["other geometries: body"]
    assert read_mesh_file(tmp_path / "box.glb").name == "other"
    assert read_mesh_file(path, geometries=["other", "body"]).geometries == ("body", "other")  # in the file's order
    assert read_mesh_file(two(tmp_path, (1.6, 0, 0), trimesh.creation.box())).geometries == ("body", "other")
    for ground in ((9, 0, 9), (4, 0.02, 4), (2.5, 0.05, 2.5)):
        with pytest.raises(MeshError, match="flat and larger than the others: 'other'"):
            read_mesh_file(two(tmp_path, (0, -1, 0), trimesh.creation.box(ground)))
    with pytest.raises(MeshError, match="flat and larger"):
        read_mesh_file(two(tmp_path, (0, -0.98, 0), trimesh.creation.box((4, 0.05, 4))))
    for worn in ((0.03, 3, 0.03), (0.002, 3, 0.002), (3, 2.5, 0.08)):
        staff_or_wings = read_mesh_file(two(tmp_path, (0, 0, 0.5), trimesh.creation.box(worn)))
        assert staff_or_wings.geometries == ("body", "other")


def test_too_many_geometries_are_refused_before_any_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = scene()
    document.json |= {"nodes": [{"mesh": 0}] * 1001, "scenes": [{"nodes": list(range(1001))}]}
    monkeypatch.setattr(glb, "GlbContent", lambda *_: pytest.fail("it was read"))
    with pytest.raises(MeshError, match=r"holds 1,001 geometries: .* and 989 more. Choose with --source-geometry"):
        read_mesh_file(saved(document, tmp_path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nodes": []}, "no faces"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "without compression"),
        ({"nodes": [{"mesh": 0, "scale": [0, 0, 0]}]}, "scaled to nothing"),
        ({"nodes": [{"mesh": 7}]}, "cannot be read as GLB"),
        ({"accessors": []}, "cannot be read|damaged"),
    ],
)
def test_scenes_that_cannot_be_posed(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    document = scene()
    document.json |= change
    with pytest.raises(MeshError, match=message) as caught:
        read_mesh_file(saved(document, tmp_path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("uri", "kept"), [("skin.png", True), ("../secret.png", False), ("{}/secret.png", False)])
def test_a_texture_beside_goes_into_the_file_but_none_from_elsewhere(tmp_path: Path, uri: str, kept: bool) -> None:
    document = scene()
    document.json["images"] = [{"uri": uri.format(tmp_path)}]
    (tmp_path / "secret.png").write_bytes(PNG + b"elsewhere")
    read = read_mesh_file(saved(document, tmp_path / "mine"))
    (tmp_path / "mine" / "skin.png").write_bytes(PNG + b"beside")
    write_posed(read, read.mesh.vertices, tmp_path / "out.glb")
    content = (tmp_path / "out.glb").read_bytes()
    assert (PNG + b"beside" in content) == kept and b"elsewhere" not in content


def test_points_alone_are_no_mesh(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="no faces"):
        read_mesh_file(saved(scene(mode=0), tmp_path))


def test_a_face_that_names_no_vertex(tmp_path: Path) -> None:
    document = scene()
    document.json["meshes"][0]["primitives"][0]["indices"] = document.accessor([0, 1, 9], "uint16")
    with pytest.raises(MeshError, match="names vertex 9, but there are 4"):
        read_mesh_file(saved(document, tmp_path))


def test_properties_of_materials_that_an_obj_cannot_hold_are_named(tmp_path: Path) -> None:
    read = read_mesh_file(saved(scene(), tmp_path))
    notes = write_posed(read, read.mesh.vertices, tmp_path / "out.obj").left_out
    assert notes == ["material properties beyond base colour and its texture"]
