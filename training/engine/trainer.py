"""The training loop, the same under any launcher; reads only RANK, WORLD_SIZE, LOCAL_RANK, MASTER_*.

Read top to bottom: ``train`` -> ``_learn``, the loop -> ``_check``, ``_settle``, ``_save``; a step itself is in
:mod:`training.engine.train_step`. Everything that varies is in the recipe; the order of examples is a function of
(seed, step), so the state of a run is its weights, its optimiser, the average of its weights and a few numbers.
"""

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from datagen.common.errors import BudgetSpent, TrainingStopped
from datagen.common.resources import memory_errors
from training.checkpoints.checkpoint import Checkpoint, is_finished, save_checkpoint
from training.data.cache_policy import room_of
from training.engine.distributed import (
    Ranks,
    StopRequest,
    agreed,
    alone_in,
    any_rank,
    decided_by_first,
    device_of,
    forget_old_stop,
    gathered,
    mean_over_ranks,
    process_group,
    random_state,
)
from training.engine.nonfinite import RecentStep, broken_step, stop_for
from training.engine.observer import Meter, Observer, observing
from training.engine.resume import begin, checkpoint_to_resume
from training.engine.state import Job, State
from training.engine.tasks.registry import task_of
from training.recipes.training import TrainingRecipe, budget_seconds

CHECK_EVERY = {"cpu": 1, "cuda": 16}
"""Steps between looks at whether all is finite and nobody asked to stop. On a GPU each look waits for its queue."""
_LESS_MEMORY = (
    "The last checkpoint is kept. Lower training.batch (it is {0.batch}), raise training.accumulate (it is "
    "{0.accumulate}), or lower the network's widths or the vertices"
)


class StopReason(Enum):
    """Why a training ends before its last step."""

    EARLY_STOPPING = "no better measure in as many evaluations as the recipe says: the training is finished"
    TOLD = "SIGTERM, or the file RUN/stop"
    BUDGET = "the time budget of this command is spent"


@dataclass(frozen=True)
class Due:
    """What a training owes after a step."""

    check: bool
    """To exchange between ranks whether all is finite and nobody asked to stop."""
    log: bool
    validate: bool
    picture: bool
    checkpoint: bool

    @classmethod
    def after(cls, step: int, recipe: TrainingRecipe, *, last_step: int, check_every: int = 1) -> "Due":
        """Return what is due after ``step`` steps, the same on every rank; at the last step all but a picture is."""

        def every(interval: int | None) -> bool:
            return interval is not None and step % interval == 0

        validate = step == last_step or every(recipe.evaluate_every)
        logs = validate or every(recipe.log_every)
        checkpoint = step == last_step or every(recipe.checkpoint_every)
        check = logs or checkpoint or every(check_every)
        return cls(check, logs, validate, picture=every(recipe.picture_every), checkpoint=checkpoint)


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
            job = Job(recipe, agreed(ranks, lambda: task_of(recipe, data), what="open the dataset"), run, ranks)
            newest = checkpoint_to_resume(job)
            if newest and is_finished(newest, job.last_step):
                return newest.step
            room = room_of(device, sharers=ranks.here)
            agreed(ranks, lambda: job.task.check(room, ranks.count), what="hold a step in memory")
            # What learns must be gone before its process group is: see tests/support/ranks/one_rank.py.
            return _learn(job, device, stop, newest, _deadline(recipe, began or now))


def _deadline(recipe: TrainingRecipe, began: float) -> float:
    """By the monotonic clock: others are put back, and differ between machines."""
    left = budget_seconds(recipe.budget) if recipe.budget else float("inf")
    return time.monotonic() + left - max(time.time() - began, 0.0)


def _learn(job: Job, device: torch.device, stop: StopRequest, newest: Checkpoint | None, deadline: float) -> int:
    """Take steps until the last one or until there is a reason to stop; return the step reached."""
    ranks, share = job.ranks, job.order.share(rank=job.ranks.rank, ranks=job.ranks.count)
    state, meter = begin(job, device, newest), Meter(job.recipe.batch)
    recent: list[RecentStep] = []
    with contextlib.ExitStack() as around:
        feed = around.enter_context(job.task.feed(ranks, device))
        observer = agreed(
            ranks,
            lambda: around.enter_context(observing(job, state.learner, meter, feed.where)) if ranks.rank == 0 else None,
            what="open the run's journal and what is measured",
        )
        (told,) = any_rank([stop.made()], ranks)  # while meshes were decoded
        reason = StopReason.TOLD if told else None
        batches = feed.batches(state.step)
        while state.step < job.last_step and reason is None:
            with meter.waiting():
                items, parts = next(batches)
            values = state.learner.step(parts, share=share)
            state.step += 1
            recent.append((state.step, items, values["loss/total"]))
            due = Due.after(state.step, job.recipe, last_step=job.last_step, check_every=CHECK_EVERY[device.type])
            if due.check:
                reason = _check(job, state, recent, told=stop.made(), late=time.monotonic() > deadline)
                recent.clear()
            reason = _settle(job, state, observer, due, values, reason)
    if state.step < job.last_step and reason is not StopReason.EARLY_STOPPING:
        raise _stopped(job, state.step, reason)
    return state.step


def _check(job: Job, state: State, recent: Sequence[RecentStep], *, told: bool, late: bool) -> StopReason | None:
    """Exchange between the ranks whether a gradient was not finite, and whether one was told to stop or has no time."""
    bad_step = state.learner.bad_step
    any_bad, any_told, any_late = any_rank([bad_step > 0, told, late], job.ranks)
    if any_bad:
        stop_for(broken_step(bad_step, recent, job.ranks.rank), job.run, job.ranks)
    if any_told:
        return StopReason.TOLD
    return StopReason.BUDGET if any_late else None


def _settle(
    job: Job, state: State, observer: Observer | None, due: Due, values: dict[str, Any], reason: StopReason | None
) -> StopReason | None:
    """Do what is due after a step; return the reason to stop, which may be early stopping now."""
    if due.log:
        shared = mean_over_ranks(values, job.ranks)
        measure = decided_by_first(
            job.ranks, lambda: observer.log(state, shared, validate=due.validate) if observer else None
        )
        if measure is not None:
            state.verdict = state.verdict.after(measure)
            reason = StopReason.EARLY_STOPPING if state.verdict.gives_up(job.recipe.early_stopping) else reason
    if due.picture and observer:
        observer.draw(state, job.run)
    improved = due.validate and state.verdict.improved
    if due.checkpoint or improved or reason:
        finished = state.step == job.last_step or reason is StopReason.EARLY_STOPPING
        _save(job, state, observer, finished=finished, best=improved)
    return reason


def _save(job: Job, state: State, observer: Observer | None, *, finished: bool, best: bool) -> None:
    """Rank 0 writes a checkpoint, all wait, and a failure to write stops every rank."""
    random, learner = gathered(random_state(), job.ranks), state.learner
    about = {
        "step": state.step,
        "last_step": job.last_step,
        "finished": finished,
        "recipe": job.recipe.model_dump(mode="json"),
        "dataset": job.task.uuid,
        "dataset_sha256": job.task.sha256,
    }

    def write() -> None:
        if observer:
            observer.journal.sync()
            save_checkpoint(
                job.run,
                about=about,
                weights=learner.network.state_dict(),
                average=learner.average.weights if learner.average else None,
                state=learner.state() | {"verdict": state.verdict.state(), "random": random},
                keep=job.recipe.keep_checkpoints,
                best=best,
            )

    agreed(job.ranks, write, what="write a checkpoint")


def _stopped(job: Job, step: int, reason: StopReason | None) -> TrainingStopped:
    where = f"at step {step} of {job.last_step}"
    kept = "a checkpoint was written" if step else "before anything was learned"
    if reason is StopReason.BUDGET:
        return BudgetSpent(
            f"the time budget of {job.recipe.budget} is spent {where}; {kept}. Run the same command again to resume"
        )
    return TrainingStopped(f"stopped {where} as told; {kept}. Run the same command again to resume")
