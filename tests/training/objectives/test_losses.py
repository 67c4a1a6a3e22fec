from __future__ import annotations

import gc
from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from training.objectives import losses as incidence
from training.objectives.losses import (
    edge_length_loss,
    loss_edges,
    reconstruction_loss,
    transfer_loss,
)
from training.recipes.training import TrainingRecipe

EDGES = torch.tensor([[0, 1], [1, 2], [2, 0], [2, 3], [0, 4], [4, 3]])
TETRAHEDRON = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
VARIANTS = [{"measure": m, "mean_over": o} for m, o in product(("length", "squared_length"), ("edges", "faces"))]


class Packed(NamedTuple):
    pairs: Tensor
    meshes: Tensor


def pack(edges: list[Tensor], rows: int) -> Packed:
    return Packed(
        torch.cat([each + mesh * rows for mesh, each in enumerate(edges)]),
        torch.cat([torch.full((len(each),), mesh) for mesh, each in enumerate(edges)]),
    )


def _pair(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return tuple(torch.randn(3, 5, 3, generator=generator, dtype=dtype) for _ in range(2))


def _literal_edge_loss(prediction: Tensor, truth: Tensor, edges: Tensor = EDGES, power: int = 1) -> Tensor:
    total = torch.zeros((), dtype=prediction.dtype)
    for mesh, other in zip(prediction, truth, strict=True):
        for first, second in edges.tolist():
            ratio = (mesh[first] - mesh[second]).norm() / (other[first] - other[second]).norm()
            total = total + (ratio**power - 1).abs()
    return total / (len(prediction) * len(edges))


def _value_and_gradient(loss: Callable[[Tensor], Tensor], prediction: Tensor) -> tuple[Tensor, Tensor | None]:
    variable = prediction.clone().requires_grad_()
    value = loss(variable)
    value.backward()
    return value.detach(), variable.grad


def test_reconstruction_is_the_squared_distance_and_not_the_squared_coordinate() -> None:
    truth = torch.zeros(2, 4, 3)
    assert reconstruction_loss(truth + torch.tensor([1.0, 2.0, 2.0]), truth).item() == pytest.approx(9.0)
    prediction, other = _pair()
    assert reconstruction_loss(prediction, other).item() == pytest.approx(
        (prediction - other).square().sum(2).mean().item()
    )


@pytest.mark.parametrize("measure, power", [("length", 1), ("squared_length", 2)])
def test_edge_loss_equals_its_equation_and_so_does_its_gradient(measure: Any, power: int) -> None:
    prediction, truth = _pair()
    literal = _value_and_gradient(lambda p: _literal_edge_loss(p, truth, power=power), prediction)
    ours = _value_and_gradient(lambda p: edge_length_loss(p, truth, EDGES, measure=measure), prediction)
    torch.testing.assert_close(ours, literal, rtol=1e-12, atol=1e-12)


def test_the_mean_over_faces_is_of_the_sum_of_their_three_edges() -> None:
    prediction, truth = _pair()
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]])  # open: an edge is in one face or in two
    expected = torch.zeros((), dtype=prediction.dtype)
    for face in torch.from_numpy(faces):
        sides = torch.stack([face[[0, 1]], face[[1, 2]], face[[2, 0]]])
        expected += 3 * _literal_edge_loss(prediction, truth, sides) / len(faces)
    edges = torch.from_numpy(loss_edges(faces, "faces"))
    assert len(edges) == 9
    assert edge_length_loss(prediction, truth, edges, mean_over="faces").item() == pytest.approx(expected.item())


def test_edges_of_a_closed_surface_are_listed_once_for_faces_too() -> None:
    assert loss_edges(TETRAHEDRON).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert np.array_equal(loss_edges(TETRAHEDRON, "faces"), loss_edges(TETRAHEDRON))
    opened = loss_edges(TETRAHEDRON[1:], "faces").tolist()
    assert len(opened) == 9 and opened.count([0, 3]) == 2 and opened.count([0, 1]) == 1


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_edge_loss_passes_gradcheck(variant: Any) -> None:
    prediction, truth = _pair()
    packed = pack([EDGES, EDGES[:4], EDGES[1:]], rows=5)
    for edges in (EDGES, packed):
        assert torch.autograd.gradcheck(
            lambda p, e=edges: edge_length_loss(p, truth, e, **variant), prediction.clone().requires_grad_()
        )


def test_edge_loss_is_zero_for_the_truth_and_known_for_a_scaled_one() -> None:
    _, truth = _pair(torch.float32)
    assert edge_length_loss(truth, truth, EDGES).item() == 0
    assert edge_length_loss(1.5 * truth, truth, EDGES).item() == pytest.approx(0.5, rel=1e-6)
    assert edge_length_loss(1.5 * truth, truth, EDGES, measure="squared_length").item() == pytest.approx(1.25, rel=1e-6)
    assert edge_length_loss(truth + 3, truth, EDGES).item() == pytest.approx(0, abs=1e-5)


def test_edges_of_length_zero_give_finite_values_and_gradients() -> None:
    prediction, truth = _pair()
    prediction[:, 1] = prediction[:, 0]  # edge (0, 1) of the prediction
    truth[:, 3] = truth[:, 2]  # edge (2, 3) of the truth: no ratio, counts as perfect
    value, gradient = _value_and_gradient(lambda p: edge_length_loss(p, truth, EDGES), prediction)
    assert gradient is not None and torch.isfinite(gradient).all()
    kept = EDGES[torch.tensor([0, 1, 2, 4, 5])]
    expected = edge_length_loss(prediction, truth, kept) * len(kept) / len(EDGES)
    assert value.item() == pytest.approx(expected.item(), rel=1e-12)


def _many_edges() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return torch.randint(50, (170, 2), generator=generator), torch.randn(170, 6, generator=generator).double()


def test_sums_in_a_fixed_order_equal_those_by_index() -> None:
    pairs, pull = _many_edges()
    expected = torch.zeros(52, 6).double()  # two vertices more than edges touch
    expected.index_add_(0, pairs[:, 0], pull).index_add_(0, pairs[:, 1], pull, alpha=-1)
    found = incidence.sum_at_vertices(pull, incidence.make_incidence(pairs, 52))
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_what_is_kept_of_edges_goes_when_they_go() -> None:
    prediction, truth = _pair()
    gc.collect()
    before = len(incidence.INCIDENCES)
    edges = EDGES.clone()
    first = edge_length_loss(prediction, truth, edges)
    kept = incidence.incidence_of(edges, 5)
    assert torch.equal(edge_length_loss(prediction, truth, edges), first)
    assert incidence.incidence_of(edges, 5) is kept and len(incidence.INCIDENCES) == before + 1
    longer = (torch.cat([each, each[:, :2]], dim=1) for each in (prediction, truth))
    assert edge_length_loss(*longer, edges).item() == pytest.approx(first.item())  # more vertices: worked out anew
    del edges, kept
    gc.collect()
    assert len(incidence.INCIDENCES) == before


@pytest.mark.gpu
def test_the_gradient_is_the_same_bits_every_time_on_cuda() -> None:
    generator = torch.Generator().manual_seed(2)
    edges = torch.randint(2000, (60_000, 2), generator=generator).cuda()
    prediction, truth = (torch.randn(4, 2000, 3, generator=generator).cuda() for _ in range(2))
    first, *others = (
        _value_and_gradient(lambda p: edge_length_loss(p, truth, edges.clone()), prediction)[1] for _ in range(10)
    )
    assert all(torch.equal(first, other) for other in others)


@pytest.mark.parametrize("variant", VARIANTS)
def test_packed_meshes_of_equal_counts_give_what_one_topology_gives(variant: Any) -> None:
    prediction, truth = _pair(torch.float32)
    padding = torch.full((3, 2, 3), torch.nan)
    padded = torch.cat([truth, padding], dim=1)
    plain = _value_and_gradient(
        lambda p: reconstruction_loss(p, truth) + edge_length_loss(p, truth, EDGES, **variant), prediction
    )
    packed = _value_and_gradient(
        lambda p: (
            reconstruction_loss(p, padded, [5, 5, 5]) + edge_length_loss(p, padded, pack([EDGES] * 3, 7), **variant)
        ),
        torch.cat([prediction, padding], dim=1),
    )
    assert packed[0].item() == pytest.approx(plain[0].item(), rel=1e-6)
    assert packed[1] is not None and plain[1] is not None and not packed[1][:, 5:].any()
    torch.testing.assert_close(packed[1][:, :5], plain[1], rtol=1e-5, atol=1e-7)


def test_every_mesh_counts_the_same_however_many_vertices_it_has() -> None:
    prediction, truth = _pair()
    counts, edges = [5, 3, 4], [EDGES, EDGES[:3], EDGES[:4]]
    alone = [
        transfer_loss(p[None, :n], truth=t[None, :n], target=t[None, :n], edges=e)
        for p, t, n, e in zip(prediction, truth, counts, edges, strict=True)
    ]
    for mesh, count in enumerate(counts):
        prediction[mesh, count:], truth[mesh, count:] = torch.nan, torch.inf
    loss, parts = transfer_loss(prediction, truth=truth, target=truth, edges=pack(edges, 5), counts=counts)
    assert loss.item() == pytest.approx(sum(each.item() for each, _ in alone) / 3, rel=1e-12)
    assert parts["edge"].item() == pytest.approx(sum(each["edge"].item() for _, each in alone) / 3, rel=1e-12)


def test_padding_influences_neither_value_nor_gradient() -> None:
    results = []
    for filling in (0.0, 7.0, torch.nan, torch.inf):
        prediction, truth = _pair()
        prediction[1, 3:], truth[1, 3:] = filling, filling
        edges = pack([EDGES, EDGES[:3], EDGES], 5)
        results.append(
            _value_and_gradient(
                lambda p, t=truth, e=edges: transfer_loss(p, truth=t, target=t, edges=e, counts=[5, 3, 5])[0],
                prediction,
            )
        )
    for value, gradient in results:
        assert torch.equal(value, results[0][0]) and gradient is not None
        assert torch.equal(gradient, results[0][1]) and not gradient[1, 3:].any()


def test_a_prediction_that_is_not_a_number_is_not_hidden() -> None:
    prediction, truth = _pair()
    prediction[1, 2] = torch.nan
    _, parts = transfer_loss(prediction, truth=truth, target=truth, edges=EDGES)
    assert all(torch.isnan(part) for part in parts.values())


def test_total_and_its_parts() -> None:
    prediction, truth = _pair()
    total, parts = transfer_loss(prediction.requires_grad_(), truth=truth, target=truth, edges=EDGES)
    rebuilt = parts["reconstruction"] + 0.0005 * parts["edge"]
    assert total.item() == pytest.approx(rebuilt.item(), rel=1e-12)
    assert parts["edge"].item() == pytest.approx(_literal_edge_loss(prediction, truth).item(), rel=1e-12)
    assert total.requires_grad and not any(part.requires_grad for part in parts.values())
    recipe = TrainingRecipe(edge_weight=0.0)
    without, _ = transfer_loss(prediction, truth=truth, target=truth, edges=EDGES, recipe=recipe)
    assert without.item() == parts["reconstruction"].item()


def test_a_recipe_of_training_is_a_recipe_of_the_loss_and_its_default_is_the_papers() -> None:
    prediction, truth = _pair()
    given: dict[str, Any] = {"truth": truth, "target": truth + 1, "edges": EDGES}
    assert torch.equal(
        transfer_loss(prediction, **given)[0], transfer_loss(prediction, **given, recipe=TrainingRecipe())[0]
    )


def test_weights_reference_measure_and_sum_are_the_recipes() -> None:
    prediction, truth = _pair()
    target = truth.flip(0)
    recipe = TrainingRecipe(
        reconstruction_weight=1 / 3,
        edge_weight=0.25,
        edge_reference="target",
        edge_measure="squared_length",
        edge_sum="faces",
    )
    loss, parts = transfer_loss(prediction, truth=truth, target=target, edges=EDGES, recipe=recipe)
    edge = 3 * _literal_edge_loss(prediction, target, power=2).item()
    assert parts["edge"].item() == pytest.approx(edge, rel=1e-12)
    coordinates = (prediction - truth).square().mean().item()  # what NPT, 3D-CoreNet and the release take the mean of
    assert loss.item() == pytest.approx(coordinates + 0.25 * edge, rel=1e-12)


def test_errors_carry_the_shapes() -> None:
    prediction, truth = _pair()
    with pytest.raises(ValueError, match=r"\[3, 5, 3\] and \[3, 4, 3\]"):
        reconstruction_loss(prediction, truth[:, :4])
    with pytest.raises(ValueError, match=r"int64 of shape \[edge, 2\].*got torch.int64 of \[6, 1\]"):
        edge_length_loss(prediction, truth, EDGES[:, :1])
    with pytest.raises(ValueError, match=r"torch.int32"):
        edge_length_loss(prediction, truth, EDGES.int())
    for counts in ([5, 5], [5, 6, 5], [5, 0, 5]):
        with pytest.raises(ValueError, match=r"counts must be 3 numbers from 1 to 5, got \[5"):
            reconstruction_loss(prediction, truth, counts)
