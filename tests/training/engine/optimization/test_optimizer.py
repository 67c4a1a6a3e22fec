"""Optimiser, schedules and averaged weights: as their formulas say, and after a resume as if there had been none."""

from __future__ import annotations

import copy
import math
import warnings
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.support.recipes import tiny_training
from tests.support.shapes.avatars import avatar, sphere
from training.engine.optimization.optimizer import (
    Schedule,
    WeightAverage,
    build_optimiser,
    build_schedule,
    schedule_factor,
)
from training.inference.predict import network_from
from training.recipes.training import ScheduleRecipe, TrainingRecipe

SCHEDULES: list[dict[str, Any]] = [
    {"name": "step", "decay_epochs": 1},
    {"name": "step", "warm_up": 0.25},
    {"name": "one_cycle"},
    {"name": "cosine", "warm_up": 0.2},
    {"name": "linear"},
    {"name": "linear", "hold": 1.0},
    {"name": "constant"},
    {"name": "constant", "warm_up": 0.5},
]


def factors(steps: int = 100, steps_per_epoch: int = 10, **schedule: Any) -> list[float]:
    recipe = ScheduleRecipe(**schedule)
    return [schedule_factor(recipe, step, steps_per_epoch=steps_per_epoch, steps=steps) for step in range(steps + 1)]


def test_step_is_the_papers() -> None:
    found = factors(steps=170, name="step")
    assert found[0] == found[79] == 1
    assert found[80] == found[159] == pytest.approx(0.8)
    assert found[160] == pytest.approx(0.64)


def test_cosine_rises_in_a_line_and_falls_to_zero() -> None:
    found = factors(name="cosine", warm_up=0.2)
    assert found[0] == pytest.approx(1 / 21) and found[10] == pytest.approx(11 / 21)
    assert found[20] == 1 and found[60] == pytest.approx(0.5) and found[100] == 0
    assert found[40] == pytest.approx((1 + math.sqrt(0.5)) / 2)
    assert factors(name="cosine")[0] == 1  # without warm-up, which is the default, the first step is the highest


def test_one_cycle_rises_in_a_tenth_of_the_steps_and_falls_to_zero() -> None:
    found = factors(name="one_cycle")
    assert found[0] == pytest.approx(1 / 25) and found[5] == pytest.approx((1 + 1 / 25) / 2)
    assert found[10] == 1 and found[55] == pytest.approx(0.5) and found[100] == 0
    assert factors(name="one_cycle", warm_up=0.0)[0] == 1
    assert factors(name="one_cycle", warm_up=0.4)[40] == 1


def test_linear_is_held_and_falls_in_a_line() -> None:
    found = factors(name="linear")  # 3D-CoreNet: 100 epochs and 100
    assert set(found[:51]) == {1.0}
    assert found[75] == pytest.approx(0.5) and found[99] == pytest.approx(0.02) and found[100] == 0
    early = factors(name="linear", hold=0.0, warm_up=0.0)
    assert early[0] == 1 and early[25] == pytest.approx(0.75)
    assert set(factors(name="linear", hold=1.0)) == {1.0}


def test_constant_rises_and_stays() -> None:
    assert set(factors(name="constant")) == {1.0}
    found = factors(name="constant", warm_up=0.5)
    assert found[0] == pytest.approx(1 / 51) and found[49] == pytest.approx(50 / 51) and found[50] == found[100] == 1


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("steps", [1, 2, 7, 100])
def test_no_schedule_is_negative_jumps_up_or_ends_in_an_error(schedule: dict[str, Any], steps: int) -> None:
    found = factors(steps=steps, **schedule)
    assert all(0 <= factor <= 1 for factor in found)
    assert found[0] > 0
    recipe = ScheduleRecipe(**schedule)
    assert schedule_factor(recipe, steps + 50, steps_per_epoch=10, steps=steps) == found[-1]
    if steps == 100:
        assert max(found) == 1
        assert max(after - before for before, after in pairwise(found)) < 0.16


def _network(seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    return network_from(tiny_training().network)


def _learn(network: nn.Module, optimiser: torch.optim.Optimizer, schedule: Schedule, steps: range) -> list[float]:
    rates = []
    for step in steps:
        generator = torch.Generator().manual_seed(step)
        source, target = (torch.randn(2, 9, 3, generator=generator) for _ in range(2))
        optimiser.zero_grad()
        network(source=source, target=target).square().mean().backward()
        rates += schedule.get_last_lr()
        optimiser.step()
        schedule.step()
    return rates


def _begin(recipe: TrainingRecipe) -> tuple[nn.Module, torch.optim.Optimizer, Schedule]:
    network = _network()
    optimiser = build_optimiser(network, recipe)
    return network, optimiser, build_schedule(optimiser, recipe, steps_per_epoch=3, steps=10)


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("optimiser", ["adamw", "adam", "muon"])
def test_stop_and_resume_is_the_same_bits_and_warns_of_nothing(schedule: dict[str, Any], optimiser: Any) -> None:
    recipe = TrainingRecipe.model_validate({"schedule": schedule, "optimiser": optimiser, "weight_decay": 0.1})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = _begin(recipe)
        rates = _learn(*whole, range(10))
        network, *others = _begin(recipe)
        first_rates = _learn(network, *others, range(4))
        state = copy.deepcopy([each.state_dict() for each in (network, *others)])
        resumed = _begin(recipe)
        for part, values in zip(resumed, state, strict=True):
            part.load_state_dict(values)
        rest_rates = _learn(*resumed, range(4, 10))
    assert first_rates + rest_rates == rates
    expected, found = whole[0].state_dict(), resumed[0].state_dict()
    assert all(torch.equal(found[name], expected[name]) for name in expected)


def test_points_of_an_avatar_have_a_learning_rate_of_their_own() -> None:
    network = avatar(sphere())
    recipe = TrainingRecipe.model_validate(
        {"network": {"name": "avatar", "features_rate": 3.0}, "optimiser": "adam", "weight_decay": 0, "epsilon": 1e-30}
    )
    before = copy.deepcopy(network)
    optimiser = build_optimiser(network, recipe)
    schedule = build_schedule(optimiser, recipe, steps_per_epoch=1, steps=10)
    assert schedule.get_last_lr() == [recipe.learning_rate, 3 * recipe.learning_rate]
    for parameter in network.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimiser.step()
    moved = {
        name: (was - now).mean().item()
        for (name, now), was in zip(network.named_parameters(), before.parameters(), strict=True)
    }
    assert moved.pop("features") == pytest.approx(3 * recipe.learning_rate, rel=1e-3)
    assert all(way == pytest.approx(recipe.learning_rate, rel=1e-3) for way in moved.values())


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"optimiser": "adam", "weight_decay": 0.3},
        {"optimiser": "adam", "betas": (0.0, 0.9), "epsilon": 1e-3, "weight_decay": 0.0, "learning_rate": 1e-4},
        {"betas": (0.8, 0.99), "epsilon": 0.1, "weight_decay": 0.5},
    ],
)
def test_a_step_of_the_optimiser_is_its_formula(changes: dict[str, Any]) -> None:
    recipe = TrainingRecipe(**changes)
    layer = nn.Linear(3, 2, bias=False).double()
    weight = layer.weight.detach().clone()
    gradient = torch.tensor([[1.0, -2.0, 0.5], [0.0, 1e-3, 4.0]]).double()
    layer.weight.grad = gradient.clone()
    build_optimiser(layer, recipe).step()
    if recipe.optimiser == "adam":
        gradient = gradient + recipe.weight_decay * weight
    else:
        weight = weight * (1 - recipe.learning_rate * recipe.weight_decay)
    # at the first step the bias-free means are the gradient and its square, whatever the betas
    expected = weight - recipe.learning_rate * gradient / (gradient.abs() + recipe.epsilon)
    torch.testing.assert_close(layer.weight.detach(), expected, rtol=1e-12, atol=1e-12)


class _Counting(nn.Module):
    """A parameter, a number counted in a buffer, and one of floats."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(2, dtype=torch.float64))
        self.register_buffer("seen", torch.tensor(0))
        self.register_buffer("scale", torch.tensor(1.0))

    def set(self, value: float) -> None:
        with torch.no_grad():
            self.weight.fill_(value)
            self.seen += 1  # type: ignore[operator]
            self.scale.fill_(value)  # type: ignore[union-attr, operator]


def test_the_average_is_its_recurrence_and_buffers_are_the_newest() -> None:
    network = _Counting()
    average = WeightAverage(network, decay=0.3)
    expected = 0.0
    for update, value in enumerate([1.0, 5.0, -2.0, 4.0, 8.0]):
        network.set(value)
        average.update(network)
        decay = min(0.3, (1 + update) / (10 + update))
        expected = decay * expected + (1 - decay) * value
    assert average.weights["weight"].tolist() == pytest.approx([expected] * 2, rel=1e-12)
    assert int(average.weights["seen"]) == 5 and float(average.weights["scale"]) == 8.0
    assert not average.weights["weight"].requires_grad


def test_averaged_weights_are_evaluated_and_the_own_come_back_bit_by_bit() -> None:
    network = _network()
    average = WeightAverage(network, decay=0.9)
    optimiser, before = torch.optim.SGD(network.parameters(), lr=0.1), copy.deepcopy(average.weights)
    _learn(network, optimiser, Schedule(optimiser, lambda _: 0.1), range(2))
    average.update(network)
    own = copy.deepcopy(network.state_dict())
    places = [parameter.data_ptr() for parameter in network.parameters()]
    with pytest.raises(KeyboardInterrupt), average.swapped_in(network):
        inside = copy.deepcopy(network.state_dict())
        raise KeyboardInterrupt
    assert _same(network.state_dict(), own) and _same(inside, average.weights)
    assert not _same(inside, own) and not _same(inside, before)
    assert [parameter.data_ptr() for parameter in network.parameters()] == places  # what is compiled still holds
    assert all(parameter.requires_grad for parameter in network.parameters())


def test_a_resumed_average_is_the_same_bits(tmp_path: Any) -> None:
    network = _Counting()
    whole, first = WeightAverage(network, 0.5), WeightAverage(network, 0.5)
    for value in (3.0, 4.0):
        network.set(value)
        whole.update(network)
        first.update(network)
    torch.save(first.state_dict(), tmp_path / "average.pt")
    resumed = WeightAverage(_Counting(), 0.5)
    resumed.load_state_dict(torch.load(tmp_path / "average.pt", weights_only=True))
    for value in (1.0, 1 / 3):
        network.set(value)
        whole.update(network)
        resumed.update(network)
    assert _same(resumed.weights, whole.weights)
    with pytest.raises(ValueError, match=r"averaged weights of another network: .* is in one of the two only"):
        resumed.load_state_dict(WeightAverage(nn.Linear(2, 2), 0.5).state_dict())


def _same(first: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return first.keys() == other.keys() and all(torch.equal(first[name], other[name]) for name in first)
