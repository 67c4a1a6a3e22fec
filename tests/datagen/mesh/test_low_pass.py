"""The low-pass filter along the edges of a mesh, everywhere or where it is torn."""

import warnings

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from datagen.mesh.geometry import Mesh
from datagen.mesh.low_pass import LowPass, LowPassWhereTorn
from tests.support.shapes.avatars import noisy, sphere
from training.evaluation.disturbances import subdivide

NO_FACES = np.zeros((0, 3), np.int64)


def filtered(mesh: Mesh) -> np.ndarray:
    return LowPass(mesh.faces, len(mesh.vertices))(mesh.vertices, 2)


def off(vertices: np.ndarray) -> float:
    """How far from a sphere of half a metre, in the mean."""
    return float(np.abs(np.linalg.norm(vertices, axis=1) - 0.5).mean())


def test_noise_goes_and_size_stays() -> None:
    ball = sphere(radius=0.5, subdivisions=3)
    assert off(filtered(noisy(ball, 0.02))) < 0.65 * off(noisy(ball, 0.02).vertices)
    assert off(filtered(ball)) < 0.002


def roughness(mesh: Mesh) -> tuple[float, float]:
    return LowPass(mesh.faces, len(mesh.vertices)).roughness(mesh.vertices)


def uneven(count: int, seed: int) -> Mesh:
    """A long ellipsoid whose vertices lie at random."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices
    inside = np.einsum("fi,fi->f", points[faces[:, 0]], np.cross(*points[faces[:, 1:]].swapaxes(0, 1))) < 0
    faces[inside] = faces[inside][:, ::-1]
    return Mesh(points * [1, 3, 0.7], faces.astype(np.int64))


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_noise_is_told_from_shape_and_from_uneven_meshing(unit: float) -> None:
    """However large the mesh, however finely it is meshed, wherever it lies."""
    smooth = [sphere(subdivisions=3), sphere(subdivisions=5), uneven(700, 0), uneven(5000, 1)]
    smooth.append(subdivide(subdivide(sphere(subdivisions=2), 2, 0), 1, 0))
    for mesh in smooth:
        placed = Mesh(unit * (mesh.vertices + 2.0), mesh.faces)
        values, differences = zip(*(roughness(noisy(placed, noise * unit)) for noise in (0.0, 0.03, 0.06)), strict=True)
        assert values[0] < 0.88 < values[1] < values[2] + 0.01 < 1.3
        assert 0.025 * unit < differences[1] < 0.06 * unit and 1.5 < differences[2] / differences[1] < 2.1
    fine = sphere(subdivisions=6)
    value, difference = roughness(Mesh(fine.vertices.round(3), fine.faces))
    assert value > 0.88 and difference < 0.001, "rounded coordinates are rough, and make no difference"
    spiked = sphere(subdivisions=4).vertices.copy()
    spiked[::500] *= 1.5
    assert roughness(Mesh(spiked, sphere(subdivisions=4).faces))[0] < 0.88, "a few spikes are no noise"


def test_what_is_not_to_be_judged_is_left_out() -> None:
    ball = sphere(subdivisions=3)
    assert roughness(Mesh(ball.vertices, ball.faces[:1])) == (0, 0), "nothing but open borders"
    assert roughness(Mesh(ball.vertices, NO_FACES)) == (0, 0)
    assert roughness(Mesh(np.zeros((0, 3)), NO_FACES)) == (0, 0)
    assert roughness(Mesh(np.zeros_like(ball.vertices), ball.faces)) == (0, 0)
    broken = ball.vertices.copy()
    broken[7], broken[300] = np.nan, np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert roughness(Mesh(broken, ball.faces)) == pytest.approx(roughness(ball), rel=0.05)


def test_open_borders_and_vertices_without_faces_stay() -> None:
    ball = sphere(radius=0.5, subdivisions=3)
    half = noisy(Mesh(np.concatenate([ball.vertices, [[0, 2.0, 0]]]), ball.faces[: len(ball.faces) // 2]), 0.02)
    sides, counts = np.unique(np.sort(half.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    border, moved = np.unique(sides[counts == 1]), np.any(filtered(half) != half.vertices, axis=1)
    within = np.setdiff1d(np.unique(half.faces), border)
    assert len(border) and len(within)
    assert moved[within].all() and not np.delete(moved, within).any()
    assert np.array_equal(filtered(Mesh(ball.vertices, NO_FACES)), ball.vertices)


def test_the_order_of_vertices_and_faces_does_not_matter() -> None:
    ball, random = noisy(sphere(subdivisions=2), 0.02), np.random.default_rng(1)
    order = random.permutation(len(ball.vertices))
    renamed = Mesh(ball.vertices[order], random.permutation(np.argsort(order)[ball.faces][:, [1, 2, 0]]))
    np.testing.assert_allclose(filtered(renamed), filtered(ball)[order], atol=1e-12)


def test_where_edges_come_out_long_it_is_filtered_and_else_exactly_as_it_is() -> None:
    """The upper half of a ball is torn apart by noise that is longer than its edges; the lower one moves as one."""
    ball = sphere(subdivisions=3)
    where_torn = LowPassWhereTorn(ball, torn=1.5)
    upper = ball.vertices[:, 1] > 0.1
    points = ball.vertices + np.array([0.3, 0, 0])
    assert np.array_equal(where_torn(points, 8), points), "nothing is longer than it was"
    noise = np.random.default_rng(0).normal(0, 0.15, points.shape) * upper[:, None]
    found = where_torn(points + noise, 8)
    calm = ball.vertices[:, 1] < -0.1
    assert np.array_equal(found[calm], points[calm])
    left = np.linalg.norm(found - points, axis=1)[upper].mean()
    assert left < 0.6 * np.linalg.norm(noise, axis=1)[upper].mean()


def test_it_begins_where_edges_are_so_long_and_is_whole_at_one_more() -> None:
    ball = sphere(subdivisions=3)
    where_torn, low_passed = LowPassWhereTorn(ball, torn=1.5), LowPass(ball.faces, len(ball.vertices))
    for size, share in ((1.49, 0.0), (2.0, 0.5), (2.6, 1.0)):
        points = size * ball.vertices
        wanted = points + share * (low_passed(points, 8) - points)
        assert np.allclose(where_torn(points, 8), wanted, atol=1e-6)
    assert np.abs(low_passed(points, 8) - points).max() > 1e-3, "these would tell"
