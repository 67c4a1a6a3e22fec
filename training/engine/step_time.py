"""How long a training step takes on this machine, tried before there are data."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import torch

from training.engine.optimization.optimizer import build_optimiser
from training.networks import network_from
from training.recipes.training import TrainingRecipe
from training.tracking.provenance import cores

_MORE = 1.6
"""A run's time over that of its steps alone: starts, batches, losses and measurements come on top. The quickstart's two
trainings took 1.6 and 1.7 times as long; the lower is taken."""
_SECONDS = 1.0  # how long steps are tried, after a first one
_LONG = 5.0  # a first step beyond which there is no second
_VERTICES = 4096  # of the meshes of a trial: examples beyond them are counted, not tried


class StepTime(NamedTuple):
    """Seconds of a step: ``now``, beside whatever else the machine does, and ``alone``, if it did nothing else."""

    now: float
    alone: float


def seconds_a_step(recipe: TrainingRecipe, *, vertices: int) -> StepTime:
    """Seconds of a step of so many vertices a mesh on this machine's CPU, all ranks at work, as a mean of a run.

    Random vertices go forward and back through a network of the recipe's, and its optimiser takes a step. Ranks are
    threads here, which share the cores as processes do. Alone it would take a rank's own thread about as long as that
    was on a core.
    """
    vertices = recipe.augmentation.subset or max(2, round(vertices * recipe.augmentation.vertices))
    share = -(-recipe.batch // recipe.ranks)
    tried = max(1, min(share, _VERTICES // vertices))
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, cores() // recipe.ranks))
    try:
        with ThreadPoolExecutor(recipe.ranks) as ranks:
            found = [ranks.submit(_tried, recipe, tried, share / tried, vertices) for _ in range(recipe.ranks)]
            times = [each.result() for each in found]
            return StepTime(*(_MORE * max(each) for each in zip(*times, strict=True)))
    finally:
        torch.set_num_threads(before)


def _tried(recipe: TrainingRecipe, examples: int, times: float, vertices: int) -> StepTime:
    network = network_from(recipe.network)
    optimiser = build_optimiser(network, recipe)
    source, target = torch.rand((2, examples, vertices, 3), generator=torch.Generator().manual_seed(0))

    def pass_through() -> None:
        optimiser.zero_grad()
        network(source=source, target=target).square().mean().backward()

    seconds: list[StepTime] = []
    began = time.perf_counter()
    while len(seconds) < 2 or time.perf_counter() - began < _SECONDS:
        passing, moving = _timed(pass_through), _timed(optimiser.step)
        share = recipe.ranks if recipe.optimiser == "muon" else 1  # which ranks share
        seconds.append(StepTime(*(one * times + other / share for one, other in zip(passing, moving, strict=True))))
        if seconds[0].now > _LONG:
            return seconds[0]
    return min(seconds[1:])  # the first one also allocates; what else the machine does for a moment makes others longer


def _timed(work: Callable[[], object]) -> StepTime:
    began, before = time.perf_counter(), time.thread_time()
    work()
    return StepTime(time.perf_counter() - began, time.thread_time() - before)
