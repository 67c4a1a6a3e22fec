"""What an avatar gives in a pose: points, a surface that is smooth where a pose tears it, normals."""

from pathlib import Path

import numpy as np
import torch

from datagen.mesh.geometry import vertex_normals
from datagen.mesh.low_pass import LowPass
from tests.support.shapes.avatars import SIZES, sphere, weights_of
from tests.support.shapes.outfits import bare_template, drawn_outfit
from training.avatar.posed_surface import PosedSurface
from training.avatar.wardrobe import Wardrobe
from training.recipes.networks import AvatarRecipe


def test_it_is_smooth_where_edges_come_out_long_and_else_the_points() -> None:
    """The upper half of a ball is torn apart by noise that is longer than its edges; the lower one moves as one."""
    ball = sphere(subdivisions=3)
    surface = PosedSurface(bare_template(ball, weights_of(ball).numpy()))
    upper = ball.vertices[:, 1] > 0.1
    points = ball.vertices + np.array([0.3, 0, 0])
    assert np.array_equal(surface(points).vertices, points), "nothing is longer than it was"
    noise = np.random.default_rng(0).normal(0, 0.15, points.shape) * upper[:, None]
    found = surface(points + noise).vertices
    calm = ball.vertices[:, 1] < -0.1
    assert np.array_equal(found[calm], points[calm])
    left = np.linalg.norm(found - points, axis=1)[upper].mean()
    assert left < 0.6 * np.linalg.norm(noise, axis=1)[upper].mean()


def test_it_begins_at_edges_half_as_long_again_and_is_whole_at_one_more() -> None:
    ball = sphere(subdivisions=3)
    surface = PosedSurface(bare_template(ball, weights_of(ball).numpy()))
    low_passed = LowPass(ball.faces, len(ball.vertices))
    for size, share in ((1.49, 0.0), (2.0, 0.5), (2.6, 1.0)):
        points = size * ball.vertices
        wanted = points + share * (low_passed(points, 8) - points)
        assert np.allclose(surface(points).vertices, wanted, atol=1e-6)
    assert np.abs(low_passed(points, 8) - points).max() > 1e-3, "these would tell"


def test_a_posed_avatar_is_the_networks_points_its_surface_and_both_normals(tmp_path: Path) -> None:
    wardrobe = Wardrobe.of([drawn_outfit(tmp_path)], AvatarRecipe(name="avatar", **SIZES))
    network = wardrobe.network()
    with torch.no_grad():
        found = network(*wardrobe.given([(0, 3)]), [0])
    (posed,) = wardrobe.posed(network, [(0, 3)])
    assert np.allclose(posed.points, found.points) and np.allclose(posed.skinned, found.skinned)
    assert np.allclose(posed.points - posed.corrected, found.displacements, atol=1e-6)
    assert np.array_equal(posed.mesh.vertices, wardrobe.surface(0, posed.points).vertices)
    both = 2 * found.normals.numpy() + vertex_normals(posed.mesh.vertices, posed.mesh.faces)
    assert np.allclose(posed.normals, both / np.linalg.norm(both, axis=1, keepdims=True), atol=1e-6)
