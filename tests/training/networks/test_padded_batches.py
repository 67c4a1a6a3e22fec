"""Meshes of different counts in one batch get what they get alone."""

import pytest
import torch
from torch import nn

from tests.support.three_networks import BY_AREA, FORMS, PAIRING, lively, plain
from training.networks.padded_batches import MixedCounts

COUNTS = ([40, 31, 40, 7], [25, 50, 25, 50])


def padded(counts: list[int], seed: int) -> torch.Tensor:
    """Meshes whose padding is not a number: whatever touches it shows."""
    torch.manual_seed(seed)
    meshes = torch.full((len(counts), max(counts), 3), torch.nan)
    for mesh, count in enumerate(counts):
        meshes[mesh, :count] = torch.rand(count, 3) * 2 - 1
    return meshes


@pytest.mark.parametrize("form", [*FORMS, *BY_AREA])
def test_each_mesh_gets_what_it_gets_alone(form: str) -> None:
    network, counts = lively(form).eval(), COUNTS if plain(form) != PAIRING else (COUNTS[1], COUNTS[1])
    source, target = padded(counts[0], 1), padded(counts[1], 2)
    together = MixedCounts(network)(source=source, target=target, source_counts=counts[0], target_counts=counts[1])
    assert together.shape == target.shape
    for mesh, (n_source, n_target) in enumerate(zip(*counts, strict=True)):
        alone = network(source=source[mesh : mesh + 1, :n_source], target=target[mesh : mesh + 1, :n_target])
        assert torch.allclose(together[mesh, :n_target], alone[0], atol=1e-5)
        assert not together[mesh, n_target:].any()


@pytest.mark.parametrize("form", [form for form in FORMS if form != PAIRING])
def test_gradients_are_the_sum_of_the_single_ones(form: str) -> None:
    network = lively(form, dtype=torch.float64).eval()
    source, target = padded(COUNTS[0], 1).double(), padded(COUNTS[1], 2).double()
    weights = padded(COUNTS[1], 3).double().nan_to_num()
    mixed = MixedCounts(network)
    (mixed(source=source, target=target, source_counts=COUNTS[0], target_counts=COUNTS[1]) * weights).sum().backward()
    found = [parameter.grad.clone() for parameter in network.parameters()]
    network.zero_grad()
    for mesh, (n_source, n_target) in enumerate(zip(*COUNTS, strict=True)):
        alone = network(source=source[mesh : mesh + 1, :n_source], target=target[mesh : mesh + 1, :n_target])
        (alone[0] * weights[mesh, :n_target]).sum().backward()
    for one, parameter in zip(found, network.parameters(), strict=True):
        assert torch.allclose(one, parameter.grad, atol=1e-10)


def test_equal_counts_are_one_call_of_the_network() -> None:
    calls: list[tuple[int, ...]] = []

    class Recorder(nn.Module):
        def forward(self, *, source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
            calls.append((*source.shape, *target.shape))
            return target

    MixedCounts(Recorder())(source=torch.rand(4, 9, 3), target=torch.rand(4, 5, 3))
    MixedCounts(Recorder())(source=torch.rand(4, 9, 3), target=torch.rand(4, 5, 3), target_counts=[3, 3, 3, 3])
    assert calls == [(4, 9, 3, 4, 5, 3), (4, 9, 3, 4, 3, 3)]


@pytest.mark.parametrize("counts", [[1, 2], [0, 1, 1], [1, 1, 10]])
def test_counts_that_do_not_fit(counts: list[int]) -> None:
    with pytest.raises(ValueError, match=r"target_counts must be 3 numbers from 1 to 9, .*\[3, 9, 3\]"):
        MixedCounts(nn.Identity())(source=torch.rand(3, 9, 3), target=torch.rand(3, 9, 3), target_counts=counts)
