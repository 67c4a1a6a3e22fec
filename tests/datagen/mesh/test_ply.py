"""PLY, OFF and STL files of a person: what is in them stays."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.common.errors import MeshError
from datagen.mesh.files import read_mesh_file, write_posed
from tests.support.shapes.mesh_files import GOLDEN, PNG, golden

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
POLYGONS = [[3, 2, 1, 0], [0, 1, 4], [1, 2, 4]]


@pytest.mark.parametrize("name", ["rich.ply", "rich-little.ply", "rich-big.ply"])
def test_all_but_positions_and_normals_of_a_ply_file_stays(tmp_path: Path, name: str) -> None:
    content = golden(name, tmp_path).read_bytes()
    read = read_mesh_file(tmp_path / name)
    moved = POINTS * (1, 2, 4) + 0.125
    assert write_posed(read, moved, tmp_path / "new" / "b.ply").left_out == []
    written = (tmp_path / "new" / "b.ply").read_bytes()
    assert (tmp_path / "new" / "skin of me.png").read_bytes() == PNG
    again = read_mesh_file(tmp_path / "new" / "b.ply")
    assert np.array_equal(again.mesh.vertices, moved) and np.array_equal(again.mesh.faces, read.mesh.faces)
    before, after = read.content.surface, again.content.surface
    assert np.array_equal(after.sizes, [4, 3, 3]) and np.array_equal(after.colours, before.colours)
    assert np.array_equal(after.uvs, before.uvs)
    write_posed(again, POINTS, tmp_path / "back.ply")
    if b"ascii" in content:
        kept, before_it = ([line.split() for line in each.splitlines()] for each in (written, content))
        assert [row[6:] for row in kept if len(row) == 12] == [row[6:] for row in before_it[-9:-4]]
        assert kept[-4:] == before_it[-4:] and kept[:24] == before_it[:24]
    else:
        assert len(written) == len(content) and written[-20:] == content[-20:]
        assert written[: len(content) - 5 * 57 - 60] == content[: len(content) - 5 * 57 - 60]


@pytest.mark.parametrize("name", ["rich.ply", "rich-little.ply", "rich-big.ply"])
def test_a_ply_file_that_is_cut_off_says_so_wherever_it_ends(tmp_path: Path, name: str) -> None:
    content = golden(name, tmp_path).read_bytes()
    for end in range(3, len(content.rstrip()) - 2):  # a number of a text may lose its last letter
        (tmp_path / "cut.ply").write_bytes(content[:end])
        with pytest.raises(MeshError, match=r"(ends before its|has no end|fewer than|shorter than|to its end)"):
            read_mesh_file(tmp_path / "cut.ply")


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
    read = read_mesh_file(GOLDEN / "rich-little.ply")
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


def test_colours_quads_comments_and_normals_of_an_off_file(tmp_path: Path) -> None:
    read = read_mesh_file(GOLDEN / "rich.off")
    faces = (GOLDEN / "rich.off").read_text().splitlines()[-3:]
    assert write_posed(read, POINTS * (1, 1, -1), tmp_path / "b.off").left_out == []
    written = (tmp_path / "b.off").read_text().splitlines()
    assert written[:3] == ["CNOFF", "# mine", "5 3 0"] and written[-3:] == faces
    assert all(line.endswith(" 10 20 30 255") for line in written[3:8])
    assert written[6].split()[3:6] == ["0", "0", "-1"]  # a corner of the base alone; the file said 1 0 0
    assert "face colours" in write_posed(read, POINTS, tmp_path / "b.ply").left_out


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
