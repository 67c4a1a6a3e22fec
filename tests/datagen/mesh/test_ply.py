"""PLY, OFF and STL files of a person: what is in them stays."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.common.errors import MeshError
from datagen.mesh.files import read_mesh_file, write_posed

HEADER = """ply
format {} 1.0
comment TextureFile skin.png
element camera 1
property float focal
element vertex 5
property double x
property double y
property double z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
property float s
property float t
property int label
element face 3
property list uchar int vertex_indices
property uchar flag
element tail 1
property list uchar short numbers
end_header
"""
POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
POLYGONS = [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4]]
VERTEX = [("p", "f8", 3), ("n", "f4", 3), ("c", "u1", 3), ("uv", "f4", 2), ("label", "i4")]


def text_file() -> bytes:
    rows = ["35.5"]
    rows += [f"{x:g} {y:g} {z:g} 0 0 {n} 10 20 {n} {x:g} {y:g} {7 * n}" for n, (x, y, z) in enumerate(POINTS)]
    rows += [" ".join(map(str, [len(each), *each, 100 + n])) for n, each in enumerate(POLYGONS)]
    return (HEADER.format("ascii") + "\n".join([*rows, "3 1 2 3"]) + "\n").encode()


def binary_file(order: str) -> bytes:
    table = np.zeros(5, np.dtype([(name, order + kind, *size) for name, kind, *size in VERTEX]))
    table["p"], table["c"], table["uv"], table["label"] = POINTS, (10, 20, 30), POINTS[:, :2], np.arange(5) * 7
    table["n"][:, 2] = np.arange(5)
    faces = b"".join(
        bytes([len(each)]) + np.array(each, order + "i4").tobytes() + bytes([100 + n])
        for n, each in enumerate(POLYGONS)
    )
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    tail = bytes([3]) + np.array([1, 2, 3], order + "i2").tobytes()
    return HEADER.format(form).encode() + np.array([35.5], order + "f4").tobytes() + table.tobytes() + faces + tail


@pytest.mark.parametrize("content", [text_file(), binary_file("<"), binary_file(">")], ids=["text", "little", "big"])
def test_all_but_positions_and_normals_of_a_ply_file_stays(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    (tmp_path / "skin.png").write_bytes(b"\x89PNG of nothing")
    read = read_mesh_file(tmp_path / "a.ply")
    assert np.array_equal(read.mesh.vertices, POINTS) and read.mesh.faces[:2].tolist() == [[3, 2, 1], [3, 1, 0]]
    assert read.content.only_here == ["element camera", "vertex property label", "face property flag", "element tail"]
    moved = POINTS * (1, 2, 4) + 0.125
    assert write_posed(read, moved, tmp_path / "new" / "b.ply") == []
    written = (tmp_path / "new" / "b.ply").read_bytes()
    assert (tmp_path / "new" / "skin.png").read_bytes() == b"\x89PNG of nothing"
    again = read_mesh_file(tmp_path / "new" / "b.ply")
    assert np.array_equal(again.mesh.vertices, moved) and np.array_equal(again.mesh.faces, read.mesh.faces)
    before, after = read.content.surface, again.content.surface
    assert np.array_equal(after.sizes, [4, 3, 3]) and np.array_equal(after.colours, before.colours)
    assert np.array_equal(after.uvs, before.uvs)
    write_posed(again, POINTS, tmp_path / "back.ply")
    if b"ascii" in content:
        kept = [line.split() for line in written.splitlines()]
        assert [row[6:] for row in kept if len(row) == 12] == [r.split()[6:] for r in text_file().splitlines()[-9:-4]]
        assert kept[-4:] == [line.split() for line in text_file().splitlines()[-4:]]
        assert kept[:24] == [line.split() for line in text_file().splitlines()[:24]]
    else:
        assert len(written) == len(content) and written[-20:] == content[-20:]
        assert written[: len(content) - 5 * 57 - 60] == content[: len(content) - 5 * 57 - 60]


def test_normals_of_a_ply_file_follow_the_pose(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3)
    (tmp_path / "ball.ply").write_bytes(trimesh.exchange.ply.export_ply(ball, vertex_normal=True))
    read = read_mesh_file(tmp_path / "ball.ply")
    write_posed(read, read.mesh.vertices * (1, 1, 4), tmp_path / "out.ply")
    table = trimesh.load(tmp_path / "out.ply", process=False)
    expected = ball.vertices * (1, 1, 1 / 4)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.allclose(table.metadata["_ply_raw"]["vertex"]["data"]["nz"], expected[:, 2], atol=0.06)


def test_texture_coordinates_of_corners_and_colours_reach_other_formats(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(binary_file("<"))
    read = read_mesh_file(tmp_path / "a.ply")
    for name in ("b.glb", "b.obj"):
        write_posed(read, read.mesh.vertices, tmp_path / name)
        other = read_mesh_file(tmp_path / name)
        write_posed(other, other.mesh.vertices, tmp_path / "c.ply")
        again = read_mesh_file(tmp_path / "c.ply").content.surface
        assert again.uvs is not None and again.colours is not None and read.content.surface.uvs is not None
        triangles = again.triangle_corners.ravel()
        assert np.allclose(
            again.uvs[triangles], read.content.surface.uvs[read.content.surface.triangle_corners.ravel()]
        )
        assert np.array_equal(again.colours[:, :3], [[10, 20, 30]] * len(again.colours))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("double x", "int x"), "x, y and z of type float"),
        (("ascii", "utf-7"), "its format is 'utf-7'"),
        (("vertex_indices", "corners"), "no faces"),
        (("0.5 0.5 1 ", "0.5 half 1 "), "cannot be read as PLY"),
        (("3 1 2 4 ", "9 1 2 4 "), "shorter than it says"),
        (("3 1 2 4 ", "3 1 2 8 "), "names vertex 8"),
    ],
)
def test_broken_ply_files(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    (tmp_path / "a.ply").write_bytes(text_file().replace(change[0].encode(), change[1].encode()))
    with pytest.raises(MeshError, match=message):
        read_mesh_file(tmp_path / "a.ply")


def test_colours_quads_comments_and_normals_of_an_off_file(tmp_path: Path) -> None:
    rows = [f"{x:g} {y:g} {z:g} 1 0 0 10 20 30 255 # {n}" for n, (x, y, z) in enumerate(POINTS)]
    faces = [" ".join(map(str, [len(each), *each])) + " 0.5 0.5 0.5" for each in POLYGONS]
    (tmp_path / "a.off").write_text("\n".join(["CNOFF", "# mine", "5 3 0", *rows, "", *faces]) + "\n")
    read = read_mesh_file(tmp_path / "a.off")
    assert np.array_equal(read.mesh.vertices, POINTS) and len(read.mesh.faces) == 4
    assert write_posed(read, POINTS * (1, 1, -1), tmp_path / "b.off") == []
    written = (tmp_path / "b.off").read_text().splitlines()
    assert written[:3] == ["CNOFF", "# mine", "5 3 0"] and written[-3:] == faces
    assert all(line.endswith(" 10 20 30 255") for line in written[3:8])
    assert written[6].split()[3:6] == ["0", "0", "-1"]  # a corner of the base alone; the file said 1 0 0
    assert "face colours" in write_posed(read, POINTS, tmp_path / "b.ply")


def test_counts_on_the_first_line_of_an_off_file(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text("OFF 4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n3 0 2 3\n3 1 2 3\n")
    assert read_mesh_file(tmp_path / "a.off").mesh.faces.tolist() == [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]


@pytest.mark.parametrize("form", ["stl", "stl_ascii"])
def test_an_stl_file_is_welded_and_written_as_it_was(tmp_path: Path, form: str) -> None:
    box = trimesh.creation.box()
    box.export(tmp_path / "box.stl", file_type=form)
    read = read_mesh_file(tmp_path / "box.stl")
    assert read.mesh.vertices.shape == (8, 3)
    assert np.allclose(read.mesh.vertices[read.mesh.faces], box.triangles)
    write_posed(read, read.mesh.vertices * (1, 2, 3), tmp_path / "out.stl")
    loaded = trimesh.load(tmp_path / "out.stl", process=False)
    assert np.allclose(loaded.triangles, box.triangles * (1, 2, 3), atol=1e-6)
    assert (tmp_path / "out.stl").read_bytes().startswith(b"solid") == (form == "stl_ascii")
