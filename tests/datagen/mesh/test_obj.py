"""OBJ files of a person: the text stays, positions and normals change."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.common.errors import MeshError, NotOneBodyError
from datagen.mesh.files import geometry_names, read_mesh_file, write_posed
from datagen.mesh.formats.obj import ObjContent, face_lines, vertex_lines
from tests.support.shapes.mesh_files import GOLDEN, PNG, golden

CUBE, LOOK = ((GOLDEN / name).read_bytes() for name in ("cube.obj", "look.mtl"))


def lines_of(content: bytes, *starts: bytes) -> list[bytes]:
    return [line for line in content.splitlines() if line.split(b" ")[0] in starts]


def test_all_but_positions_and_normals_stays_as_it_is(tmp_path: Path) -> None:
    read = read_mesh_file(golden("cube.obj", tmp_path))
    moved = read.mesh.vertices * (1, 2, 3) + 0.123456789
    assert write_posed(read, moved, tmp_path / "posed.obj").left_out == []
    written = (tmp_path / "posed.obj").read_bytes()
    kept = (b"#", b"mtllib", b"o", b"vt", b"g", b"usemtl", b"s")
    assert lines_of(written, *kept) == lines_of(CUBE, *kept)
    assert [line.split()[4:] for line in lines_of(written, b"v")] == [[b"0.1", b"0.2", b"0.3"]] * 8
    again = read_mesh_file(tmp_path / "posed.obj")
    assert np.allclose(again.mesh.vertices, moved, atol=1e-8)
    assert np.array_equal(again.mesh.faces, read.mesh.faces)
    corners = [[corner.split(b"/")[:2] for corner in line.split()[1:5]] for line in lines_of(written, b"f")]
    assert corners == [[corner.split(b"/")[:2] for corner in line.split()[1:5]] for line in lines_of(CUBE, b"f")]


def test_a_hard_edge_stays_hard_and_normals_follow_the_pose(tmp_path: Path) -> None:
    """A cube sheared along x has other sides; the six normals of its file are shared by four vertices each."""
    read = read_mesh_file(golden("cube.obj", tmp_path))
    sheared = read.mesh.vertices + read.mesh.vertices[:, [1, 0, 0]] * (1, 0, 0)
    write_posed(read, sheared, tmp_path / "posed.obj")
    loaded = trimesh.load(tmp_path / "posed.obj", process=False, maintain_order=True, force="mesh")
    written = np.array([line.split()[1:] for line in lines_of((tmp_path / "posed.obj").read_bytes(), b"vn")], float)
    sides = np.unique(np.round(loaded.face_normals, 5) + 0.0, axis=0)
    assert np.allclose(np.unique(np.round(written, 5) + 0.0, axis=0), sides, atol=1e-4) and len(sides) == 6


def test_normals_of_one_vertex_each_are_written_in_their_place(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2)
    text = "".join("v %f %f %f\n" % tuple(v) for v in ball.vertices)  # noqa: UP031
    text += "vn 1 0 0\n" * len(ball.vertices)
    faces = "".join("f {0}//{0} {1}//{1} {2}//{2}\n".format(*face) for face in ball.faces + 1)
    (tmp_path / "ball.obj").write_text(text + faces)
    read = read_mesh_file(tmp_path / "ball.obj")
    write_posed(read, read.mesh.vertices * 3, tmp_path / "out.obj")
    written = (tmp_path / "out.obj").read_text()
    assert written.endswith(faces)
    normals = np.array([line.split()[1:] for line in written.splitlines() if line.startswith("vn")], float)
    assert np.allclose(normals, ball.vertices, atol=0.05)


def test_faces_without_normals_among_faces_with_them_stay_so(tmp_path: Path) -> None:
    text = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 1 0 0\nf 1//1 2//1 3//1\nf 1 2 4\nf 2 3 4\n"
    (tmp_path / "a.obj").write_bytes(text)
    read = read_mesh_file(tmp_path / "a.obj")
    write_posed(read, read.mesh.vertices * 2, tmp_path / "b.obj")
    written = (tmp_path / "b.obj").read_bytes()
    assert lines_of(written, b"vn") == [b"vn 0.000000 0.000000 1.000000"] * 3
    assert lines_of(written, b"f") == [b"f 1//1 2//2 3//3", b"f 1 2 4", b"f 2 3 4"]


@pytest.mark.parametrize("ending", [b"\r\n", b"\r"])
def test_line_ends_of_other_systems_stay(tmp_path: Path, ending: bytes) -> None:
    path = golden("cube.obj", tmp_path)
    path.write_bytes(CUBE.replace(b"\n", ending))
    read = read_mesh_file(path)
    write_posed(read, read.mesh.vertices, tmp_path / "same.obj")
    written = (tmp_path / "same.obj").read_bytes()
    assert len(written.split(ending)) == len(CUBE.split(b"\n")) - 6 + 24
    assert read_mesh_file(tmp_path / "same.obj").mesh.faces.tolist() == read.mesh.faces.tolist()


def test_materials_and_textures_go_along_to_another_folder_and_spare_what_is_there(tmp_path: Path) -> None:
    read = read_mesh_file(golden("cube.obj", tmp_path / "mine"))
    assert write_posed(read, read.mesh.vertices, tmp_path / "other" / "posed.obj").left_out == []
    assert (tmp_path / "other" / "look.mtl").read_bytes() == LOOK
    assert (tmp_path / "other" / "skin of me.png").read_bytes() == PNG
    (tmp_path / "other" / "look.mtl").write_bytes(b"newmtl anothers\n")
    assert "look.mtl" in write_posed(read, read.mesh.vertices, tmp_path / "other" / "posed.obj").left_out[0]
    assert (tmp_path / "other" / "look.mtl").read_bytes() == b"newmtl anothers\n"


def test_materials_in_a_folder_below_and_those_that_are_not_there(tmp_path: Path) -> None:
    path = golden("cube.obj", tmp_path / "mine")
    (tmp_path / "mine" / "m").mkdir()
    (tmp_path / "mine" / "m" / "look.mtl").write_bytes(LOOK)
    (tmp_path / "mine" / "m" / "skin of me.png").write_bytes(PNG)
    path.write_bytes(CUBE.replace(b"look.mtl", b"m/look.mtl ../up.mtl gone.mtl"))
    read = read_mesh_file(path)
    notes = write_posed(read, read.mesh.vertices, tmp_path / "other" / "posed.obj").left_out
    assert (tmp_path / "other" / "m" / "skin of me.png").read_bytes() == PNG
    assert len(notes) == 2 and "gone.mtl is not beside" in notes[1]
    assert "../up.mtl was not copied: it lies outside of the mesh's folder" in notes[0]


@settings(max_examples=50)
@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=3, max_size=30))
def test_every_float32_comes_back_bit_for_bit(numbers: list[float]) -> None:
    vertices = np.array(numbers[: len(numbers) // 3 * 3], np.float32).reshape(-1, 3)
    faces = np.array([[0, 0, 0]])
    read = ObjContent((vertex_lines(vertices) + face_lines(faces)).encode(), Path("a.obj"))
    assert read.vertices.astype(np.float32).tobytes() == vertices.tobytes()
    assert np.array_equal(read.surface.faces, faces)


def test_faces_count_from_one_in_the_file() -> None:
    assert face_lines(np.array([[0, 1, 2], [2, 1, 3]], np.int32)) == "f 1 2 3\nf 3 2 4\n"


PLAIN = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.mark.parametrize(
    "text",
    [
        "# made by hand\r\nmtllib a.mtl\r\no it\r\ng all\r\nvn 0 0 1\r\n" + PLAIN,
        PLAIN.replace("f 1 2 3", "f 1/1 2/1 3/1\nvt 0 0"),
        PLAIN.replace("f 1 2 3", "f -3 -2 -1"),
        PLAIN.replace("f 1 2 3", "f 1 2 3 # all"),
        PLAIN.replace("f 1 2 3", "f 1 \\\n2 3"),
        PLAIN.replace("v 1 0 0", "v 1 0 0 0.5 0.5 0.5"),
        PLAIN.replace("v 1 0 0", "v\t1 0 0"),
        PLAIN.replace("v 1 0 0", "  v 1 0 0 # here"),
        PLAIN.replace("f 1 2 3", "f 1 2\nf 1 2 3"),
    ],
)
def test_a_triangle_in_other_words_is_the_same_triangle(text: str) -> None:
    read = ObjContent(text.encode(), Path("a.obj"))
    assert read.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]] and read.surface.faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("rows", ["v 0 0\nv 1 0 0 0\n", "v 0 0\nv 1 0 0 nan\n"])
def test_lines_of_other_lengths_are_not_taken_for_regular_ones(rows: str) -> None:
    with pytest.raises(ValueError, match="line 1 is not 3 numbers: 'v 0 0'"):
        ObjContent((rows + PLAIN).encode(), Path("a.obj"))


TWO = b"""mtllib look.mtl
o body
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 0.25 0.75
vn 0 0 1
g torso all
usemtl skin
f 1/1/1 3/2/1 2/3/1
f 1 2 4
g legs all
f -4//-1 -1//-1 -2//-1
f 2 3 4
l 1 2
o tall hat
v 0 1.05 0
v 1 1.05 0
v 0 2 0
v 0 1.05 1
usemtl cloth
g brim
f 5 7 6
f -4/-1 -3/-2 -1/-3
f 5 8 7
f 6 7 8
"""


@pytest.mark.parametrize("face", ["1/- 2 3", "1 2 x", "1.0 2.0 3.0", "99999999999999999999/1 2/1 3/1"])
def test_the_line_of_a_broken_face_is_named(tmp_path: Path, face: str) -> None:
    path = tmp_path / "broken.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 4\nf {face}\n")
    with pytest.raises(MeshError, match="line 6 is no face: 'f "):
        read_mesh_file(path)


def test_objects_that_make_no_body_are_refused_by_name_and_can_be_chosen(tmp_path: Path) -> None:
    path = golden("cube.obj", tmp_path).with_name("apart.obj")
    path.write_bytes(TWO.replace(b" 1.05 ", b" 9.05 ").replace(b"v 0 2 0", b"v 0 10 0"))
    with pytest.raises(NotOneBodyError, match=r"'body', 'tall hat', which do not make one body \(apart: 'tall hat'\)"):
        read_mesh_file(path, is_body=True)
    assert len(read_mesh_file(path).mesh.vertices) == 8, "of what is no body, as armour, all is one mesh"
    assert geometry_names(path) == ("body", "tall hat") and len(read_mesh_file(path, geometries=["body"]).mesh.faces)


@pytest.mark.parametrize("line_end", [b"\n", b"\r\n"])
def test_groups_and_objects_are_chosen_with_what_they_need(tmp_path: Path, line_end: bytes) -> None:
    path = golden("cube.obj", tmp_path).with_name("two.obj")
    path.write_bytes(TWO.replace(b"\n", line_end))
    whole = read_mesh_file(path)
    assert geometry_names(path) == ("body", "tall hat")
    assert geometry_names(golden("cube.obj", tmp_path)) == ("sides", "rest")  # of one object
    for wanted, faces, rows in (
        (["tall hat"], slice(4, 8), range(4, 8)),
        (["brim"], slice(4, 8), range(4, 8)),
        (["all"], slice(0, 4), range(4)),
        (["legs", "brim"], slice(2, 8), range(8)),
    ):
        read = read_mesh_file(path, geometries=wanted)
        assert np.array_equal(read.mesh.vertices, whole.mesh.vertices[list(rows)])
        triangles = read.mesh.vertices[read.mesh.faces]
        assert np.array_equal(triangles, whole.mesh.vertices[whole.mesh.faces[faces]])
    hat = read_mesh_file(path, geometries=["tall hat"])
    assert [each.name for each in hat.content.surface.materials] == ["cloth"] and hat.name == "tall hat"
    assert hat.content.surface.uvs is not None
    assert hat.content.surface.uvs[3:6].tolist() == [[0.25, 0.75], [1, 0], [0, 0]]
    left_out = write_posed(hat, hat.mesh.vertices * 2, tmp_path / "hat.obj").left_out
    assert left_out == ["other objects and groups: body, torso, all, legs"]
    assert lines_of((tmp_path / "hat.obj").read_bytes(), b"o", b"g", b"l") == [b"o tall hat", b"g brim"]
    assert np.allclose(read_mesh_file(tmp_path / "hat.obj").mesh.vertices, hat.mesh.vertices * 2)
    with pytest.raises(MeshError, match="no object or group 'shoe'; it has 'body', 'tall hat', 'torso', 'all', 'legs'"):
        read_mesh_file(path, geometries=["shoe"])
