"""Meshes as networks read them: without noise along their edges, and points with neighbours of their own."""

import numpy as np
import pytest

from datagen.mesh.geometry import Mesh
from tests.support.shapes.avatars import sphere
from tests.support.three_networks import lively
from training.inference.mesh_reading import boxed, posed_like, read_targets, smoothed, surface_of_meshes

NO_FACES = np.zeros((0, 3), np.int64)


def noisy(mesh: Mesh, deviation: float) -> Mesh:
    return Mesh(mesh.vertices + np.random.default_rng(0).normal(0, deviation, mesh.vertices.shape), mesh.faces)


def off(vertices: np.ndarray) -> float:
    """How far from a sphere of half a metre, in the mean."""
    return float(np.abs(np.linalg.norm(vertices, axis=1) - 0.5).mean())


def test_noise_goes_and_size_stays() -> None:
    ball = sphere(radius=0.5, subdivisions=3)
    assert off(smoothed(noisy(ball, 0.02))) < 0.65 * off(noisy(ball, 0.02).vertices)
    assert off(smoothed(ball)) < 0.002


def test_open_borders_and_vertices_without_faces_stay() -> None:
    ball = sphere(radius=0.5, subdivisions=3)
    half = noisy(Mesh(np.concatenate([ball.vertices, [[0, 2.0, 0]]]), ball.faces[: len(ball.faces) // 2]), 0.02)
    sides, counts = np.unique(np.sort(half.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    border, moved = np.unique(sides[counts == 1]), np.any(smoothed(half) != half.vertices, axis=1)
    within = np.setdiff1d(np.unique(half.faces), border)
    assert len(border) and len(within)
    assert moved[within].all() and not np.delete(moved, within).any()
    assert np.array_equal(smoothed(Mesh(ball.vertices, NO_FACES)), ball.vertices)


def test_the_order_of_vertices_and_faces_does_not_matter() -> None:
    ball, random = noisy(sphere(subdivisions=2), 0.02), np.random.default_rng(1)
    order = random.permutation(len(ball.vertices))
    renamed = Mesh(ball.vertices[order], random.permutation(np.argsort(order)[ball.faces][:, [1, 2, 0]]))
    np.testing.assert_allclose(smoothed(renamed), smoothed(ball)[order], atol=1e-12)


def test_what_is_posed_are_the_vertices_as_they_are() -> None:
    network, ball = lively("parts").eval(), noisy(sphere(subdivisions=3), 0.02)
    read = read_targets(network, [ball])
    assert np.array_equal(read.vertices.numpy(), boxed(network, [ball]).numpy())
    assert np.array_equal(read.as_read.numpy(), boxed(network, [ball], as_read=True).numpy())
    assert not np.array_equal(read.as_read.numpy(), read.vertices.numpy())
    rough = posed_like(network, [ball], read)[0].numpy()
    even = posed_like(network, [ball], read._replace(vertices=read.as_read))[0].numpy()
    assert np.abs(rough - even).mean() > 0.3 * (read.vertices - read.as_read).abs().mean().item()


@pytest.mark.parametrize("pieces", [1, 2])
def test_points_that_touch_are_not_near_along_the_surface_where_the_way_round_is_long(pieces: int) -> None:
    """A strip folded like a U, of points alone: its arms are 0.12 apart, points 0.02."""
    along, wide = np.linspace(0, 1, 50), np.linspace(0, 0.2, 11)
    arms = np.concatenate([np.stack([along, np.full(50, side), 0 * along], 1) for side in (-0.06, 0.06)])
    bend = np.linspace(-np.pi / 2, np.pi / 2, 10)[1:-1]
    arc = np.stack([1 + 0.06 * np.cos(bend), 0.06 * np.sin(bend), 0 * bend], axis=1)
    line = np.concatenate([arms, arc] if pieces == 1 else [arms])
    points = (line[:, None] + wide[:, None] * [0, 0, 1]).reshape(-1, 3)
    surface = surface_of_meshes([Mesh(points, NO_FACES)])
    cell = {
        side: int(surface.cells[0, np.linalg.norm(points - [0, side, 0], axis=1).argmin()]) for side in (-0.06, 0.06)
    }
    assert bool(surface.near[0, cell[-0.06], cell[0.06]]) == (pieces == 2)  # of pieces apart nobody knows
    assert bool(surface.near[0, cell[0.06], cell[0.06]])
