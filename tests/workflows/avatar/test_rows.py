"""The rows of an avatar's table."""

from pathlib import Path

import numpy as np
import torch

from tests.support.shapes.avatars import SIZES
from tests.support.shapes.outfits import drawn_outfit
from training.avatar.wardrobe import Wardrobe
from training.recipes.networks import AvatarRecipe
from workflows.avatar.evaluate import _canonical, _methods


def test_all_rows_of_a_template_are_surfaces_and_displacements_are_the_networks(tmp_path: Path) -> None:
    wardrobe = Wardrobe.of([drawn_outfit(tmp_path)], AvatarRecipe(name="avatar", **SIZES))
    network, template = wardrobe.network(), wardrobe.templates[0]
    torn = template.vertices + 0.2 * torch.randn(template.vertices.shape, generator=torch.Generator().manual_seed(0))
    network.points.copy_(torn)
    (posed,) = wardrobe.posed(network, [(0, 3)])
    assert not np.array_equal(posed.mesh.vertices, posed.points)
    rows = _methods(wardrobe, network, 0, 3, _canonical(wardrobe, 0, posed))
    for name, points in {"template + skinning": posed.skinned, "template + correction": posed.corrected}.items():
        assert np.array_equal(rows[name][0].vertices, wardrobe.surface(0, points).vertices)
    assert np.allclose(rows["mean displacement"][0].vertices, posed.mesh.vertices, atol=1e-5), "its own displacements"
    assert np.allclose(rows["avatar"][1], posed.normals) and "nearest training pose" in rows
    with torch.no_grad():
        turned = network(*wardrobe.given([(0, 3)]), [0]).displacements.numpy()
    assert np.linalg.norm(_canonical(wardrobe, 0, posed), axis=1).mean() < 2 * np.linalg.norm(turned, axis=1).mean()
