"""A person's mesh files across formats, and every way in which they can be wrong."""

import errno
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from datagen.common.errors import MeshError, StorageError
from datagen.mesh import limits as mesh_limits
from datagen.mesh.files import MeshFile, check_writable, load_mesh, read_mesh_file, save_mesh, write_posed
from datagen.mesh.formats import FORMATS
from datagen.mesh.geometry import Mesh
from tests.support.shapes.mesh_files import PNG, golden

TETRAHEDRON = Mesh(
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
)


def saved(folder: Path, suffix: str, mesh: Mesh = TETRAHEDRON) -> MeshFile:
    save_mesh(mesh, folder / f"mesh{suffix}")
    return read_mesh_file(folder / f"mesh{suffix}")


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("other", FORMATS)
def test_every_format_becomes_every_other_with_its_vertices_in_order(tmp_path: Path, suffix: str, other: str) -> None:
    read = saved(tmp_path, suffix)
    moved = read.mesh.vertices[:, [1, 2, 0]] * 2 - 5
    write_posed(read, moved, tmp_path / f"out{other}")
    again = read_mesh_file(tmp_path / f"out{other}")
    assert np.allclose(again.mesh.vertices[again.mesh.faces], moved[read.mesh.faces], atol=1e-6)
    if other != ".stl":
        assert np.array_equal(again.mesh.faces, read.mesh.faces) and np.allclose(again.mesh.vertices, moved, atol=1e-6)
    loaded = trimesh.load(tmp_path / f"out{other}", process=False, force="mesh")
    assert np.allclose(loaded.triangles, moved[read.mesh.faces], atol=1e-6)


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from(sorted(set(FORMATS) - {".stl"})))
def test_any_triangles_come_back_as_they_were(tmp_path_factory: pytest.TempPathFactory, seed: int, suffix: str) -> None:
    generator = np.random.default_rng(seed)
    vertices = generator.normal(size=(generator.integers(4, 30), 3)).astype(np.float32).astype(float)
    body = [[0, 1, 2], [0, 2, 3]]  # some of the others are in no face
    faces = np.concatenate([body, generator.integers(0, len(vertices), (generator.integers(1, 40), 3))])
    read = saved(tmp_path_factory.mktemp("any"), suffix, Mesh(vertices, faces))
    assert np.allclose(read.mesh.vertices, vertices, rtol=1e-6, atol=1e-7) and np.array_equal(read.mesh.faces, faces)
    out = read.path.with_name(f"out{suffix}")
    write_posed(read, read.mesh.vertices, out)
    assert np.allclose(read_mesh_file(out).mesh.vertices, read.mesh.vertices, rtol=1e-7)
    assert np.array_equal(read_mesh_file(out).mesh.faces, faces)


def test_obj_to_glb_keeps_uvs_materials_texture_colours_and_says_what_changes(tmp_path: Path) -> None:
    read = read_mesh_file(golden("cube.obj", tmp_path))
    notes = write_posed(read, read.mesh.vertices, tmp_path / "cube.glb").left_out
    assert "quads: written as triangles" in notes and "groups" in notes and "smoothing groups" in notes
    assert any(note.startswith("seams: 16 vertices") for note in notes)  # three sides meet in each of eight corners
    again = read_mesh_file(tmp_path / "cube.glb")
    assert again.name == "person"
    assert np.array_equal(again.mesh.vertices[:8], read.mesh.vertices)
    before, after = read.content.surface, again.content.surface
    assert [material.name for material in after.materials] == ["skin", "cloth"]
    assert after.materials[0].image is not None and after.materials[0].image.content == PNG
    assert after.materials[0].colour == (1.0, 0.5, 0.25, 1.0) and after.materials[1].colour == (0.0, 0.0, 1.0, 0.5)
    assert before.uvs is not None and after.uvs is not None and after.colours is not None
    skin = before.triangle_corners[before.material_of[before.polygon_of_face] == 0].ravel()  # type: ignore[index]
    assert np.allclose(after.uvs[: len(skin)], before.uvs[skin], atol=1e-6)
    assert np.array_equal(after.colours[:, :3], np.tile([26, 51, 76], (24, 1)))


def test_glb_to_obj_and_back_keeps_uvs_materials_and_texture(tmp_path: Path) -> None:
    original = read_mesh_file(golden("cube.obj", tmp_path))
    write_posed(original, original.mesh.vertices, tmp_path / "cube.glb")
    read = read_mesh_file(tmp_path / "cube.glb")
    assert write_posed(read, read.mesh.vertices, tmp_path / "new" / "cube.obj").left_out == []
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["cube-0.png", "cube.mtl", "cube.obj"]
    again = read_mesh_file(tmp_path / "new" / "cube.obj").content.surface
    before = read.content.surface
    assert again.materials[0].image is not None and again.materials[0].image.content == PNG
    assert [each.colour for each in again.materials] == [each.colour for each in before.materials]
    assert np.allclose(again.uvs, before.uvs, atol=1e-6) and np.array_equal(again.material_of, before.material_of)
    loaded = trimesh.load_scene(tmp_path / "new" / "cube.obj", process=False)
    assert len(loaded.geometry) == 2  # trimesh splits by material


def test_what_off_and_stl_cannot_hold_is_named(tmp_path: Path) -> None:
    read = read_mesh_file(golden("cube.obj", tmp_path))
    notes = write_posed(read, read.mesh.vertices, tmp_path / "cube.stl").left_out
    assert {"texture coordinates", "materials", "colours", "quads: written as triangles"} <= set(notes)
    notes = write_posed(read, read.mesh.vertices, tmp_path / "cube.off").left_out
    assert {"texture coordinates", "materials"} <= set(notes) and "quads: written as triangles" not in notes
    assert b"\n4 3 2 1 0\n" in (tmp_path / "cube.off").read_bytes()


def test_missing_files_and_folders_as_files(tmp_path: Path) -> None:
    saved(tmp_path, ".obj")
    for name in ("mes.obj", "mesh.ply"):
        with pytest.raises(MeshError, match=rf"no mesh file at .*/{name}, did you mean .*/mesh\.obj\?"):
            read_mesh_file(tmp_path / name)
    for name in ("a.obj", "no/where/mesh.obj"):
        with pytest.raises(MeshError, match=rf"no mesh file at .*{name}$"):
            read_mesh_file(tmp_path / name)
    (tmp_path / "hero.fbx").write_bytes(b"Kaydara FBX Binary")
    with pytest.raises(MeshError, match=r"'\.fbx'; known are .* Export it as GLB \(in Blender: File > Export > glTF"):
        read_mesh_file(tmp_path / "hero.fbx")
    with pytest.raises(MeshError, match="no mesh file at"):
        read_mesh_file(tmp_path / "none.obj")
    with pytest.raises(MeshError, match="is a folder"):
        read_mesh_file(tmp_path)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_cut_anywhere_gives_a_mesh_error_or_a_mesh(tmp_path: Path, suffix: str) -> None:
    content = saved(tmp_path, suffix).path.read_bytes()
    for length in range(0, len(content), max(len(content) // 40, 1)):
        (tmp_path / f"cut{suffix}").write_bytes(content[:length])
        try:
            read = read_mesh_file(tmp_path / f"cut{suffix}")
        except MeshError as error:
            assert "\n" not in str(error)
        else:
            assert suffix == ".obj" or len(content) - length < 40, length
            assert len(read.mesh.faces) <= 4


def test_too_many_vertices_are_counted_without_reading_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_limits, "VERTEX_LIMIT", 1000)
    monkeypatch.setattr(mesh_limits, "_BLOCK", 1024)
    lines = "".join(f"v {n} {n % 7} {n % 3}\n" for n in range(5000))
    (tmp_path / "big.obj").write_text(lines + "f 1 2 3\n")
    with pytest.raises(MeshError, match=r"more than 1,000 vertices \(1,\d\d\d counted\)"):
        read_mesh_file(tmp_path / "big.obj")
    just = "".join(lines.splitlines(keepends=True)[:1000]) + "f 1 3 8\nf 1 8 10\n" * 450
    (tmp_path / "just.obj").write_text(just)
    assert len(read_mesh_file(tmp_path / "just.obj").mesh.vertices) == 1000
    (tmp_path / "big.stl").write_bytes(bytes(80) + struct.pack("<I", 3000) + bytes(150_000))
    with pytest.raises(MeshError, match="decimate"):
        read_mesh_file(tmp_path / "big.stl")
    ball = trimesh.creation.icosphere(4)
    ball.export(tmp_path / "big.glb")
    with pytest.raises(MeshError, match="2,562 counted"):
        read_mesh_file(tmp_path / "big.glb")


def test_a_hole_of_three_gigabytes_is_refused_at_once(tmp_path: Path) -> None:
    with (tmp_path / "huge.glb").open("wb") as file:
        file.truncate(3 * 2**30)
    with pytest.raises(MeshError, match="bytes, more than"):
        read_mesh_file(tmp_path / "huge.glb")


@pytest.mark.parametrize(
    ("name", "head", "message"),
    [
        ("a.obj", b"glTF\2\0\0\0", r"a\.obj is GLB by its content: name it a\.glb"),
        ("a.stl", b"ply\nformat ascii 1.0\n", r"is PLY by its content: name it a\.ply"),
        ("a.PLY", b"OFF\n3 1 0\n", r"is OFF by its content: name it a\.off"),
        ("a.obj", b"Kaydara FBX Binary  \0", r"is FBX by its content\. Export it as GLB"),
        ("a.glb", b"PK\3\4", r"is a ZIP archive by its content"),
    ],
)
def test_a_file_whose_name_says_another_format_than_its_content(
    tmp_path: Path, name: str, head: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(head)
    with pytest.raises(MeshError, match=message):
        read_mesh_file(tmp_path / name)


def test_vertices_that_are_not_the_originals_are_not_written(tmp_path: Path) -> None:
    read = saved(tmp_path, ".obj")
    with pytest.raises(MeshError, match=r"\(4, 3\), the posed ones are \(3, 3\)"):
        write_posed(read, np.zeros((3, 3)), tmp_path / "out.obj")
    with pytest.raises(MeshError, match="not finite, the first is number 2"):
        write_posed(read, np.where(np.arange(4)[:, None] == 2, np.nan, read.mesh.vertices), tmp_path / "out.obj")
    with pytest.raises(MeshError, match="unknown mesh format"):
        write_posed(read, read.mesh.vertices, tmp_path / "out.xyz")
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.obj"]


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    for out, kind, message in [
        (tmp_path / "out.xyz", MeshError, "unknown mesh format"),
        (tmp_path, MeshError, "is a folder"),
        (tmp_path / "file" / "out.obj", StorageError, r"could not write to .*: "),
    ]:
        with pytest.raises(kind, match=message):
            check_writable(out)
    check_writable(tmp_path / "new" / "out.obj")
    assert (tmp_path / "new").is_dir() and not list((tmp_path / "new").iterdir())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    (tmp_path / "shut").mkdir(mode=0o500)
    with pytest.raises(StorageError, match="cannot be written to"):
        check_writable(tmp_path / "shut" / "out.obj")


def test_a_body_of_6890_vertices_is_read_fast_and_without_trimesh(tmp_path: Path) -> None:
    ball = trimesh.creation.uv_sphere(count=[83, 84])
    save_mesh(Mesh(ball.vertices, ball.faces), tmp_path / "body.obj")
    begun = time.process_time()  # other work on the machine does not count
    assert len(read_mesh_file(tmp_path / "body.obj").mesh.vertices) > 6800
    assert time.process_time() - begun < 0.6  # 0.1 on an idle machine, three times as much on a full one
    code = f"import sys; from datagen.mesh.files import *; read_mesh_file({str(tmp_path / 'body.obj')!r}); "
    done = subprocess.run(
        [sys.executable, "-c", code + "print('trimesh' in sys.modules or 'scipy' in sys.modules)"],
        capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    assert done.stdout.strip() == "False"


def test_a_file_of_another_whose_name_only_begins_alike_is_left_alone(tmp_path: Path) -> None:
    """``p.obj`` says nothing of ``person.mtl``, which may be of another body; ``p.mtl`` is of an earlier output."""
    (tmp_path / "from").mkdir()
    (tmp_path / "from" / "person.mtl").write_text("newmtl skin\n")
    body = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
    (tmp_path / "from" / "person.obj").write_text("mtllib person.mtl\n" + body)
    (tmp_path / "person.mtl").write_text("of another body")
    read = read_mesh_file(tmp_path / "from" / "person.obj")
    (said,) = write_posed(read, read.mesh.vertices, tmp_path / "p.obj").left_out
    assert said.startswith("person.mtl: another file") and (tmp_path / "person.mtl").read_text() == "of another body"


def test_a_file_that_may_not_be_read_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "body.obj"
    path.write_text("v 0 0 0\n")

    def denied(*given: object, **named: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(MeshError, match=r"body\.obj cannot be read: Permission denied"):
        read_mesh_file(path)


@pytest.mark.parametrize(
    ("suffix", "at", "is_told"),
    [(".glb", 0.0, False), (".glb", 2e3, False), (".glb", 5e4, True), (".stl", 5e4, True), (".obj", 5e4, False),
     (".obj", 5e6, True), (".off", 5e6, True), (".ply", 5e6, True)],
)  # fmt: skip
def test_positions_that_a_file_rounds_are_told_of(tmp_path: Path, suffix: str, at: float, is_told: bool) -> None:
    ball = trimesh.creation.icosphere(2)
    save_mesh(Mesh(np.asarray(ball.vertices) + np.array([at, 0, 0]), np.asarray(ball.faces)), tmp_path / "far.obj")
    read = read_mesh_file(tmp_path / "far.obj")
    left_out = write_posed(read, read.mesh.vertices, tmp_path / f"out{suffix}").left_out
    assert any("positions to better than" in line for line in left_out) == is_told
    if not is_told:
        again = load_mesh(tmp_path / f"out{suffix}").vertices
        assert cKDTree(again).query(read.mesh.vertices)[0].max() < 2e-4
