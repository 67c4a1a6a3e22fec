"""What learns: a network, its optimiser, its schedule, the average of its weights; and one step of them.

    step -> for each part of the batch: forward, loss, backward -> clip -> optimiser, schedule, average

A step whose gradient is not finite changes nothing, nor does any after it: the fused optimisers leave weights and
state alone where a flag on the device says so. Nobody waits for that flag: the trainer reads it now and then, and
before it writes anything. (The average of the weights moves on towards the weights that stay; the trainer ends there,
without a checkpoint, so that this average is neither kept nor evaluated.)
"""

import contextlib
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from training.checkpoints.checkpoint import Checkpoint
from training.checkpoints.weights import fill_network
from training.engine.distributed import Ranks
from training.engine.optimization.optimizer import WeightAverage, build_optimiser, build_schedule, load_optimiser
from training.engine.tasks.protocol import Batch, Task
from training.inference.predict import load_weights
from training.networks.execution import products
from training.recipes.training import TrainingRecipe


class Learner:
    """A training's state but for its counters, and its step.

    Parameters
    ----------
    recipe
        Network, losses, optimiser, schedule, precision.
    ranks
        Whether gradients are averaged over processes.
    device
        Where it learns.
    steps_per_epoch, steps
        What the schedule spans.
    task
        Whose network learns by which objective.
    start
        Whose weights to begin from instead of random ones.
    """

    def __init__(
        self,
        recipe: TrainingRecipe,
        ranks: Ranks,
        device: torch.device,
        *,
        steps_per_epoch: int,
        steps: int,
        task: Task,
        start: Checkpoint | None = None,
    ) -> None:
        self.recipe, self._ranks, self.device, self._task = recipe, ranks, device, task
        self.dtype = torch.float64 if recipe.precision == "float64" else torch.float32
        torch.manual_seed(recipe.seed)
        network = task.network()
        if start:
            load_weights(network, start)
        self.network = network.to(device, self.dtype)
        self.optimiser = build_optimiser(self.network, recipe, rank=ranks.rank, ranks=ranks.count)
        self.schedule = build_schedule(self.optimiser, recipe, steps_per_epoch=steps_per_epoch, steps=steps)
        self.average = WeightAverage(self.network, recipe.average) if recipe.average else None
        self._bad_step = torch.zeros((), dtype=torch.int64, device=device)

    def step(self, parts: Sequence[Batch], *, share: float = 1.0) -> dict[str, Tensor | float]:
        """Learn from the parts of this rank's share of a batch; returns losses, gradient norm and learning rate.

        ``share`` is how much more of the batch this rank has than the mean rank; gradients are averaged over ranks.
        """
        self.optimiser.zero_grad(set_to_none=True)
        count = sum(len(part) for part in parts)
        losses: dict[str, Tensor] = {}
        with products(self.recipe.precision), self._accumulation():
            for number, part in enumerate(parts):
                weight = share * len(part) / count
                for name, value in self._backward(part, weight, last=number == len(parts) - 1).items():
                    losses[name] = losses[name] + value * weight if number else value * weight
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.gradient_clip or float("inf"))
        rate = self.schedule.get_last_lr()[0]
        self._apply(norm, losses["total"])
        values: dict[str, Tensor | float] = {f"loss/{name}": value for name, value in losses.items()}
        return values | {"gradient_norm": norm, "learning_rate": rate}

    def _accumulation(self) -> contextlib.AbstractContextManager[Any]:
        """While the parts of a step run: what the network keeps the same over them, see `training.networks`."""
        accumulation = getattr(self.network, "accumulation", contextlib.nullcontext)
        return cast(contextlib.AbstractContextManager[Any], accumulation())

    @property
    def bad_step(self) -> int:
        """The first step that was not finite on this rank, counted from 1; 0 if there is none. Waits for the device."""
        return int(self._bad_step)

    @contextlib.contextmanager
    def evaluated(self) -> Iterator[None]:
        """While the block runs, the network is in evaluation mode, without gradients; with averaged weights, if any."""
        averaged = self.average.swapped_in(self.network) if self.average else contextlib.nullcontext()
        with averaged, torch.no_grad():
            self.network.eval()
            try:
                yield
            finally:
                self.network.train()

    def state(self) -> dict[str, Any]:
        """All that a step depends on but the weights and their average, which have files of their own."""
        state: dict[str, Any] = {"optimiser": self.optimiser.state_dict(), "schedule": self.schedule.state_dict()}
        return state | ({"averaged": self.average.state_dict()["updates"]} if self.average else {})

    def load(self, checkpoint: Checkpoint, state: Mapping[str, Any]) -> None:
        """Resume from a checkpoint and its state."""
        fill_network(self.network, checkpoint.weights(), where=str(checkpoint.path))
        load_optimiser(self.optimiser, state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])
        if self.average:
            self.average.load_state_dict({"updates": state["averaged"], "weights": checkpoint.weights(average=True)})

    def _backward(self, batch: Batch, weight: float, *, last: bool) -> dict[str, Tensor]:
        with self._in_step_with_others(last):
            losses = self.model(batch.in_dtype(self.dtype), step=self.schedule.done)
            (losses["total"] * weight).backward()
        return {name: loss.detach() for name, loss in losses.items()}

    @functools.cached_property
    def model(self) -> nn.Module:
        """The objective that a step calls, averaging gradients over ranks. Made at the first step, after loading."""
        model = self._task.objective(self.network, self.device)
        return DistributedDataParallel(model) if self._ranks.count > 1 else model

    def _in_step_with_others(self, last: bool) -> contextlib.AbstractContextManager[Any]:
        """Gradients are averaged over ranks once, in the last part's backward pass."""
        model = self.model
        return model.no_sync() if isinstance(model, DistributedDataParallel) and not last else contextlib.nullcontext()

    def _apply(self, norm: Tensor, loss: Tensor) -> None:
        bad = ~(torch.isfinite(norm) & torch.isfinite(loss)) & (self._bad_step == 0)
        self._bad_step = torch.where(bad, self.schedule.done + 1, self._bad_step)
        flag = (self._bad_step > 0).float()
        self.optimiser.found_inf = flag  # type: ignore[attr-defined]  # read by fused optimisers
        self.optimiser.step()
        self.schedule.step()
        if self.average:
            self.average.update(self.network)
