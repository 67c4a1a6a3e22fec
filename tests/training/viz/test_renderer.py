"""Pictures show what they should: a silhouette in its place, light, colour, depth, and the same camera for all."""

import subprocess
import sys

import numpy as np
import pytest

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, vertex_normals
from training.viz.render.camera import Camera, frame
from training.viz.render.lighting import ground_shadow, openness
from training.viz.render.renderer import BACKGROUND, render_mesh

FRONT = Camera(eye=(0, 0, 10), target=(0, 0, 0), field_of_view=30)


def ellipsoid(radii: tuple[float, float, float] = (0.3, 1.0, 0.3), rings: int = 12, sides: int = 16) -> Mesh:
    """Return a closed, outward-facing ellipsoid at the origin."""
    fall, turn = np.meshgrid(np.linspace(0, np.pi, rings), 2 * np.pi * np.arange(sides) / sides, indexing="ij")
    points = np.stack([np.sin(fall) * np.sin(turn), np.cos(fall), np.sin(fall) * np.cos(turn)], -1).reshape(-1, 3)
    index = np.arange(rings * sides).reshape(rings, sides)
    a, b, c, d = index[:-1], index[1:], np.roll(index, -1, 1)[1:], np.roll(index, -1, 1)[:-1]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return Mesh(points * radii, faces)


def moved(mesh: Mesh, *shift: float) -> Mesh:
    return Mesh(mesh.vertices + np.array(shift), mesh.faces)


def covered(picture: np.ndarray) -> np.ndarray:
    """Return where a white mesh on a black background shows."""
    return picture.max(-1) > 25


def silhouette(mesh: Mesh, camera: Camera | None = None, size: tuple[int, int] = (80, 100)) -> np.ndarray:
    picture = render_mesh(mesh.vertices, mesh.faces, colors=(1, 1, 1), camera=camera, size=size, background=(0, 0, 0))
    return covered(picture)


def test_shape_type_and_background() -> None:
    mesh = ellipsoid()
    picture = render_mesh(mesh.vertices, mesh.faces, size=(60, 90))
    assert picture.shape == (90, 60, 3) and picture.dtype == np.uint8
    assert np.abs(picture[0, 0] - np.rint(255 * np.array(BACKGROUND))).max() <= 1


def test_silhouette_of_a_square_is_where_projection_puts_it() -> None:
    square = Mesh(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    shown = silhouette(square, FRONT, (100, 100))
    half = 50 / np.tan(np.radians(15)) / 10  # pixels a unit at distance 10
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    assert abs(columns[0] - (50 - half)) <= 1 and abs(columns[-1] + 1 - (50 + half)) <= 1
    assert abs(rows[0] - (50 - half)) <= 1 and abs(rows[-1] + 1 - (50 + half)) <= 1
    assert shown[rows[0] + 1 : rows[-1], columns[0] + 1 : columns[-1]].all(), "no gap along the shared diagonal"


def test_a_moved_mesh_moves_and_up_is_up() -> None:
    mesh = ellipsoid((0.4, 0.4, 0.4))
    rows, columns = np.nonzero(silhouette(mesh, FRONT))
    raised_rows, raised_columns = np.nonzero(silhouette(moved(mesh, 0.5, 1.0, 0), FRONT))
    scale = 50 / np.tan(np.radians(15)) / 10
    assert raised_rows.mean() - rows.mean() == pytest.approx(-scale, abs=1)
    assert raised_columns.mean() - columns.mean() == pytest.approx(0.5 * scale, abs=1)


def test_the_nearer_mesh_hides_the_farther_whatever_the_order() -> None:
    mesh = ellipsoid((0.5, 0.5, 0.5))
    count = len(mesh.vertices)
    both = np.concatenate([moved(mesh, 0, 0, 2).vertices, moved(mesh, 0, 0, -2).vertices])
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], count, axis=0)
    for faces in (
        np.concatenate([mesh.faces, mesh.faces + count]),
        np.concatenate([mesh.faces + count, mesh.faces]),
    ):
        centre = render_mesh(both, faces, colors=colors, camera=FRONT, size=(80, 100))[50, 40].astype(int)
        assert centre[0] > centre[2] + 100


def test_light_comes_from_the_upper_left_and_flipped_faces_look_the_same() -> None:
    mesh = ellipsoid((1, 1, 1), 24, 32)
    picture = render_mesh(mesh.vertices, mesh.faces, colors=(0.5, 0.5, 0.5), camera=FRONT, size=(100, 100)).astype(int)
    assert picture[42, 42, 0] > picture[60, 60, 0] + 20
    flipped = render_mesh(mesh.vertices, mesh.faces[:, ::-1], colors=(0.5,) * 3, camera=FRONT, size=(100, 100))
    middle = slice(42, 58)
    assert np.abs(flipped.astype(int) - picture)[middle, middle].max() < 8


def test_without_shading_colours_are_kept() -> None:
    mesh = ellipsoid((1, 1, 1))
    picture = render_mesh(mesh.vertices, mesh.faces, colors=(0.2, 0.4, 0.8), camera=FRONT, size=(60, 60), shading=0)
    assert picture[30, 30].tolist() == [51, 102, 204]


def test_edges_are_antialiased() -> None:
    mesh = ellipsoid()
    levels = np.unique(
        render_mesh(mesh.vertices, mesh.faces, colors=(1, 1, 1), size=(80, 100), background=(0, 0, 0), shading=0)
    )
    assert {0, 255} <= set(levels.tolist()) and len(levels) >= 8


def test_the_ground_is_darkest_under_the_mesh_and_open_far_away() -> None:
    mesh = ellipsoid((0.3, 0.3, 0.3))
    shadow, _, _ = ground_shadow(mesh.vertices, mesh.faces)
    middle = len(shadow) // 2
    assert shadow[middle, middle] > 0.4
    assert 0 <= shadow[0, 0] < 0.05
    lifted = np.concatenate([moved(mesh, 0, 3, 0).vertices, [[0, 0, 0], [0, 0, 0.01], [0.01, 0, 0]]])
    faint, _, _ = ground_shadow(lifted, np.concatenate([mesh.faces, len(mesh.vertices) + np.array([[0, 1, 2]])]))
    assert faint.max() < shadow.max()


def test_a_convex_mesh_is_open_and_one_shut_in_another_is_not() -> None:
    mesh = ellipsoid((1, 1, 1), 16, 24)
    count = len(mesh.vertices)
    assert openness(mesh.vertices, mesh.faces).min() > 0.9
    assert openness(mesh.vertices, mesh.faces[:, ::-1]).min() > 0.9
    nested = openness(np.concatenate([mesh.vertices, 0.5 * mesh.vertices]), np.r_[mesh.faces, mesh.faces + count])
    assert nested[:count].min() > 0.9 and nested[count:].max() < 0.1


def test_normals_point_outwards() -> None:
    mesh = ellipsoid((1, 1, 1), 24, 32)
    inside = slice(32, -32)  # the rings at the poles are degenerate
    assert np.sum(vertex_normals(mesh.vertices, mesh.faces)[inside] * mesh.vertices[inside], axis=1).min() > 0.99


@pytest.mark.parametrize("size", [(80, 100), (200, 60)])
def test_frame_holds_all_meshes_and_fills_the_panel(size: tuple[int, int]) -> None:
    meshes = [ellipsoid(), moved(ellipsoid((0.9, 0.4, 0.2)), 3, 1, 0)]
    camera = frame(meshes, size=size, margin=0.1)
    shown = silhouette(meshes[0], camera, size) | silhouette(meshes[1], camera, size)
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    assert not (shown[0].any() or shown[-1].any() or shown[:, 0].any() or shown[:, -1].any())
    filled = max((rows[-1] - rows[0] + 1) / size[1], (columns[-1] - columns[0] + 1) / size[0])
    assert 0.7 < filled <= 0.82


def test_faces_behind_the_camera_and_views_from_above_are_no_trouble() -> None:
    mesh = ellipsoid()
    inside = Camera(eye=(0, 0, 0), target=(0, 0, -1))
    assert render_mesh(mesh.vertices, mesh.faces, camera=inside, size=(40, 40)).shape == (40, 40, 3)
    above = Camera(eye=(0, 10, 0), target=(0, 0, 0))
    assert silhouette(mesh, above).any()


def test_degenerate_meshes_draw() -> None:
    flat = np.zeros((3, 3))
    assert render_mesh(flat, np.array([[0, 1, 2]]), size=(20, 20)).shape == (20, 20, 3)
    assert render_mesh(ellipsoid().vertices, np.zeros((0, 3), int), size=(20, 20)).shape == (20, 20, 3)


@pytest.mark.parametrize(
    ("vertices", "faces", "colors", "message"),
    [
        (np.full((3, 3), np.nan), [[0, 1, 2]], None, "finite: 3 of 3"),
        (np.zeros((3, 2)), [[0, 1, 2]], None, r"shape \[v, 3\], got \(3, 2\)"),
        (np.zeros((3, 3)), [[0, 1, 3]], None, "index 3 vertices, got 0 to 3"),
        (np.zeros((3, 3)), [[0, 1]], None, r"shape \[f, 3\]"),
        (np.zeros((3, 3)), [[0, 1, 2]], np.zeros((4, 3)), r"colors must have shape"),
    ],
)
def test_wrong_input_is_refused(vertices: Floats, faces: list[list[int]], colors: Floats | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        render_mesh(vertices, np.array(faces), colors=colors)


def test_the_same_mesh_gives_the_same_bytes_and_needs_no_display_library() -> None:
    script = (
        "import sys, numpy as np; from training.viz.render.renderer import render_mesh;"
        "v = np.random.default_rng(0).random((30, 3));"
        "p = render_mesh(v, np.arange(30).reshape(10, 3), size=(32, 40));"
        "assert not {'vtk', 'OpenGL', 'pyglet', 'matplotlib'} & set(sys.modules); print(hash(p.tobytes()))"
    )
    run = [sys.executable, "-c", script]
    outputs = {
        subprocess.run(run, capture_output=True, text=True, check=True, env={"PYTHONHASHSEED": "0"}).stdout
        for _ in range(2)
    }
    assert len(outputs) == 1
