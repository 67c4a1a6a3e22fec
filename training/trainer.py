"""The training loop, the same under any launcher; reads only RANK, WORLD_SIZE, LOCAL_RANK, MASTER_*.

Read top to bottom: ``train`` -> ``_Trainer.run`` -> ``_Trainer._step``, then :mod:`training.learner`. Everything that
varies is in the recipe; the order of triples is a function of (seed, step), so the state of a run is its weights, its
optimiser, the average of its weights and a few numbers.
"""

import contextlib
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from datagen.errors import DsffnetError
from datagen.store import Dataset, open_dataset
from training.augmentation import Augmentation
from training.banks import open_bank
from training.batches import Batch
from training.checkpoint import CheckpointError, load_checkpoint, read_checkpoint, save_checkpoint
from training.journal import Journal
from training.learner import Learner
from training.machine import sampling
from training.meter import Meter
from training.probe import Probe, Verdict
from training.progress import Progress
from training.random_states import random_states, restore_random_state
from training.ranks import (
    BudgetSpent,
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
from training.recipe import TrainingRecipe, budget_seconds
from training.snapshots import snapshot_path
from training.triples import TripleOrder

log = logging.getLogger(__name__)
_CHECK_EVERY = {"cpu": 1, "cuda": 16}
"""Steps between looks at whether all is finite and nobody asked to stop. On a GPU each look waits for its queue."""
_SAY_EVERY = 20.0
"""Seconds between lines of the log."""


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
        The step reached: the recipe's last, or that at which early stopping ended the training.

    Raises
    ------
    TrainingStopped
        After SIGTERM: the step was finished and a checkpoint written.
    BudgetSpent
        The recipe's time budget for one command is used up; a checkpoint was written.
    TrainingError, DatasetError, CheckpointError, StorageError
        See their messages; the last good checkpoint is kept.
    """
    began = time.monotonic()
    ranks = Ranks.from_environment()
    device = device_of(recipe, ranks)
    with process_group(ranks, recipe), alone_in(run, ranks), StopRequest(run) as stop:
        # The trainer must be gone before its process group is: see tests/training/one_rank.py.
        return _Trainer(recipe, open_dataset(data), run, ranks, device, stop, began).run()


class _Trainer:
    def __init__(
        self,
        recipe: TrainingRecipe,
        dataset: Dataset,
        run: Path,
        ranks: Ranks,
        device: torch.device,
        stop: StopRequest,
        began: float,
    ) -> None:
        self.recipe, self.dataset, self.folder, self.ranks = recipe, dataset, run, ranks
        self.device, self._stop, self._began = device, stop, began
        identities = dataset.identities("training")
        self.order = TripleOrder(identities, dataset.grid.poses("seen"), recipe.batch, seed=recipe.seed)
        self.last_step = self.order.last_step(recipe.epochs, recipe.steps)
        self.bank = open_bank(
            dataset,
            identities,
            device=device,
            cache=recipe.cache,
            folder=recipe.cache_folder,
            sharers=ranks.here,
            edge_sum=recipe.edge_sum,
        )
        self.learner = Learner(recipe, ranks, device, steps_per_epoch=self.order.steps_per_epoch, steps=self.last_step)
        self.done, self.verdict, self.finished = 0, Verdict(), False
        self._resume()
        self.meter = Meter(recipe.batch)
        self.progress = Progress(steps=self.last_step, steps_per_epoch=self.order.steps_per_epoch)
        self._said = time.monotonic()
        self.is_writer = ranks.rank == 0
        self.stopping = self.out_of_time = False
        self._recent: list[tuple[int, Any, Any]] = []

    def run(self) -> int:
        self.probe = Probe(self.dataset, self.recipe, self.device, self.learner.dtype) if self.is_writer else None
        self.journal = Journal(self.folder / "metrics.jsonl") if self.is_writer else None
        if self.is_writer:
            log.info("training meshes are kept in %s", self.bank.where)
        with contextlib.ExitStack() as around:
            around.callback(self.bank.close)
            if self.journal:
                around.callback(self.journal.close)
                around.enter_context(sampling(self.folder / "system.jsonl"))
            batches = self._batches()
            while self.done < self.last_step and not (self.finished or self.stopping or self.out_of_time):
                self._step(batches)
        if self.done < self.last_step and not self.finished:
            self._stopped_early()
        return self.done

    def _step(self, batches: Iterator[tuple[Any, list[Batch]]]) -> None:
        """One step, and what is due after it."""
        with self.meter.waiting():
            triples, parts = next(batches)
        values = self.learner.step(parts, share=self.order.share(rank=self.ranks.rank, ranks=self.ranks.count))
        self.done += 1
        self._recent.append((self.done, triples, values["loss/total"]))
        last = self.done == self.last_step
        probing = last or self._due(self.recipe.evaluate_every)
        logging_now = probing or self._due(self.recipe.log_every)
        saving = last or self._due(self.recipe.checkpoint_every)
        if logging_now or saving or self._due(_CHECK_EVERY[self.device.type]):
            self._agree_to_go_on()
        if logging_now:
            self._log(values, probing)
        if self.probe and self._due(self.recipe.picture_every):
            self._draw(self.probe)
        if saving or self.stopping or self.out_of_time or self.finished or (probing and self.verdict.improved):
            self._save(best=probing and self.verdict.improved)

    def _due(self, every: int | None) -> bool:
        return every is not None and self.done % every == 0

    def _batches(self) -> Iterator[tuple[Any, list[Batch]]]:
        """This rank's share of every step's triples, in parts, and their meshes on the device."""
        mine = {"rank": self.ranks.rank, "ranks": self.ranks.count, "parts": self.recipe.accumulate}
        places, augment = self.order.places(**mine), Augmentation(self.recipe)
        shares = self.bank.prefetch(self.order.batches(first_step=self.done, **mine))
        for step, share in enumerate(shares, self.done):
            yield (
                share,
                [
                    augment(self.bank.batch(triples), step=step, first=first)
                    for triples, first in zip(share, places, strict=True)
                ],
            )

    def _agree_to_go_on(self) -> None:
        """One exchange between the ranks: whether any gradient was not finite, and whether any was told to stop."""
        bad = not self.learner.finite
        recent, self._recent = self._recent, []
        any_bad, self.stopping, self.out_of_time = any_rank([bad, self._stop.made(), self._spent()], self.ranks)
        if any_bad:
            self._not_finite(recent)

    def _spent(self) -> bool:
        budget = self.recipe.budget
        return budget is not None and time.monotonic() - self._began > budget_seconds(budget)

    def _not_finite(self, recent: list[tuple[int, Any, Any]]) -> None:
        culprits = [(step, triples) for step, triples, loss in recent if not bool(torch.isfinite(loss))]
        step, triples = culprits[0] if culprits else recent[0][:2]
        elsewhere = "on another rank" if self.ranks.count > 1 else "in the gradient only"
        where = f"this rank's triples were {np.concatenate(triples).tolist()}" if culprits else elsewhere
        raise TrainingError(
            f"loss or gradient is not finite at step {step} ({where}). Nothing was learned from it. "
            "The last good checkpoint is kept; lower training.learning_rate or set training.gradient_clip",
            secondary=not culprits,
        )

    def _log(self, values: dict[str, Any], probing: bool) -> None:
        shared = mean_over_ranks(values, self.ranks)
        measured: dict[str, float] = {}
        if self.probe and probing:
            with self.learner.evaluated():
                measured = self.probe.measure(self.learner.network)
        if probing:
            self.verdict, self.finished = decided_by_first(self.ranks, lambda: self._judge(measured))
        if self.journal:
            self.journal.write(self.done, shared | measured | self.meter.read())
            self._say(shared | measured)

    def _say(self, row: dict[str, float]) -> None:
        """For launchers that show nothing themselves; at intervals."""
        self.progress.add({"step": self.done, "time": time.time(), **row})
        if time.monotonic() - self._said > _SAY_EVERY or self.done == self.last_step:
            log.info("%s", self.progress.line())
            self._said = time.monotonic()

    def _judge(self, measured: dict[str, float]) -> tuple[Verdict, bool]:
        assert self.probe is not None
        verdict = self.verdict.after(self.probe.decisive(measured))
        return verdict, verdict.gives_up(self.recipe.early_stopping)

    def _draw(self, probe: Probe) -> None:
        with self.learner.evaluated():
            probe.draw(self.learner.network, snapshot_path(self.folder, self.done), title=f"step {self.done:,}")

    def _save(self, *, best: bool) -> None:
        """Rank 0 writes, all wait, and a failure to write stops every rank."""
        failure: DsffnetError | None = None
        if self.journal:
            self.journal.sync()
        random = random_states(self.ranks.count)
        if self.is_writer:
            try:
                save_checkpoint(
                    self.folder,
                    about={
                        "step": self.done,
                        "finished": self.finished or self.done == self.last_step,
                        "recipe": self.recipe.model_dump(mode="json"),
                        "dataset": self.dataset.uuid,
                        "dataset_sha256": self.dataset.attributes["manifest_sha256"],
                    },
                    weights=self.learner.network.state_dict(),
                    average=self.learner.average.weights if self.learner.average else None,
                    state=self.learner.state() | {"verdict": self.verdict.state(), "random": random},
                    keep=self.recipe.keep_checkpoints,
                    best=best,
                )
            except DsffnetError as error:
                failure = error
        if any_rank([failure is not None], self.ranks)[0]:
            raise failure or TrainingError("rank 0 could not write a checkpoint", secondary=True)

    def _newest(self) -> str | None:
        found = load_checkpoint(self.folder)
        return str(found.path) if found else None

    def _resume(self) -> None:
        """Go on from the newest checkpoint. Rank 0 chooses it, so that all ranks start from the same one."""
        path = decided_by_first(self.ranks, self._newest)
        if path is None:
            return
        found = read_checkpoint(Path(path))
        if found.dataset != self.dataset.uuid:
            raise CheckpointError(
                f"{self.folder} was trained on dataset {found.dataset}, not on {self.dataset.url} "
                f"({self.dataset.uuid}). Choose another --out (begin there from these weights with --set "
                f"training.start_from={self.folder}), or add --fresh to start over"
            )
        self.recipe.require_same_learning(TrainingRecipe.model_validate(found.recipe), where=str(self.folder))
        state = found.state()
        self.learner.load(found, state)
        restore_random_state(state["random"], self.ranks.rank)
        self.done, self.finished, self.verdict = found.step, found.finished, Verdict(**state["verdict"])

    def _stopped_early(self) -> None:
        where = f"at step {self.done} of {self.last_step}"
        if self.out_of_time and not self.stopping:
            raise BudgetSpent(
                f"the time budget of {self.recipe.budget} is spent {where}; a checkpoint was written. "
                "Run the same command again to go on from here"
            )
        raise TrainingStopped(
            f"stopped {where} as told; a checkpoint was written. Run the same command again to go on from here"
        )
