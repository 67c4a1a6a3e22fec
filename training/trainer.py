"""The training step and the loop, the same under any launcher; reads only RANK, WORLD_SIZE, LOCAL_RANK, MASTER_*.

Read top to bottom: ``train`` -> ``_Trainer.run`` -> ``_Trainer.step``. Everything that varies is in the recipe; the
order of triples is a function of (seed, step), so the state of a run is its weights, its optimiser and one number.
"""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from datagen.errors import DsffnetError
from datagen.store import Dataset, open_dataset
from training.acceleration import autocast, products
from training.banks import open_bank
from training.batches import read_batch
from training.checkpoint import CheckpointError, load_checkpoint, read_checkpoint, save_checkpoint
from training.inference import network_from, predict
from training.journal import Journal
from training.losses import pose_transfer_loss
from training.metrics import point_mesh_distance
from training.ranks import (
    Ranks,
    StopRequest,
    TrainingError,
    TrainingStopped,
    alone_in,
    any_rank,
    decided_by_first,
    device_of,
    mean_over_ranks,
    process_group,
)
from training.recipe import TrainingRecipe
from training.triples import TripleOrder


def train(recipe: TrainingRecipe, *, data: str, run: Path) -> int:
    """Train until the recipe's last step, from the newest sound checkpoint of ``run`` if there is one.

    Parameters
    ----------
    recipe
        What to train and how.
    data
        Store URL of a complete dataset.
    run
        Folder of the run; rank 0 writes to it.

    Returns
    -------
    int
        The step reached, which is the recipe's last.

    Raises
    ------
    TrainingStopped
        After SIGTERM: the step was finished and a checkpoint written.
    TrainingError, DatasetError, CheckpointError, StorageError
        See their messages; the last good checkpoint is kept.
    """
    ranks = Ranks.from_environment()
    device = device_of(recipe, ranks)
    with process_group(ranks, recipe), alone_in(run, ranks), StopRequest(run) as stop:
        return _Trainer(recipe, open_dataset(data), run, ranks, device, stop).run()


class _Trainer:
    def __init__(
        self,
        recipe: TrainingRecipe,
        dataset: Dataset,
        run: Path,
        ranks: Ranks,
        device: torch.device,
        stop: StopRequest,
    ) -> None:
        if recipe.batch % ranks.count:
            raise TrainingError(f"batch {recipe.batch} cannot be shared equally by {ranks.count} ranks")
        self.recipe, self.dataset, self.folder, self.ranks = recipe, dataset, run, ranks
        self.device, self._stop, self.stopping = device, stop, False
        self.bank = open_bank(dataset, dataset.identities("training"), device=self.device, cache="device")
        self.order = TripleOrder(
            dataset.identities("training"), dataset.grid.poses("seen"), recipe.batch, seed=recipe.seed
        )
        self.last_step = recipe.steps or recipe.epochs * self.order.steps_per_epoch
        torch.manual_seed(recipe.seed)
        self.network = network_from(recipe.network).to(self.device)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay
        )
        self.schedule = _schedule(self.optimiser, recipe, self.order.steps_per_epoch, self.last_step)
        self.done = self._resume()
        self.model = DistributedDataParallel(self.network) if ranks.count > 1 else self.network
        self.is_writer = ranks.rank == 0

    def run(self) -> int:
        journal = Journal(self.folder / "metrics.jsonl") if self.is_writer else None
        probe = _EvaluationProbe(self.dataset, self.recipe, self.device) if self.is_writer else None
        meter = _Meter(self.recipe.batch)
        triples = self.order.batches(first_step=self.done, rank=self.ranks.rank, ranks=self.ranks.count)
        while self.done < self.last_step and not self.stopping:
            values = self.step(next(triples)[0], meter)
            self.done += 1
            last = self.done == self.last_step
            probing = self.done % self.recipe.evaluate_every == 0 or last
            if probing or self.done % self.recipe.log_every == 0:
                shared = mean_over_ranks(values, self.ranks)
                if journal and probe:
                    shared |= probe.measure(self.network) if probing else {}
                    journal.write(self.done, shared | meter.read())
            if self.done % self.recipe.checkpoint_every == 0 or last or self.stopping:
                self._save()
        if journal:
            journal.close()
        if self.done < self.last_step:
            raise TrainingStopped(
                f"stopped at step {self.done} of {self.last_step} as told; a checkpoint was written. "
                "Run the same command again to go on from here"
            )
        return self.done

    def step(self, triples: Any, meter: "_Meter") -> dict[str, Tensor | float]:
        """Forward, loss, backward, finite check over all ranks, clip, optimiser step."""
        with meter.waiting():
            batch = self.bank.batch(triples)
        self.optimiser.zero_grad(set_to_none=True)
        with products(self.recipe.precision):
            with autocast(self.recipe.precision, self.device):
                prediction = self.model(source=batch.source, target=batch.target)
            loss, terms = pose_transfer_loss(
                prediction, batch.truth, cast(Tensor, batch.edges), edge_weight=self.recipe.edge_weight
            )
            loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.recipe.gradient_clip or float("inf"))
        rate = self.schedule.get_last_lr()[0]
        self._agree_to_go_on(loss, norm, triples)
        self.optimiser.step()
        self.schedule.step()
        values: dict[str, Tensor | float] = {f"loss/{name}": value.detach() for name, value in terms.items()}
        return values | {"loss/total": loss.detach(), "gradient_norm": norm, "learning_rate": rate}

    def _agree_to_go_on(self, loss: Tensor, norm: Tensor, triples: Any) -> None:
        """One exchange between the ranks: stop all before the optimiser step if any loss or gradient is not finite,
        and after it if any was told to stop.
        """
        culprit = not bool(torch.isfinite(loss))
        bad = culprit or not bool(torch.isfinite(norm))
        any_bad, self.stopping = any_rank([bad, self._stop.made()], self.ranks)
        if any_bad:
            elsewhere = "on another rank" if self.ranks.count > 1 else "in the gradient only"
            where = f"this rank's triples were {triples.tolist()}" if culprit else elsewhere
            raise TrainingError(
                f"loss or gradient is not finite at step {self.done + 1} ({where}). "
                "The last good checkpoint is kept; lower training.learning_rate or set training.gradient_clip",
                secondary=not culprit,
            )

    def _save(self) -> None:
        """Rank 0 writes, all wait, and a failure to write stops every rank."""
        failure: DsffnetError | None = None
        if self.is_writer:
            try:
                save_checkpoint(
                    self.folder,
                    about={
                        "step": self.done,
                        "recipe": self.recipe.model_dump(mode="json"),
                        "dataset": self.dataset.uuid,
                    },
                    weights=self.network.state_dict(),
                    state={"optimiser": self.optimiser.state_dict(), "schedule": self.schedule.state_dict()},
                    keep=self.recipe.keep_checkpoints,
                )
            except DsffnetError as error:
                failure = error
        if any_rank([failure is not None], self.ranks)[0]:
            raise failure or TrainingError("rank 0 could not write a checkpoint", secondary=True)

    def _newest(self) -> str | None:
        found = load_checkpoint(self.folder)
        return str(found.path) if found else None

    def _resume(self) -> int:
        """The step to go on from. Rank 0 chooses the checkpoint, so that all ranks start from the same one."""
        path = decided_by_first(self.ranks, self._newest)
        if path is None:
            return 0
        found = read_checkpoint(Path(path))
        if found.dataset != self.dataset.uuid:
            raise CheckpointError(
                f"{self.folder} was trained on dataset {found.dataset}, not on {self.dataset.url} "
                f"({self.dataset.uuid}). Choose another --out, or add --fresh to start over"
            )
        self.recipe.require_same_learning(TrainingRecipe.model_validate(found.recipe), where=str(self.folder))
        state = found.state()
        self.network.load_state_dict(found.weights())
        self.optimiser.load_state_dict(state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])
        return found.step


class _EvaluationProbe:
    """PMD on a small fixed part of the evaluation lists, for the training curve."""

    def __init__(self, dataset: Dataset, recipe: TrainingRecipe, device: torch.device) -> None:
        self._batches = {}
        for pose_type in ("seen", "unseen"):
            triples = dataset.evaluation_triples(pose_type)[: recipe.evaluate_triples]
            if len(triples):
                self._batches[pose_type] = read_batch(dataset, triples).to(device)

    @torch.no_grad()
    def measure(self, network: nn.Module) -> dict[str, float]:
        network.eval()
        found = {}
        for pose_type, batch in self._batches.items():
            prediction = predict(network, batch)
            found[f"evaluation/pmd_{pose_type}"] = float(point_mesh_distance(prediction, batch.truth).mean())
        network.train()
        return found


class _Meter:
    """Throughput and the share of time spent waiting for input, since the last reading."""

    def __init__(self, batch: int) -> None:
        self._batch = batch
        self._reset()

    def _reset(self) -> None:
        self._began, self._waited, self._steps = time.perf_counter(), 0.0, 0

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self._waited += time.perf_counter() - began
        self._steps += 1

    def read(self) -> dict[str, float]:
        seconds = time.perf_counter() - self._began
        found = {"meshes_per_second": self._steps * self._batch / seconds, "input_wait": self._waited / seconds}
        self._reset()
        return found


def _schedule(
    optimiser: torch.optim.Optimizer, recipe: TrainingRecipe, steps_per_epoch: int, steps: int
) -> torch.optim.lr_scheduler.LRScheduler:
    schedule = recipe.schedule
    if schedule.name == "one_cycle":
        return torch.optim.lr_scheduler.OneCycleLR(
            optimiser,
            recipe.learning_rate,
            total_steps=steps + 1,
            pct_start=schedule.warm_up or 0.1,
            cycle_momentum=False,
        )
    return torch.optim.lr_scheduler.StepLR(
        optimiser, step_size=schedule.decay_epochs * steps_per_epoch, gamma=schedule.decay
    )
