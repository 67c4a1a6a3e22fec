"""Surface nets: the zero surface of a field as a closed mesh."""

import numpy as np
import pytest

from datagen.characters.weld import volume
from datagen.mesh.geometry import edges_of
from datagen.mesh.surface_nets import surface_nets


def test_surface_nets_make_a_sphere() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(-12, 13.0)] * 3, indexing="ij"), axis=-1)
    cells, faces = surface_nets(np.linalg.norm(grid, axis=-1) - 8.3)
    radii = np.linalg.norm(cells - 12, axis=1)
    assert np.abs(radii - 8.3).max() < 0.2
    assert volume(cells - 12, faces) == pytest.approx(4 / 3 * np.pi * 8.3**3, rel=0.02)
    edges = edges_of(faces)
    assert len(cells) - len(edges) + len(faces) == 2
