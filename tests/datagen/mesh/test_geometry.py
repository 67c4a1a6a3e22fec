"""Normalisation, edges, and mesh files good and bad."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.common.errors import MeshError, StorageError
from datagen.mesh.files import load_mesh, save_mesh
from datagen.mesh.formats import FORMATS
from datagen.mesh.geometry import InFaces, Mesh, bounding_box, bounds, check_mesh, edges_of, places_of

TETRAHEDRON = Mesh(
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
)


@given(st.integers(0, 10_000), st.floats(0.01, 100), st.floats(-50, 50))
def test_normalisation_fills_the_box_and_undoes(seed: int, size: float, shift: float) -> None:
    vertices = np.random.default_rng(seed).normal(size=(2, 20, 3)) * size + shift
    box = bounding_box(vertices)
    unit = box.normalise(vertices)
    assert np.allclose(np.abs(unit).max(axis=(1, 2)), 1) and np.allclose(unit.max(axis=1) + unit.min(axis=1), 0)
    assert np.allclose(box.restore(unit), vertices)


def test_normalisation_of_the_tetrahedron_by_hand() -> None:
    unit = bounding_box(TETRAHEDRON.vertices).normalise(TETRAHEDRON.vertices)
    assert np.allclose(unit[3], [-1 / 3, -2 / 3, 1])


def test_edges_are_unique_and_sorted() -> None:
    assert edges_of(TETRAHEDRON.faces).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


def test_vertices_in_no_face_are_left_out_and_move_as_the_nearest_does() -> None:
    loose = np.array([[0.0, 0, 3.5], [7, 7, 7]])
    vertices = np.concatenate([loose[:1], TETRAHEDRON.vertices, loose[1:]])
    flat = [[5, 1, 1]]  # no triangle: its corner is in no face
    found = InFaces(Mesh(vertices, np.concatenate([TETRAHEDRON.faces + 1, flat])))
    assert found.loose.tolist() == [0, 5] and np.array_equal(found.mesh.vertices, TETRAHEDRON.vertices)
    assert np.array_equal(found.mesh.faces, TETRAHEDRON.faces)
    moved = found.of_all(TETRAHEDRON.vertices * (1, 1, 2))
    assert np.allclose(moved[1:5], TETRAHEDRON.vertices * (1, 1, 2)) and np.allclose(moved[0], [0, 0, 6.5])


@pytest.mark.parametrize("faces", [TETRAHEDRON.faces, np.zeros((1, 3), np.int64), np.zeros((0, 3), np.int64)])
def test_of_a_mesh_without_loose_vertices_and_of_points_nothing_is_left_out(faces: np.ndarray) -> None:
    mesh = Mesh(TETRAHEDRON.vertices, faces)
    found = InFaces(mesh)
    assert found.mesh is mesh and not len(found.loose) and found.of_all(mesh.vertices) is mesh.vertices


def test_a_mesh_that_is_nothing_without_its_loose_vertices_is_refused() -> None:
    point = np.concatenate([np.repeat(TETRAHEDRON.vertices[:1], 3, axis=0), TETRAHEDRON.vertices[1:]])
    with pytest.raises(MeshError, match="A has no extent"):
        InFaces.checked(Mesh(point, np.array([[0, 1, 2]])), name="A")


def test_vertices_at_one_place_but_for_rounding_share_its_number() -> None:
    vertices = np.concatenate([TETRAHEDRON.vertices, TETRAHEDRON.vertices[2:] + 2e-6, TETRAHEDRON.vertices[:1] + 1e-3])
    first, second, third, fourth, *others = places_of(vertices).tolist()
    assert len({first, second, third, fourth}) == 4 and others[:2] == [third, fourth]
    assert others[2] not in (first, second, third, fourth)


def test_a_face_far_away_does_not_make_the_others_one_place() -> None:
    body = np.random.default_rng(0).uniform(-1, 1, (20_000, 3))
    far = np.concatenate([body, body[:1] + 1e6, body[:1] + 1e6 + 1e-7])
    numbers = places_of(far)
    assert len(np.unique(numbers[:20_000])) > 19_990 and numbers[-1] == numbers[-2]


@pytest.mark.parametrize("suffix", sorted(set(FORMATS) - {".stl"}))
def test_files_keep_vertices_and_their_order(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"mesh{suffix}"
    save_mesh(TETRAHEDRON, path)
    read = load_mesh(path)
    assert np.allclose(read.vertices, TETRAHEDRON.vertices, atol=1e-6) and np.array_equal(read.faces, TETRAHEDRON.faces)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_glb_that_says_another_type_is_one_error(tmp_path: Path) -> None:
    save_mesh(TETRAHEDRON, tmp_path / "a.glb")
    content = (tmp_path / "a.glb").read_bytes()
    start, end = content.index(b'[{"attributes"'), content.index(b"}]", content.index(b'[{"attributes"')) + 2
    (tmp_path / "a.glb").write_bytes(content[:start] + b'["x"]'.ljust(end - start) + content[end:])
    with pytest.raises(MeshError, match="cannot be read as GLB"):
        load_mesh(tmp_path / "a.glb")


def test_faces_that_index_nothing() -> None:
    with pytest.raises(MeshError, match="faces name vertex 9"):
        check_mesh(Mesh(TETRAHEDRON.vertices, np.array([[0, 1, 9]])), name="mine")


def test_a_place_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match="could not write"):
        save_mesh(TETRAHEDRON, tmp_path / "file" / "mesh.obj")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("vertices", [1, 2, 127, 128, 129, 300])
def test_bounds_are_those_of_each_mesh_and_show_what_is_not_finite(vertices: int) -> None:
    meshes = np.random.default_rng(0).normal(size=(4, vertices, 3)).astype(np.float32)
    low, high = bounds(meshes)
    assert np.array_equal(low, meshes.min(axis=1)) and np.array_equal(high, meshes.max(axis=1))
    for bad in (np.nan, np.inf, -np.inf):
        spoiled = meshes.copy()
        spoiled[2, vertices // 2, 1] = bad
        finite = np.isfinite(np.stack(bounds(spoiled))).all(axis=(0, 2))
        assert finite.tolist() == [True, True, False, True]
