"""The glTF reader: buffers, accessors, nodes, faces and keyframes."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.characters.animation import Track, read_clips, world_frames
from datagen.characters.character import load_character
from datagen.common.errors import BodyError
from datagen.mesh.formats.gltf import Gltf, triangles
from tests.support.shapes.rigged_files import Document, Rig, about

NUMBERS = np.arange(12, dtype=np.float32).reshape(4, 3)


def written(document: Document, folder: Path, **options: Any) -> Gltf:
    return Gltf(document.save(folder / "file.gltf", **options))


@pytest.mark.parametrize(("name", "buffer"), [("a.glb", ""), ("a.gltf", "beside"), ("a.gltf", "inside")])
def test_a_buffer_is_found_wherever_it_lies(tmp_path: Path, name: str, buffer: str) -> None:
    document = Document()
    number = document.accessor(NUMBERS)
    file = Gltf(document.save(tmp_path / name, buffer=buffer))
    assert np.array_equal(file.accessor(number), NUMBERS)
    assert len(file.files) == (2 if buffer == "beside" else 1) and all(each.exists() for each in file.files)


def test_interleaved_attributes(tmp_path: Path) -> None:
    document = Document()
    view = document.view(np.concatenate([NUMBERS, -NUMBERS], axis=1).tobytes(), byteStride=24)
    described = {"bufferView": view, "componentType": 5126, "count": 4, "type": "VEC3"}
    document.json["accessors"] = [described, described | {"byteOffset": 12}]
    file = written(document, tmp_path)
    assert np.array_equal(file.accessor(0), NUMBERS) and np.array_equal(file.accessor(1), -NUMBERS)


@pytest.mark.parametrize("dense", [True, False])
def test_sparse_accessors(tmp_path: Path, dense: bool) -> None:
    document = Document()
    number = document.accessor(NUMBERS)
    places = document.view(np.array([1, 3], np.uint8).tobytes())
    values = document.view(np.array([[7] * 3, [8] * 3], np.float32).tobytes())
    accessor = document.json["accessors"][number]
    accessor["sparse"] = {
        "count": 2,
        "indices": {"bufferView": places, "componentType": 5121},
        "values": {"bufferView": values},
    }
    if not dense:
        del accessor["bufferView"]
    expected = NUMBERS.copy() if dense else np.zeros_like(NUMBERS)
    expected[[1, 3]] = [[7] * 3, [8] * 3]
    assert np.array_equal(written(document, tmp_path).accessor(number), expected)


@pytest.mark.parametrize(
    ("kind", "stored", "meant"),
    [
        ("uint8", [0, 255], [0, 1]),
        ("uint16", [0, 65535], [0, 1]),
        ("int8", [-128, 127], [-1, 1]),
        ("int16", [0, 32767], [0, 1]),
    ],
)
def test_normalised_integers(tmp_path: Path, kind: str, stored: list[int], meant: list[float]) -> None:
    document = Document()
    number = document.accessor(stored, kind, normalized=True)
    assert written(document, tmp_path).accessor(number).ravel().tolist() == meant


def test_nodes_are_placed_by_their_parents(tmp_path: Path) -> None:
    turn = about("z", 90)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn, [1, 0, 0]
    document = Document()
    document.json["nodes"] = [
        {"translation": [0, 1, 0], "rotation": Rotation.from_matrix(turn).as_quat().tolist(), "scale": [3, 3, 3]},
        {"children": [0], "matrix": matrix.T.ravel().tolist()},
    ]
    file = written(document, tmp_path)
    expected = matrix.copy()
    expected[:3, 3] = [1 - 2, 0, 0]
    expected[:3, :3] = 6 * turn @ turn
    assert file.parents == [1, -1] and file.order == [1, 0]
    assert np.allclose(file.world, [expected, matrix]) and np.allclose(file.scales, [[3] * 3, [2] * 3])


def test_strips_and_fans_are_wound_like_lists() -> None:
    corners = np.array([0, 1, 2, 3, 4])
    assert triangles(corners, 5).tolist() == [[0, 1, 2], [3, 2, 1], [2, 3, 4]]
    assert triangles(corners, 6).tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    assert triangles(np.arange(7), 4).tolist() == [[0, 1, 2], [3, 4, 5]]


def broken(tmp_path: Path, what: str) -> Path:
    path = Rig().save(tmp_path / "person.glb")
    content = path.read_bytes()
    if what == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif what == "no glTF":
        path.write_bytes(b"hello")
    elif what == "version 1":
        path.write_bytes(content.replace(b'"version": "2.0"', b'"version": "1.0"'))
    else:
        path.unlink()
    return path


@pytest.mark.parametrize("what", ["truncated", "no glTF", "version 1", "missing"])
def test_a_file_that_cannot_be_read_says_so(tmp_path: Path, what: str) -> None:
    with pytest.raises(BodyError, match=r"person\.glb"):
        Gltf(broken(tmp_path, what))


def test_an_accessor_beyond_its_buffer_view(tmp_path: Path) -> None:
    document = Document()
    document.accessor(NUMBERS)
    document.json["accessors"][0]["count"] = 5
    with pytest.raises(BodyError, match="accessor 0"):
        written(document, tmp_path).accessor(0)


def test_a_missing_buffer_file_is_named(tmp_path: Path) -> None:
    file = written(Rig().document(), tmp_path)
    (tmp_path / "file data.bin").unlink()
    with pytest.raises(BodyError, match=r"file data\.bin.*No such file"):
        file.accessor(0)


def test_a_buffer_outside_of_the_folder_is_refused(tmp_path: Path) -> None:
    path = Rig().save(tmp_path / "in" / "file.gltf")
    content = json.loads(path.read_text())
    content["buffers"][0]["uri"] = "../../secret.bin"
    path.write_text(json.dumps(content))
    with pytest.raises(BodyError, match=r"outside of its folder: \.\./\.\./secret\.bin"):
        Gltf(path).accessor(0)


def _changed(path: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


def _hips(content: dict[str, Any]) -> int:
    return next(number for number, node in enumerate(content["nodes"]) if node.get("name") == "Hips")


HOSTILE: dict[str, Callable[[dict[str, Any]], Any]] = {
    "nodes are numbers": lambda file: file.update(nodes=[1]),
    "nodes are text": lambda file: file.update(nodes="abc"),
    "a buffer's name is a number": lambda file: file["buffers"][0].update(uri=5),
    "channels are a number": lambda file: file["animations"][0].update(channels=7),
    "animations are numbers": lambda file: file.update(animations=[1]),
    "a channel turns no node": lambda file: file["animations"][0]["channels"][0]["target"].update(node=99),
    "an extension is a number": lambda file: file.update(extensionsRequired=7),
    "a cycle below a root": lambda file: file["nodes"][-1].update(children=[_hips(file)]),
    "a cycle without a root": lambda file: file["nodes"].extend([{"children": [len(file["nodes"])]}]),
    "a child that is none": lambda file: file["nodes"][-1].update(children=[-1]),
    "1e12 elements": lambda file: [each.update(count=10**12) for each in file["accessors"]],
    "1e10 elements nowhere": lambda file: file["accessors"].__setitem__(
        0, {"componentType": 5126, "type": "VEC3", "count": 10**10}
    ),
    "1e12 elements in one place": lambda file: [
        file["accessors"][0].update(count=10**12),
        file["bufferViews"][file["accessors"][0]["bufferView"]].update(byteStride=0),
    ],
}


@pytest.mark.parametrize("how", sorted(HOSTILE))
def test_what_is_not_as_specified_is_one_error_that_names_the_file(tmp_path: Path, how: str) -> None:
    rig = Rig()
    rig.clips["Nod"] = {"Neck": rig.keys("Neck", [np.eye(3)] * 2, [0.0, 1.0])}
    path = _changed(rig.save(tmp_path / "person.gltf"), HOSTILE[how])
    with pytest.raises(BodyError, match=r"person\.gltf .*damaged|person\.gltf is not a sound glTF"):
        found = load_character(path)
        assert found.clips and found.assets


def test_compression_is_refused_by_name(tmp_path: Path) -> None:
    document = Document()
    document.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    with pytest.raises(BodyError, match="KHR_draco_mesh_compression"):
        written(document, tmp_path)


class TestTracks:
    """Rotations between keys."""

    turns = Rotation.from_euler("x", [[0], [90], [90]], degrees=True).as_quat()
    times = np.array([1.0, 2.0, 3.0])

    def degrees(self, track: Track, time: float) -> float:
        return float(Rotation.from_quat(track.at(time)).as_euler("xyz", degrees=True)[0])

    @pytest.mark.parametrize(("time", "expected"), [(0, 0), (1, 0), (1.25, 22.5), (2, 90), (2.5, 90), (3, 90), (9, 90)])
    def test_linear_is_of_even_speed(self, time: float, expected: float) -> None:
        assert self.degrees(Track(self.times, self.turns, "LINEAR"), time) == pytest.approx(expected, abs=1e-6)

    def test_the_shorter_way_is_taken(self) -> None:
        track = Track(self.times, self.turns * np.array([[1], [-1], [1]]), "LINEAR")
        assert self.degrees(track, 1.5) == pytest.approx(45)

    def test_step_holds(self) -> None:
        track = Track(self.times, self.turns, "STEP")
        assert [self.degrees(track, time) for time in (1.99, 2.0)] == pytest.approx([0, 90])

    def test_cubic_follows_its_tangents(self) -> None:
        """Tangents of the straight line between two keys give that line (renormalised); none give an ease."""
        keys = np.zeros((3, 3, 4))
        keys[:, 1] = self.turns
        eased = Track(self.times, keys, "CUBICSPLINE")
        assert self.degrees(eased, 1.0) == pytest.approx(0) and self.degrees(eased, 1.5) == pytest.approx(45)
        assert self.degrees(eased, 1.1) < 5
        straight = keys.copy()
        straight[0, 2] = straight[1, 0] = self.turns[1] - self.turns[0]
        line = 0.75 * self.turns[0] + 0.25 * self.turns[1]
        assert np.allclose(Track(self.times, straight, "CUBICSPLINE").at(1.25), line / np.linalg.norm(line))

    def test_a_clip_turns_what_hangs_on_its_nodes(self, tmp_path: Path) -> None:
        rig = Rig(armature=about("y", 30))
        rig.clips["Nod"] = {"Neck": rig.keys("Neck", [np.eye(3), about("x", 60)], [0.0, 2.0])}
        file = Gltf(rig.save(tmp_path / "person.glb"))
        clip = read_clips(file)["Nod"]
        names = [node["name"] for node in file.nodes]
        nodes = [names.index(name) for name in ("Spine", "Neck", "Head")]
        before, after = (world_frames(file, clip, time, nodes) for time in (0.0, 1.0))
        assert (clip.start, clip.end) == (0.0, 2.0) and np.allclose(before, file.world[nodes, :3, :3])
        parent = file.world[names.index("Spine"), :3, :3]
        turned = parent @ about("x", 30) @ parent.T
        assert np.allclose(after, [before[0], turned @ before[1], turned @ before[2]])

    def test_keys_that_go_back_in_time_are_damage(self, tmp_path: Path) -> None:
        rig = Rig()
        rig.clips["Nod"] = {"Neck": rig.keys("Neck", [np.eye(3)] * 2, [1.0, 0.5])}
        with pytest.raises(BodyError, match="keyframes are damaged"):
            read_clips(Gltf(rig.save(tmp_path / "person.glb")))
