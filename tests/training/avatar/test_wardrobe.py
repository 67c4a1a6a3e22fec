"""What an avatar gives in a pose: points, a surface that is smooth where a pose tears it, normals."""

from pathlib import Path

import numpy as np
import torch

from datagen.mesh.geometry import vertex_normals
from datagen.mesh.low_pass import LowPassWhereTorn
from tests.support.shapes.avatars import SIZES
from tests.support.shapes.outfits import drawn_outfit
from training.avatar.wardrobe import Wardrobe
from training.recipes.networks import AvatarRecipe


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


def test_surfaces_are_smooth_where_edges_come_out_half_as_long_again(tmp_path: Path) -> None:
    wardrobe = Wardrobe.of([drawn_outfit(tmp_path)], AvatarRecipe(name="avatar", **SIZES))
    template = wardrobe.templates[0]
    points = 1.02 * template.vertices.double().numpy()
    points[::5] *= 1.5
    found = wardrobe.surface(0, points)
    rest = wardrobe.surface(0, template.vertices.double().numpy())
    assert np.array_equal(found.vertices, LowPassWhereTorn(rest, torn=1.5)(points, 8))
    assert not np.array_equal(found.vertices, points) and np.array_equal(found.faces, template.faces.numpy())
