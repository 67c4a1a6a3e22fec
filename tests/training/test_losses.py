from __future__ import annotations

import pytest
import torch
from torch import Tensor

from training.losses import edge_length_loss, edge_lengths, pose_transfer_loss, reconstruction_loss

EDGES = torch.tensor([[0, 1], [1, 2], [2, 0], [2, 3], [0, 4], [4, 3]])


def _pair(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return tuple(torch.randn(3, 5, 3, generator=generator, dtype=dtype) for _ in range(2))


def _literal_edge_loss(prediction: Tensor, truth: Tensor) -> Tensor:
    total = torch.zeros((), dtype=prediction.dtype)
    for mesh, other in zip(prediction, truth, strict=True):
        for first, second in EDGES.tolist():
            total = total + ((mesh[first] - mesh[second]).norm() / (other[first] - other[second]).norm() - 1).abs()
    return total / (len(prediction) * len(EDGES))


def test_reconstruction_is_the_squared_distance_and_not_the_squared_coordinate() -> None:
    truth = torch.zeros(2, 4, 3)
    assert reconstruction_loss(truth + torch.tensor([1.0, 2.0, 2.0]), truth).item() == pytest.approx(9.0)
    prediction, other = _pair()
    assert reconstruction_loss(prediction, other).item() == pytest.approx(
        (prediction - other).square().sum(2).mean().item()
    )


def test_edge_loss_equals_its_equation_and_so_does_its_gradient() -> None:
    prediction, truth = _pair()
    results = []
    for loss in (_literal_edge_loss, lambda p, t: edge_length_loss(p, t, EDGES)):
        variable = prediction.clone().requires_grad_()
        value = loss(variable, truth)
        value.backward()
        results.append((value.detach(), variable.grad))
    torch.testing.assert_close(results[1], results[0], rtol=1e-12, atol=1e-12)


def test_edge_loss_passes_gradcheck() -> None:
    prediction, truth = _pair()
    assert torch.autograd.gradcheck(lambda p: edge_length_loss(p, truth, EDGES), prediction.requires_grad_())


def test_edge_loss_is_zero_for_the_truth_and_known_for_a_scaled_one() -> None:
    _, truth = _pair(torch.float32)
    assert edge_length_loss(truth, truth, EDGES).item() == 0
    assert edge_length_loss(1.5 * truth, truth, EDGES).item() == pytest.approx(0.5, rel=1e-6)
    assert edge_length_loss(truth + 3, truth, EDGES).item() == pytest.approx(0, abs=1e-5)


def test_lengths_known_already_give_the_same_value() -> None:
    prediction, truth = _pair()
    lengths = edge_lengths(truth, EDGES)
    assert lengths.shape == (3, 6)
    assert torch.equal(
        edge_length_loss(prediction, truth, EDGES, lengths=lengths), edge_length_loss(prediction, truth, EDGES)
    )
    with pytest.raises(ValueError, match=r"lengths must be \[3, 6\], got \[2, 6\]"):
        edge_length_loss(prediction, truth, EDGES, lengths=lengths[:2])


def test_edges_of_length_zero_give_finite_values_and_gradients() -> None:
    prediction, truth = _pair()
    prediction[:, 1] = prediction[:, 0]  # edge (0, 1) of the prediction
    truth[:, 3] = truth[:, 2]  # edge (2, 3) of the truth: no ratio, counts as perfect
    value = edge_length_loss(prediction.requires_grad_(), truth, EDGES)
    value.backward()
    assert torch.isfinite(prediction.grad).all()
    kept = EDGES[torch.tensor([0, 1, 2, 4, 5])]
    expected = edge_length_loss(prediction, truth, kept) * len(kept) / len(EDGES)
    assert value.item() == pytest.approx(expected.item(), rel=1e-12)


def test_total_and_its_parts() -> None:
    prediction, truth = _pair()
    total, parts = pose_transfer_loss(prediction.requires_grad_(), truth, EDGES)
    rebuilt = parts["reconstruction"] + 0.0005 * parts["edge"]
    assert total.item() == pytest.approx(rebuilt.item(), rel=1e-12)
    assert parts["edge"].item() == pytest.approx(_literal_edge_loss(prediction, truth).item(), rel=1e-12)
    assert total.requires_grad and not any(part.requires_grad for part in parts.values())
    without, _ = pose_transfer_loss(prediction, truth, EDGES, edge_weight=0.0)
    assert without.item() == parts["reconstruction"].item()


def test_errors_carry_the_shapes() -> None:
    prediction, truth = _pair()
    with pytest.raises(ValueError, match=r"\[3, 5, 3\] and \[3, 4, 3\]"):
        reconstruction_loss(prediction, truth[:, :4])
    with pytest.raises(ValueError, match=r"int64 of shape \[edge, 2\].*got torch.int64 of \[6, 1\]"):
        edge_length_loss(prediction, truth, EDGES[:, :1])
    with pytest.raises(ValueError, match=r"torch.int32"):
        edge_length_loss(prediction, truth, EDGES.int())
