"""The low-pass filter along the edges of a mesh, everywhere or where it is torn."""

import numpy as np

from datagen.mesh.geometry import Mesh
from datagen.mesh.low_pass import LowPass, LowPassWhereTorn
from tests.support.shapes.avatars import noisy, sphere

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


def test_noise_is_told_from_shape() -> None:
    """However large the mesh, however finely it is meshed, wherever it lies."""
    for radius, subdivisions in ((0.5, 3), (500.0, 4), (0.5, 5)):
        ball = sphere(radius=radius, subdivisions=subdivisions)
        long = Mesh(ball.vertices * [1, 3, 0.7] + 2 * radius, ball.faces)
        rough = [
            LowPass(ball.faces, len(ball.vertices)).roughness(noisy(long, noise * radius).vertices)
            for noise in (0.0, 0.03, 0.06)
        ]
        assert rough[0] < 1 < rough[1] < rough[2] < 1.3
    faces = sphere(subdivisions=2).faces
    assert LowPass(faces[:1], 162).roughness(sphere(subdivisions=2).vertices) == 0, "nothing but open borders"
    assert LowPass(NO_FACES, 3).roughness(np.zeros((3, 3))) == 0


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
