"""The low-pass filter along the edges of a mesh."""

import numpy as np

from datagen.mesh.geometry import Mesh
from datagen.mesh.low_pass import LowPass
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
