from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from training.objectives import metrics


def _random(batch: int, vertices: int, seed: int) -> Tensor:
    return torch.randn(batch, vertices, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _distances(first: Tensor, second: Tensor) -> Tensor:
    return (first[:, None] - second[None]).norm(dim=2)


pairs = st.tuples(st.integers(1, 3), st.integers(1, 12), st.integers(0, 10**6), st.floats(0, 3)).map(
    lambda case: (_random(*case[:3]), _random(*case[:3]) + case[3] * _random(case[0], case[1], case[2] + 1))
)


def test_point_mesh_distance_is_a_mean_over_coordinates_too() -> None:
    truth = torch.zeros(2, 5, 3)
    prediction = truth.clone()
    prediction[1] += torch.tensor([1.0, 2.0, 2.0])
    found = metrics.point_mesh_distance(prediction, truth)
    assert found.dtype == torch.float64
    assert found.tolist() == pytest.approx([0.0, 3.0])
    assert metrics.mean_euclidean_error(prediction, truth).tolist() == pytest.approx([0.0, 3.0])


def test_recentred_distance_ignores_a_shift_and_uses_the_box_not_the_mean() -> None:
    truth = _random(2, 9, 0)
    assert metrics.recentred_point_mesh_distance(truth + 5, truth).tolist() == pytest.approx([0, 0], abs=1e-20)
    prediction = torch.tensor([[[0.0, 0, 0], [0, 0, 0], [2, 0, 0]]])
    other = torch.tensor([[[10.0, 0, 0], [12, 0, 0], [12, 0, 0]]])
    assert metrics.recentred_point_mesh_distance(prediction, other).tolist() == pytest.approx([4 / 9])


def test_distance_by_area_weighs_a_vertex_by_its_faces_however_they_are_split() -> None:
    square = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [9, 9, 9]])[None]
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    moved = square + torch.tensor([[3.0], [0], [0], [0], [100]]) * torch.tensor([0.0, 0, 1])
    assert metrics.area_point_mesh_distance(moved, square, faces).item() == pytest.approx(3 * 1 / 3)  # a third of both
    fine = torch.cat([square, torch.full((1, 1, 3), 1.0) * torch.tensor([1.0, 1, 0])], dim=1)  # its middle, all at rest
    split = torch.tensor([[0, 1, 5], [1, 2, 5], [2, 3, 5], [3, 0, 5]])
    lifted = torch.cat([moved, fine[:, 5:]], dim=1)
    assert metrics.area_point_mesh_distance(lifted, fine, split).item() == pytest.approx(3 / 6)
    assert math.isnan(metrics.area_point_mesh_distance(square * 0, square * 0, faces).item())
    even = metrics.area_point_mesh_distance(square[:, :4] + 1, square[:, :4], faces)
    assert even.item() == pytest.approx(metrics.point_mesh_distance(square + 1, square).item())


def test_chamfer_distance_equals_brute_force_for_different_numbers_of_vertices() -> None:
    first, second = _random(2, 40, 0), _random(2, 25, 1)
    for value, p, t in zip(metrics.chamfer_distance(first, second), first, second, strict=True):
        squares = _distances(p, t).square()
        assert value.item() == pytest.approx((squares.amin(1).mean() + squares.amin(0).mean()).item(), rel=1e-12)


def test_earth_mover_distance_equals_the_best_of_all_permutations() -> None:
    first, second = _random(3, 6, 0), _random(3, 6, 1)
    for value, p, t in zip(metrics.earth_mover_distance(first, second), first, second, strict=True):
        costs = _distances(p, t)
        orders = itertools.permutations(range(6))
        best = min(costs[torch.arange(6), torch.tensor(order)].mean().item() for order in orders)
        assert value.item() == pytest.approx(best, rel=1e-12)


def test_earth_mover_distance_draws_the_same_vertices_of_both_by_the_seed() -> None:
    truth = _random(2, 300, 0)
    assert metrics.earth_mover_distance(truth, truth, points=50).tolist() == [0, 0]
    # A small common shift moves every chosen vertex by its length, provided that the same ones are chosen.
    shifted = metrics.earth_mover_distance(truth + 1e-3, truth, points=50)
    assert shifted.tolist() == pytest.approx([1e-3 * math.sqrt(3)] * 2, rel=1e-9)
    other = _random(2, 300, 1)
    first, again, different = (metrics.earth_mover_distance(other, truth, points=50, seed=s) for s in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, different)


def test_edge_length_ratio_error_in_known_cases() -> None:
    truth = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 2, 0]]])
    edges = torch.tensor([[0, 1], [0, 2], [2, 3]])  # the last has length zero in the truth
    prediction = truth * torch.tensor([1.5, 1.0, 1.0])
    assert metrics.edge_length_ratio_error(prediction, truth, edges).tolist() == pytest.approx([0.5 / 3])


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 30.0, 90.0, 180.0])
def test_normal_angle_error_of_a_rotation_is_its_angle(degrees: float) -> None:
    truth = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [7, 7, 0]]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]], dtype=torch.int32)
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rotation = torch.tensor([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]], dtype=torch.float64)
    found = metrics.normal_angle_error(truth @ rotation.t(), truth, faces)
    assert found.tolist() == pytest.approx([degrees], rel=1e-6, abs=1e-9)


def test_normal_angle_error_counts_faces_once_and_treats_flat_ones_as_documented() -> None:
    truth = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 9], [2, 0, 0]]])
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 1, 4]])  # the last has no area in the truth: left out
    flipped = truth * torch.tensor([1.0, -1.0, 1.0])  # turns the first normal round and keeps the second
    assert metrics.normal_angle_error(flipped, truth, faces).tolist() == pytest.approx([90.0])
    collapsed = torch.zeros_like(truth)
    assert metrics.normal_angle_error(collapsed, truth, faces).tolist() == pytest.approx([90.0])
    assert metrics.normal_angle_error(truth, collapsed, faces).tolist() == [0.0]


@settings(max_examples=60)
@given(pairs)
def test_bounds_between_metrics(pair: tuple[Tensor, Tensor]) -> None:
    prediction, truth = pair
    distance = metrics.point_mesh_distance(prediction, truth)
    slack = 1e-12
    assert (metrics.earth_mover_distance(prediction, truth) <= (3 * distance).sqrt() + slack).all()
    assert (metrics.chamfer_distance(prediction, truth) <= 6 * distance + slack).all()
    assert (metrics.mean_euclidean_error(prediction, truth) <= (3 * distance).sqrt() + slack).all()


@settings(max_examples=30)
@given(pairs, st.integers(0, 10**6))
def test_set_metrics_ignore_the_order_of_vertices_and_are_symmetric(pair: tuple[Tensor, Tensor], seed: int) -> None:
    prediction, truth = pair
    order = torch.randperm(truth.shape[1], generator=torch.Generator().manual_seed(seed))
    for metric in (metrics.chamfer_distance, metrics.earth_mover_distance):
        value = metric(prediction, truth)
        torch.testing.assert_close(metric(prediction[:, order], truth), value, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(metric(truth, prediction), value, rtol=1e-10, atol=1e-12)


def test_errors_carry_the_shapes() -> None:
    with pytest.raises(ValueError, match=r"\[2, 5, 3\] and \[2, 4, 3\]"):
        metrics.point_mesh_distance(_random(2, 5, 0), _random(2, 4, 0))
    with pytest.raises(ValueError, match=r"\[2, 5, 3\] and \[1, 5, 3\]"):
        metrics.chamfer_distance(_random(2, 5, 0), _random(1, 5, 0))
    with pytest.raises(ValueError, match=r"\[batch, vertex, 3\].*got \[5, 3\]"):
        metrics.point_mesh_distance(_random(2, 5, 0)[0], _random(2, 5, 0)[0])
    with pytest.raises(ValueError, match="points must be positive, got 0"):
        metrics.earth_mover_distance(_random(2, 5, 0), _random(2, 5, 0), points=0)
