"""What an avatar gives in a pose."""

from pathlib import Path

import numpy as np

from tests.support.shapes.avatars import SIZES
from tests.support.shapes.outfits import drawn_outfit
from training.avatar.wardrobe import Wardrobe
from training.recipes.networks import AvatarRecipe


def test_a_posed_surface_is_without_what_changes_from_point_to_point(tmp_path: Path) -> None:
    """Points in disorder become a smooth surface of the same size; what the network gives stays beside it."""
    wardrobe = Wardrobe.of([drawn_outfit(tmp_path)], AvatarRecipe(name="avatar", **SIZES))
    (posed,) = wardrobe.posed(wardrobe.network(), [(0, 3)])
    assert np.array_equal(posed.mesh.vertices, wardrobe.mesh(0, posed.points).vertices)
    assert np.allclose(np.linalg.norm(posed.normals, axis=1), 1)
    noise = np.random.default_rng(0).normal(0, 0.005, posed.points.shape)
    left = wardrobe.mesh(0, posed.points + noise).vertices - posed.mesh.vertices
    assert np.linalg.norm(left, axis=1).mean() < 0.6 * np.linalg.norm(noise, axis=1).mean()
    assert np.abs(np.ptp(posed.mesh.vertices, axis=0) - np.ptp(posed.points, axis=0)).max() < 0.02
