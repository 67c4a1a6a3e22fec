"""The training loop, the same under any launcher; reads only RANK, WORLD_SIZE, LOCAL_RANK, MASTER_*.

Read top to bottom: ``train`` -> ``_Trainer.run`` -> ``_Trainer._step``, then :mod:`training.engine.train_step`.
Everything that
varies is in the recipe; the order of triples is a function of (seed, step), so the state of a run is its weights, its
optimiser, the average of its weights and a few numbers.
"""

import contextlib
import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from datagen.common.errors import TrainingStopped, reason_of
from datagen.common.files import write_atomically
from datagen.common.resources import memory_errors
from datagen.store import Dataset, open_dataset
from training.checkpoints.checkpoint import Checkpoint, is_finished, save_checkpoint
from training.checkpoints.compat import state_of
from training.checkpoints.state_file import unusable_state
from training.data.augmentation import Augmentation
from training.data.batch import Batch
from training.data.cache_policy import room_of
from training.data.triples import last_step_of, order_of
from training.data.vertex_bank import VertexBank, open_bank
from training.engine.distributed import (
    BudgetSpent,
    Ranks,
    StopRequest,
    agreed,
    alone_in,
    any_rank,
    decided_by_first,
    device_of,
    forget_old_stop,
    mean_over_ranks,
    process_group,
    random_states,
    restore_random_state,
)
from training.engine.nonfinite import broken_step, stop_for
from training.engine.resume import checkpoint_to_go_on_from, weights_to_begin_from
from training.engine.snapshots import snapshot_path
from training.engine.step_memory import require_step_memory
from training.engine.train_step import Learner
from training.engine.validation import Probe, Verdict, require_measurable
from training.recipes.training import TrainingRecipe, budget_seconds
from training.tracking.journal import Journal
from training.tracking.progress import Progress
from training.tracking.system_metrics import sampling


class Meter:
    """Counts steps since the last reading.

    Parameters
    ----------
    batch
        Triples in a step, over all ranks.
    """

    def __init__(self, batch: int) -> None:
        self._batch = batch
        self._reset()

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Around whatever brings the next batch."""
        began = time.perf_counter()
        yield
        self._waited += time.perf_counter() - began
        self._steps += 1

    def read(self) -> dict[str, float]:
        """Return ``meshes_per_second`` and ``input_wait`` (a share of the time) since the last reading."""
        seconds = time.perf_counter() - self._began
        found = {"meshes_per_second": self._steps * self._batch / seconds, "input_wait": self._waited / seconds}
        self._reset()
        return found

    def _reset(self) -> None:
        self._began, self._waited, self._steps = time.perf_counter(), 0.0, 0


log = logging.getLogger(__name__)
_CHECK_EVERY = {"cpu": 1, "cuda": 16}
"""Steps between looks at whether all is finite and nobody asked to stop. On a GPU each look waits for its queue."""
_SAY_EVERY = 20.0
"""Seconds between lines of the log."""


_LESS_MEMORY = (
    "The last checkpoint is kept. Lower training.batch (it is {0.batch}), raise training.accumulate (it is "
    "{0.accumulate}), or lower the network's widths or the vertices"
)


def train(recipe: TrainingRecipe, *, data: str, run: Path, began: float | None = None) -> int:
    """Train until the recipe's last step, from the newest sound checkpoint of ``run`` if there is one.

    Parameters
    ----------
    recipe
        What to train and how.
    data
        Store URL of a complete dataset.
    run
        Folder of the run; rank 0 writes to it.
    began
        When the command began that the recipe's time budget counts from, in seconds since 1970; default: now.

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
    TrainingError, DatasetError, CheckpointError, StorageError, OutOfMemory
        See their messages; the last good checkpoint is kept.
    RecipeError
        A step needs more memory than there is.
    """
    now = time.time()
    ranks = Ranks.from_environment()
    device = device_of(recipe, ranks)
    launched = dist.is_initialized()  # by Ray Train, whose driver keeps RUN/stop
    with memory_errors(_LESS_MEMORY.format(recipe)), process_group(ranks, recipe), alone_in(run, ranks):
        if not launched:
            forget_old_stop(run, ranks, before=now)
        with StopRequest(run) as stop:
            dataset = agreed(ranks, lambda: open_dataset(data), what="open the dataset")
            found = checkpoint_to_go_on_from(recipe, dataset, run, ranks)
            if found and is_finished(found, last_step_of(recipe, dataset)):
                return found.step
            require_measurable(dataset, recipe)
            room = room_of(device, sharers=ranks.here)
            agreed(
                ranks,
                lambda: require_step_memory(recipe, dataset, room, ranks=ranks.count),
                what="hold a step in memory",
            )
            # The trainer must be gone before its process group is: see tests/support/one_rank.py.
            return _Trainer(recipe, dataset, run, ranks, device, stop, began or now, found).run()


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
        found: Checkpoint | None,
    ) -> None:
        self.recipe, self.dataset, self.folder, self.ranks = recipe, dataset, run, ranks
        self.device, self._stop = device, stop
        self._began = time.monotonic() - max(
            time.time() - began, 0.0
        )  # clocks are put back, and differ between machines
        self.order, self.last_step = order_of(recipe, dataset), last_step_of(recipe, dataset)
        start = None if found else weights_to_begin_from(recipe, ranks)
        self.learner = Learner(
            recipe, ranks, device, steps_per_epoch=self.order.steps_per_epoch, steps=self.last_step, start=start
        )
        self.done, self.verdict, self.finished = 0, Verdict(triples=recipe.evaluate_triples), False
        if found:
            agreed(ranks, lambda: self._go_on_from(found), what="go on from the newest checkpoint")
        self.bank = agreed(ranks, self._opened_bank, what="open the training meshes")
        self.meter = Meter(recipe.batch)
        self.progress = Progress(steps=self.last_step, steps_per_epoch=self.order.steps_per_epoch)
        self._said = time.monotonic()
        self.is_writer = ranks.rank == 0
        self.stopping = self.out_of_time = False
        self._recent: list[tuple[int, Any, Any]] = []

    def _opened_bank(self) -> VertexBank:
        return open_bank(
            self.dataset,
            self.dataset.identities("training"),
            device=self.device,
            cache=self.recipe.cache,
            sharers=self.ranks.here,
            edge_sum=self.recipe.edge_sum,
        )

    def run(self) -> int:
        with contextlib.ExitStack() as around:
            around.callback(self.bank.close)
            agreed(self.ranks, lambda: self._watch(around), what="open the run's journal and evaluation triples")
            (self.stopping,) = any_rank([self._stop.made()], self.ranks)  # told to while meshes were decoded
            batches = self._batches()
            while self.done < self.last_step and not (self.finished or self.stopping or self.out_of_time):
                self._step(batches)
        if self.done < self.last_step and not self.finished:
            self._stopped_early()
        return self.done

    def _watch(self, around: contextlib.ExitStack) -> None:
        """Open what rank 0 alone writes to and measures with."""
        self.probe, self.journal = None, None
        if self.is_writer:
            log.info("training meshes are kept in %s", self.bank.where)
            write_atomically(self.folder / "input.json", json.dumps({"where": self.bank.where}).encode())
            self.probe = Probe(self.dataset, self.recipe, self.device, self.learner.dtype)
            self.journal = Journal(self.folder / "metrics.jsonl")
            around.callback(self.journal.close)
            around.enter_context(sampling(self.folder / "system.jsonl"))

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
        bad_step = self.learner.bad_step
        recent, self._recent = self._recent, []
        flags = [bad_step > 0, self._stop.made(), self._spent()]
        any_bad, self.stopping, self.out_of_time = any_rank(flags, self.ranks)
        if any_bad:
            stop_for(broken_step(bad_step, recent, self.ranks.rank), self.folder, self.ranks)

    def _spent(self) -> bool:
        budget = self.recipe.budget
        return budget is not None and time.monotonic() - self._began > budget_seconds(budget)

    def _log(self, values: dict[str, Any], probing: bool) -> None:
        shared = mean_over_ranks(values, self.ranks)
        decided = decided_by_first(self.ranks, lambda: self._measure_and_write(shared, probing))
        if decided is not None:
            self.verdict, self.finished = decided

    def _measure_and_write(self, shared: dict[str, float], probing: bool) -> tuple[Verdict, bool] | None:
        """Rank 0's part; the verdict if it was time for one."""
        assert self.probe is not None and self.journal is not None
        measured: dict[str, float] = {}
        if probing:
            with self.learner.evaluated():
                measured = self.probe.measure(self.learner.network)
        self.journal.write(self.done, shared | measured | self.meter.read())
        self._say(shared | measured)
        return self._judge(self.probe, measured) if probing else None

    def _say(self, row: dict[str, float]) -> None:
        """For launchers that show nothing themselves; at intervals."""
        self.progress.add({"step": self.done, "time": time.time(), **row})
        if time.monotonic() - self._said > _SAY_EVERY or self.done == self.last_step:
            log.info("%s", self.progress.line())
            self._said = time.monotonic()

    def _judge(self, probe: Probe, measured: dict[str, float]) -> tuple[Verdict, bool]:
        verdict = self.verdict.after(probe.decisive(measured))
        return verdict, verdict.gives_up(self.recipe.early_stopping)

    def _draw(self, probe: Probe) -> None:
        """A picture that cannot be drawn or written ends no training."""
        try:
            with self.learner.evaluated():
                probe.draw(self.learner.network, snapshot_path(self.folder, self.done), title=f"step {self.done:,}")
        except Exception as error:
            log.warning("no picture of step %s: %s: %s", self.done, type(error).__name__, error)

    def _save(self, *, best: bool) -> None:
        """Rank 0 writes, all wait, and a failure to write stops every rank."""
        random = random_states(self.ranks.count)

        def write() -> None:
            if self.journal:
                self.journal.sync()
                self._write(random, best=best)

        agreed(self.ranks, write, what="write a checkpoint")

    def _write(self, random: list[dict[str, torch.Tensor]], *, best: bool) -> None:
        save_checkpoint(
            self.folder,
            about={
                "step": self.done,
                "last_step": self.last_step,
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

    def _go_on_from(self, found: Checkpoint) -> None:
        state = state_of(found, averaged=self.recipe.average is not None)
        try:
            self.learner.load(found, state)
            restore_random_state(state["random"], self.ranks.rank)
            self.verdict = Verdict.resumed(state["verdict"], triples=self.recipe.evaluate_triples)
        except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            raise unusable_state(found.path, f"{type(error).__name__}: {reason_of(error)}") from error
        self.done, self.finished = found.step, found.finished

    def _stopped_early(self) -> None:
        where = f"at step {self.done} of {self.last_step}"
        kept = "a checkpoint was written" if self.done else "before anything was learned"
        if self.out_of_time and not self.stopping:
            raise BudgetSpent(
                f"the time budget of {self.recipe.budget} is spent {where}; {kept}. "
                "Run the same command again to go on from here"
            )
        raise TrainingStopped(f"stopped {where} as told; {kept}. Run the same command again to go on from here")
