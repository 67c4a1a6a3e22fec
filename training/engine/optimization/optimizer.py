"""Optimiser, learning rate over the run, and averaged weights, by the recipe.

All three are the same on every rank without a word between them, and resume as if nothing had happened:
the learning rate is a function of the step alone, and the average one of the weights that every rank has.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from training.engine.optimization.muon import Muon
from training.recipes.networks import AvatarRecipe
from training.recipes.training import ScheduleRecipe, TrainingRecipe

ONE_CYCLE_FIRST = 1 / 25
"""A one-cycle schedule's first factor (PyTorch's ``OneCycleLR``, ``div_factor``)."""


def build_optimiser(
    network: nn.Module, recipe: TrainingRecipe, *, rank: int = 0, ranks: int = 1
) -> torch.optim.Optimizer:
    """Return the recipe's optimiser of all parameters, on one of so many ranks; those of an avatar's points may have
    their own learning rate.

    In Adam weight decay is part of the gradient, in AdamW it is not (Loshchilov and Hutter, ICLR 2019). The fused
    form updates all parameters in one pass: on one core, 9.4 million in 5.5 ms instead of 24. Its bits depend neither
    on the number of threads nor on where in memory a parameter lies.
    """
    rates: dict[str, Any] = {"lr": recipe.learning_rate, "weight_decay": recipe.weight_decay}
    rates |= {"betas": recipe.betas, "eps": recipe.epsilon}
    if recipe.optimiser == "muon":
        return Muon(network.parameters(), **rates, rank=rank, ranks=ranks)
    kind = {"adamw": torch.optim.AdamW, "adam": torch.optim.Adam}[recipe.optimiser]
    return kind(_groups(network, recipe), **rates, fused=True)


def _groups(network: nn.Module, recipe: TrainingRecipe) -> list[dict[str, Any]]:
    """Parameters by the ``factor`` of their learning rate."""
    factor = recipe.network.features_rate if isinstance(recipe.network, AvatarRecipe) else 1.0
    if factor == 1:
        return [{"params": list(network.parameters())}]
    shared = [parameter for name, parameter in network.named_parameters() if name != "features"]
    return [{"params": shared}, {"params": [network.features], "factor": factor}]


def load_optimiser(optimiser: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """Resume from the moments in an optimiser's state; its hyperparameters stay those of the recipe.

    So does the fused form, which alone leaves out a step that is not finite.

    Raises
    ------
    ValueError
        They are not those of the parameters.
    """
    optimiser.load_state_dict({"state": state["state"], "param_groups": optimiser.state_dict()["param_groups"]})
    matrices = set(map(id, optimiser.param_groups[0]["params"])) if isinstance(optimiser, Muon) else set()
    for parameter, moments in optimiser.state.items():
        names = _MOMENTUM if id(parameter) in matrices else _MOMENTS
        if not (isinstance(parameter, Tensor) and moments.keys() == names and _fit(moments, parameter)):
            raise ValueError("the optimiser's state is that of other parameters")


_MOMENTS, _MOMENTUM = {"step", "exp_avg", "exp_avg_sq"}, {"step", "momentum"}
"""What Adam and AdamW keep of a parameter, and Muon of a matrix."""


def _fit(moments: Mapping[str, Any], parameter: Tensor) -> bool:
    return all(
        isinstance(value, Tensor)
        and value.layout == torch.strided
        and value.shape == (torch.Size() if name == "step" else parameter.shape)
        for name, value in moments.items()
    )


def build_schedule(
    optimiser: torch.optim.Optimizer, recipe: TrainingRecipe, *, steps_per_epoch: int, steps: int
) -> Schedule:
    """Return the recipe's learning rate over a run of `steps`, and set the first step's."""

    def rate(step: int) -> float:
        factor = schedule_factor(recipe.schedule, step, steps_per_epoch=steps_per_epoch, steps=steps)
        return recipe.learning_rate * factor

    return Schedule(optimiser, rate)


def schedule_factor(recipe: ScheduleRecipe, step: int, *, steps_per_epoch: int, steps: int) -> float:
    """Return the part of the highest learning rate that a step has, in [0, 1].

    Parameters
    ----------
    recipe
        The schedule.
    step
        Steps done before this one; at `steps` and after, what the curve ends with.
    steps_per_epoch
        For the step schedule, which counts epochs.
    steps
        Steps of the whole run, which all other schedules span.
    """
    rise = steps * recipe.rise
    step = min(step, steps)
    if recipe.name == "one_cycle" and step < rise:
        return ONE_CYCLE_FIRST + (1 - ONE_CYCLE_FIRST) * (1 - _cosine_fall(step / rise))
    # one more in both, so that the first step moves too
    warmed = 1.0 if recipe.name == "one_cycle" else min(1.0, (step + 1) / (rise + 1))
    if recipe.name == "constant":
        return warmed
    if recipe.name == "step":
        return warmed * recipe.decay ** (step // (recipe.decay_epochs * steps_per_epoch))
    falls_from = recipe.hold * steps if recipe.name == "linear" else rise
    fallen = max(0.0, step - falls_from) / max(steps - falls_from, 1e-9)  # held to the end: never falls
    return warmed * (1 - fallen if recipe.name == "linear" else _cosine_fall(fallen))


def _cosine_fall(part: float) -> float:
    """Half a cosine from 1 at 0 to 0 at 1."""
    return (1 + math.cos(math.pi * part)) / 2


class Schedule:
    """Sets an optimiser's learning rate before every step; its whole state is the number of steps done.

    Unlike PyTorch's schedulers it computes every rate from the step and none from the one before, so that a resume
    cannot jump, and leaves the optimiser's methods alone.

    Parameters
    ----------
    optimiser
        Whose learning rates to set; that of the first step at once. A group of parameters with a ``factor`` has so many
        times the rate.
    rate
        Learning rate by the number of steps done before.
    """

    def __init__(self, optimiser: torch.optim.Optimizer, rate: Callable[[int], float]) -> None:
        self._optimiser, self._rate, self._done = optimiser, rate, 0
        self._set()

    @property
    def done(self) -> int:
        """Steps done."""
        return self._done

    def step(self) -> None:
        """Say that a step of the optimiser is done."""
        self._done += 1
        self._set()

    def get_last_lr(self) -> list[float]:
        """Return the learning rate of the next step, for each group of parameters."""
        return [float(group["lr"]) for group in self._optimiser.param_groups]

    def state_dict(self) -> dict[str, int]:
        """Return what :meth:`load_state_dict` takes."""
        return {"step": self._done}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Resume from there. The optimiser's own state, if any, must be loaded before.

        Raises
        ------
        ValueError
            It holds no number of steps.
        """
        self._done = _counted(state["step"])
        self._set()

    def _set(self) -> None:
        for group in self._optimiser.param_groups:
            group["lr"] = self._rate(self._done) * group.get("factor", 1.0)


class WeightAverage:
    """Exponential moving average of a network's parameters (EMA), to be evaluated in their place.

    ``average = d average + (1 - d) weights`` after every step, with ``d = min(decay, (1 + n) / (10 + n))`` at the
    n-th (from 0), so that the random weights of the beginning are soon forgotten (TensorFlow's
    ``ExponentialMovingAverage``). Buffers are copied.

    Parameters
    ----------
    network
        The network itself, not its distributed wrapper.
    decay
        In (0, 1); the average reaches back about ``1 / (1 - decay)`` steps.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self._decay, self._updates = decay, 0
        self._averaged = [name for name, _ in network.named_parameters()]
        self.weights: dict[str, Tensor] = _copy(network.state_dict())

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Take in the weights after a step."""
        decay = min(self._decay, (1 + self._updates) / (10 + self._updates))
        self._updates += 1
        now = network.state_dict()
        move = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]
        move([self.weights[name] for name in self._averaged], [now[name] for name in self._averaged], None)
        _copy_into(self.weights, {name: now[name] for name in now.keys() - set(self._averaged)})

    @contextmanager
    def swapped_in(self, network: nn.Module) -> Iterator[None]:
        """Give the network the averaged weights while the block runs; then it has its own again, bit by bit."""
        values = network.state_dict()
        own = _copy(values)
        _copy_into(values, self.weights)
        try:
            yield
        finally:
            _copy_into(values, own)

    def state_dict(self) -> dict[str, Any]:
        """Return what :meth:`load_state_dict` takes; not copied."""
        return {"updates": self._updates, "weights": self.weights}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from there.

        Raises
        ------
        ValueError
            The state is of another network, or holds no number of updates.
        """
        if state["weights"].keys() != self.weights.keys():
            other = sorted(state["weights"].keys() ^ self.weights.keys())
            raise ValueError(f"averaged weights of another network: {other[0]} is in one of the two only")
        self._updates = _counted(state["updates"])
        _copy_into(self.weights, state["weights"])


def _counted(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"{type(value).__name__} instead of a number of steps")
    return value


def _copy(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


@torch.no_grad()
def _copy_into(places: Mapping[str, Tensor], values: Mapping[str, Tensor]) -> None:
    for name, value in values.items():
        places[name].copy_(value)
