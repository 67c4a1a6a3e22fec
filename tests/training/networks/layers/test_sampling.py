"""Masses of all vertices of a mesh, from the vertices alone."""

from __future__ import annotations

import torch
from torch import Tensor

from training.networks.layers.sampling import vertex_masses


def body(vertices: int = 300, seed: int = 0) -> Tensor:
    """Vertices [2, n, 3] on ellipsoids, ever denser upwards, in the lower half of the list those below."""
    points = torch.randn(2, vertices, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    points = points / points.norm(dim=2, keepdim=True) * torch.tensor([0.5, 1.0, 0.3], dtype=torch.float64)
    return torch.stack([mesh[mesh[:, 1].argsort()] for mesh in points])


def by_all_pairs(vertices: Tensor) -> Tensor:
    """The inverse of a sum over all vertices of a Gaussian of radius 0.1."""
    near = torch.exp(-torch.cdist(vertices, vertices).square() / 0.02).sum(dim=2, keepdim=True)
    return 1 / near / (1 / near).sum(dim=1, keepdim=True)


def test_masses_are_the_inverse_of_the_density_in_sum_one() -> None:
    vertices = body(2000)
    masses, expected = vertex_masses(vertices), by_all_pairs(vertices)
    assert masses.shape == (2, 2000, 1)
    torch.testing.assert_close(masses.sum(dim=1), torch.ones(2, 1).double())
    assert (masses - expected).abs().sum(dim=1).max() < 0.1
    assert expected.amax() > 3 * expected.amin()  # else equal masses would pass
    torch.testing.assert_close(vertex_masses(vertices.float()).double(), masses, rtol=1e-4, atol=0)


def test_vertices_that_lie_twice_as_densely_count_half() -> None:
    vertices = body()
    twice = torch.cat([vertices, vertices[:, 150:]], dim=1)
    masses, halved = vertex_masses(vertices)[:, 170:], vertex_masses(twice)[:, 170:300]
    ratio = halved / halved.sum(dim=1, keepdim=True) / (masses / masses.sum(dim=1, keepdim=True))
    assert (ratio - 1).abs().mean() < 0.05
    whole = torch.cat([vertices, vertices], dim=1)
    torch.testing.assert_close(2 * vertex_masses(whole)[:, :300], vertex_masses(vertices))


def test_order_and_other_meshes_change_nothing_and_no_gradient_comes_of_it() -> None:
    vertices, order = body().requires_grad_(), torch.randperm(300)
    masses = vertex_masses(vertices)
    assert not masses.requires_grad
    torch.testing.assert_close(vertex_masses(vertices[:, order]), masses[:, order], rtol=1e-14, atol=0)
    torch.testing.assert_close(vertex_masses(vertices[1:]), masses[1:], rtol=1e-14, atol=0)


def test_what_is_not_a_number_stays_in_its_mesh() -> None:
    sound, broken = body(), body()
    for value in (float("nan"), float("inf"), -float("inf")):
        broken[1, 7, 2] = value
        assert torch.isnan(vertex_masses(broken)[1]).all()
        assert torch.equal(vertex_masses(broken)[0], vertex_masses(sound)[0])
