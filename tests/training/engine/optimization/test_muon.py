"""Muon moves matrices as PyTorch's own does and everything else as AdamW, and resumes."""

import copy

import pytest
import torch
from torch import Tensor, nn

from tests.support.recipes import tiny_training
from training.engine.optimization.muon import Muon, orthogonal
from training.engine.optimization.optimizer import build_optimiser, load_optimiser
from training.recipes.training import TrainingRecipe

RECIPE = tiny_training(optimiser="muon", weight_decay=0.1, learning_rate=0.01)


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(40, 64), nn.Tanh(), nn.Linear(64, 64), nn.Conv1d(64, 48, 1), nn.Conv1d(48, 3, 1))


def learn(network: nn.Module, optimiser: torch.optim.Optimizer, steps: range) -> None:
    for step in steps:
        optimiser.zero_grad()
        first, second = network[:3], network[3:]  # type: ignore[index]
        inputs = torch.randn((5, 40), generator=torch.Generator().manual_seed(step))
        second(first(inputs)[..., None]).square().mean().backward()
        optimiser.step()


def of(recipe: TrainingRecipe, steps: int = 0) -> tuple[nn.Module, torch.optim.Optimizer]:
    own = network()
    optimiser = build_optimiser(own, recipe)
    learn(own, optimiser, range(steps))
    return own, optimiser


@pytest.mark.parametrize("shape", [(64, 64), (40, 90), (90, 40)])
def test_steps_are_nearly_orthogonal_and_along_the_matrix_of_their_momentum(shape: tuple[int, int]) -> None:
    random = torch.randn((3, *shape), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    left, _, right = torch.linalg.svd(random, full_matrices=False)
    given = left @ torch.diag(torch.linspace(0.05, 1, min(shape), dtype=torch.float64)) @ right
    along = left.mT @ orthogonal(given) @ right.mT
    sizes = along.diagonal(dim1=1, dim2=2)
    assert float(sizes.min()) > 0.6 and float(sizes.max()) < 1.3
    assert float((along - torch.diag_embed(sizes)).abs().max()) < 1e-9


def test_matrices_move_as_by_pytorchs_muon_and_all_else_as_by_adamw() -> None:
    first, second, third = network(), network(), network()
    matrices = [each for each in second.parameters() if each.shape in {(64, 40), (64, 64)}]
    others = [
        build_optimiser(first, RECIPE),
        torch.optim.Muon(matrices, lr=0.01, weight_decay=0.1, adjust_lr_fn="match_rms_adamw"),
        build_optimiser(third, tiny_training(weight_decay=0.1, learning_rate=0.01)),
    ]
    for step in range(2):
        for own, optimiser in zip((first, second, third), others, strict=True):
            random = torch.Generator().manual_seed(step)
            for parameter in own.parameters():
                parameter.grad = torch.randn(parameter.shape, generator=random)
            optimiser.step()
    before, moved, muon, adamw = (each.state_dict() for each in (network(), first, second, third))
    for name in ("0.weight", "2.weight"):
        error = float((moved[name] - muon[name]).norm() / (moved[name] - before[name]).norm())
        assert error < 0.05, "PyTorch's is in bfloat16"
    kernel = before["3.weight"][..., 0].clone().requires_grad_()
    muon_of_kernel = torch.optim.Muon([kernel], lr=0.01, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    for step in range(2):
        random = torch.Generator().manual_seed(step)
        drawn = {name: torch.randn(parameter.shape, generator=random) for name, parameter in first.named_parameters()}
        kernel.grad = drawn["3.weight"][..., 0]
        muon_of_kernel.step()
    error = float(
        (moved["3.weight"][..., 0] - kernel.detach()).norm() / (kernel.detach() - before["3.weight"][..., 0]).norm()
    )
    assert error < 0.05, "a convolution is a matrix of its first axis by the others"
    alike = {name for name in moved if torch.equal(moved[name], adamw[name])}
    assert alike == {"0.bias", "2.bias", "3.bias", "4.weight", "4.bias"}


def test_a_step_that_is_not_finite_leaves_all_as_it_is() -> None:
    own, optimiser = of(RECIPE, steps=2)
    before, moments = copy.deepcopy((own.state_dict(), optimiser.state_dict()["state"]))
    for parameter in own.parameters():
        parameter.grad = torch.full_like(parameter, torch.nan)
    optimiser.found_inf = torch.ones(())  # type: ignore[attr-defined]
    optimiser.step()
    assert all(torch.equal(value, before[name]) for name, value in own.state_dict().items())
    now = optimiser.state_dict()["state"]
    for number, its in moments.items():
        assert now[number].keys() == its.keys() and all(torch.equal(now[number][name], its[name]) for name in its)
    assert sum("momentum" in its for its in moments.values()) == 3


def test_it_resumes_to_the_same_bits_and_refuses_the_state_of_others() -> None:
    whole, _ = of(RECIPE, steps=4)
    half, optimiser = of(RECIPE, steps=2)
    state = copy.deepcopy(optimiser.state_dict())
    resumed = build_optimiser(half, RECIPE)
    assert isinstance(resumed, Muon)
    load_optimiser(resumed, state)
    learn(half, resumed, range(2, 4))
    found: dict[str, Tensor] = half.state_dict()
    assert all(torch.equal(value, found[name]) for name, value in whole.state_dict().items())
    learned = of(tiny_training(), steps=1)[1].state_dict()
    for its in ({**state["state"][0], "momentum": torch.zeros(3)}, learned["state"][0]):
        wrong = {**state, "state": {**state["state"], 0: its}}
        with pytest.raises(ValueError, match="that of other parameters"):
            load_optimiser(resumed, wrong)


def test_ranks_share_the_matrices_and_all_take_the_same_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    shares: list[Tensor] = []
    monkeypatch.setattr("torch.distributed.all_reduce", lambda found: shares.append(found.clone()))
    for rank in range(2):
        own = network()
        learn(own, build_optimiser(own, RECIPE, rank=rank, ranks=2), range(1))
    assert not (shares[0] * shares[1]).any() and all(share.any() for share in shares)
    monkeypatch.setattr("torch.distributed.all_reduce", lambda found: found.copy_(shares[0] + shares[1]))
    shared, alone = network(), of(RECIPE, 1)[0]
    learn(shared, build_optimiser(shared, RECIPE, rank=1, ranks=2), range(1))
    assert all(torch.allclose(*pair, atol=1e-6) for pair in zip(shared.parameters(), alone.parameters(), strict=True))


def test_it_learns_in_float64_as_in_float32() -> None:
    exact, rough = network().double(), network()
    for own in (exact, rough):
        optimiser = build_optimiser(own, RECIPE)
        for name, parameter in own.named_parameters():
            random = torch.Generator().manual_seed(len(name))
            parameter.grad = torch.randn(parameter.shape, generator=random).to(parameter.dtype)
        optimiser.step()
    for name, value in exact.state_dict().items():
        torch.testing.assert_close(value.float(), rough.state_dict()[name], atol=1e-5, rtol=0)
