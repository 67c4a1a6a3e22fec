"""The avatar's metrics on shapes whose distances are known."""

import numpy as np
import pytest
import trimesh

from datagen.mesh.geometry import Mesh
from tests.support.shapes.avatars import sphere
from training.avatar.metrics import Footprints, Surface, score
from training.viz.render.lighting import vertex_normals


def sheet(height: float, *, cells: int = 8, shift: float = 0.0) -> Mesh:
    """A square of one metre in XZ, upwards."""
    across = np.linspace(0, 1, cells + 1)
    x, z = np.meshgrid(across, across, indexing="ij")
    vertices = np.stack([x.ravel() + shift, np.full(x.size, height), z.ravel()], axis=1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    one = np.stack([corner, corner + 1, corner + cells + 1], axis=1)
    two = np.stack([corner + 1, corner + cells + 2, corner + cells + 1], axis=1)
    return Mesh(vertices, np.concatenate([one, two]))


def test_two_parallel_sheets_are_their_distance_apart_by_every_measure() -> None:
    model, scan = sheet(0.01), sheet(0.0)
    found = score(model, vertex_normals(model.vertices, model.faces), scan, samples=4000)
    for value in (found.scan_to_model, found.model_to_scan, found.plane, found.hausdorff):
        assert value == pytest.approx(10, abs=1e-6)
    assert found.normal_angle == pytest.approx(0, abs=1e-4)
    assert found.chamfer == pytest.approx(0.01**2 / 2)  # the diagonal is the square root of two
    assert found.cosine == pytest.approx(1)


def test_a_sheet_upside_down_has_the_released_cosine_of_one_and_an_angle_of_180() -> None:
    model, scan = sheet(0.01), sheet(0.0)
    turned = Mesh(model.vertices, model.faces[:, ::-1])
    found = score(turned, vertex_normals(turned.vertices, turned.faces), scan, samples=1000)
    assert (found.cosine, found.normal_angle) == (pytest.approx(1), pytest.approx(180))


def test_the_cosine_is_of_the_normals_that_are_given() -> None:
    scan = sheet(0.0)
    leaning = np.tile([np.sin(np.pi / 3), np.cos(np.pi / 3), 0.0], (len(scan.vertices), 1))
    assert score(scan, leaning, scan, samples=1000).cosine == pytest.approx(0.5)


def test_a_sphere_in_a_larger_one() -> None:
    inner, outer = sphere(radius=0.4, subdivisions=4), sphere(radius=0.5, subdivisions=4)
    found = score(inner, inner.vertices / 0.4, outer, samples=20_000)
    for value in (found.scan_to_model, found.model_to_scan, found.plane, found.hausdorff):
        assert value == pytest.approx(100, rel=0.02)
    assert found.normal_angle < 3
    assert found.cosine > 0.995
    assert found.chamfer == pytest.approx(0.1**2 / 3, rel=0.03)  # a diagonal of sqrt(3) metres


def test_hausdorff_sees_what_the_model_has_too_much() -> None:
    scan = sheet(0.0)
    more = sheet(0.3, cells=1)
    model = Mesh(np.concatenate([scan.vertices, more.vertices]), np.concatenate([scan.faces, more.faces + 81]))
    found = score(model, vertex_normals(model.vertices, model.faces), scan, samples=8000)
    assert found.scan_to_model < 0.1
    assert found.hausdorff == pytest.approx(300, rel=1e-3)


def test_parts_are_the_scans() -> None:
    low, high = sheet(0.0), sheet(1.0)
    scan = Mesh(np.concatenate([low.vertices, high.vertices]), np.concatenate([low.faces, high.faces + 81]))
    model = Mesh(scan.vertices + np.repeat([[0, 0.002, 0], [0, 0.007, 0]], 81, axis=0), scan.faces)
    parts = np.repeat([0, 3], 81)
    found = score(model, vertex_normals(model.vertices, model.faces), scan, samples=2000, parts=parts).parts
    assert sorted(found) == [0, 3]
    assert found[0] == pytest.approx((2, 2, 2, 0), abs=1e-4)
    assert found[3] == pytest.approx((7, 7, 7, 0), abs=1e-4)


def test_distances_are_to_triangles_and_not_to_samples() -> None:
    ball, random = sphere(), np.random.default_rng(0)
    points = random.normal(size=(200, 3))
    points *= (random.uniform(0.45, 0.6, 200) / np.linalg.norm(points, axis=1))[:, None]
    exact = [trimesh.triangles.closest_point(ball.vertices[ball.faces], np.tile(its, (320, 1))) for its in points]
    exact = np.linalg.norm(np.array(exact) - points[:, None], axis=2).min(axis=1)
    assert np.abs(Surface.sampled(ball, 4000).distances(points) - exact).max() < 1e-6


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.2, 0.5, 0.2), 0.5), ((-3, 0, -4), 5), ((0.5, 0, -2), 2), ((2, 0, 2), 1.5 * 2**0.5), ((4, 0, -4), 5),
        ((-1, 1, 0.3), 2**0.5),
    ],
)  # fmt: skip
def test_corners_and_sides_of_a_triangle_are_of_it(point: tuple[float, float, float], distance: float) -> None:
    triangle = Mesh(np.array([[0, 0, 0], [1.0, 0, 0], [0, 0, 1]]), np.array([[0, 2, 1]]))
    assert Surface.sampled(triangle, 10).distances(np.array([point]))[0] == pytest.approx(distance)


def test_samples_are_spread_by_area() -> None:
    small, large = sheet(0.0, cells=1), sheet(1.0, cells=1)
    both = Mesh(np.concatenate([0.5 * small.vertices, large.vertices]), np.concatenate([small.faces, large.faces + 4]))
    found = Surface.sampled(both, 20_000)
    assert (found.points[:, 1] > 0.5).mean() == pytest.approx(0.8, abs=0.01)
    assert np.abs(found.points[found.points[:, 1] > 0.5].mean(axis=0) - [0.5, 1, 0.5]).max() < 0.01


def test_a_point_that_keeps_its_place_on_the_cloth_has_its_distance_as_error_and_one_that_slides_more() -> None:
    points = np.array([[0.3, 0.01, 0.4], [0.7, 0.0, 0.7]])
    footprints = Footprints.of(points, sheet(0.0))
    assert footprints.distances(points, sheet(0.0).vertices) == pytest.approx([0.01, 0], abs=1e-9)
    moved, slid = sheet(2.0, shift=-1.0), points + np.array([[-1, 2, 0], [-1, 2, 0.02]])
    found = footprints.distances(slid, moved.vertices)
    assert found == pytest.approx([0.01, 0.02], abs=1e-9)
    assert Surface.sampled(moved, 1000).distances(slid[1:]) == pytest.approx(0, abs=1e-9)
