"""Running trials: the task that trains one, and the Ray cluster that runs as many at once as there are CPUs for.

A task may be started more than once (Ray repeats those whose worker or node died); each start resumes from the newest
checkpoint, so that nothing is done twice. What stops or fails a trial ends that trial alone.
"""

import contextlib
import threading
import traceback
import uuid
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from datagen.common.errors import (
    ClusterError,
    DsffnetError,
    TrainingError,
    TrainingStopped,
    WorkflowError,
    first_line_of,
)
from datagen.common.files import read_within, write_atomically
from datagen.store import open_dataset
from training.engine.distributed import on_sigterm
from training.tracking.record import end_record, read_record, update_record
from workflows.pipeline.run_folder import RunFolder, TrialsFolder
from workflows.pipeline.stage import recorded, say
from workflows.pipeline.train import HEAD, begin_run, check_run_accepts, is_trained, train_run
from workflows.studies.sweep.plan import Trial

_RETRIES = 3  # of a task whose worker or node died
_STOPPING = 120.0  # seconds that told trials have for finishing their step and writing a checkpoint
_FROM_PARENT = ("mlflow.user", "mlflow.source.name", "mlflow.source.type")


@dataclass(frozen=True)
class Outcome:
    """How a task ended: the trial's name, what became of it, and why if it did not finish."""

    name: str
    state: Literal["finished", "failed", "stopped"]
    reason: str = ""
    exit_status: int = 1


@dataclass(frozen=True)
class Place:
    """Where trials find their data and leave their runs; ``mark`` tells whether another machine sees the same disk."""

    data: str
    out: Path
    mark: str


def prepare(trials: Sequence[Trial], *, data: str, out: Path) -> Place:
    """Mark the folder, and take back what an earlier command told these trials."""
    for trial in trials:
        trial.folder(out).mkdir(parents=True, exist_ok=True)
        RunFolder(trial.folder(out)).stop.unlink(missing_ok=True)
    mark = uuid.uuid4().hex
    write_atomically(TrialsFolder(out).mark, mark.encode())
    return Place(data, out, mark)


def is_finished(trial: Trial, data: str, out: Path) -> bool:
    """Whether a trial has nothing left to do."""
    record = read_record(trial.folder(out))
    return record is not None and record.status == "FINISHED" and is_trained(trial.training, data, trial.folder(out))


def tell_to_stop(trials: Sequence[Trial], out: Path) -> None:
    """Ask trials to finish their step, write a checkpoint and end."""
    for trial in trials:
        with contextlib.suppress(OSError):
            RunFolder(trial.folder(out)).stop.touch()


def train_trial(trial: Trial, place: Place, *, tags: dict[str, str], threads: int) -> Outcome:
    """Train one trial in this process, from its newest checkpoint if there is one; its folder is an ordinary run.

    Parameters
    ----------
    trial, place
        What to train, and where.
    tags
        For its record: what varies.
    threads
        Threads of torch in this process.
    """
    import torch

    torch.set_num_threads(threads)
    run = RunFolder(trial.folder(place.out))
    try:
        _require_shared_disk(place)
        if run.stop.exists():
            raise TrainingStopped("told to stop before it began")
        with run.alone():
            _train(trial, place, run, tags)
    except TrainingStopped as error:
        return Outcome(trial.name, "stopped", str(error), error.exit_status)
    except DsffnetError as error:
        return Outcome(trial.name, "failed", str(error))
    except Exception as error:  # a mistake in one trial's network or recipe must not take the others with it
        with contextlib.suppress(OSError):
            write_atomically(run.traceback, traceback.format_exc().encode())
        return Outcome(trial.name, "failed", f"{_in_a_line(error)} (traceback: {run.traceback})")
    return Outcome(trial.name, "finished")


def ray_trials(
    trials: Sequence[Trial],
    place: Place,
    *,
    tags: Callable[[Trial], dict[str, str]],
    cpus: int = 1,
    gpus: float = 0.0,
) -> Generator[Outcome | None, None, None]:
    """Run trials as Ray tasks; yields outcomes as they come, and None about once a second where none does.

    Whoever leaves this early (an error, Ctrl-C, SIGTERM) has the running trials stopped, each with a checkpoint.

    Raises
    ------
    ClusterError
        No machine of the cluster has so many CPUs or GPUs.
    """
    import ray

    _require_room(cpus, gpus)
    placed = [_on_device(trial, gpus) for trial in trials]  # before any is submitted: one that cannot be starts none
    task = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=_RETRIES)(train_trial)
    running = {task.remote(trial, place, tags=tags(trial), threads=cpus): trial for trial in placed}
    told = threading.Event()
    try:
        with on_sigterm(told.set):
            while running:
                done, _ = ray.wait(list(running), timeout=1.0)
                for reference in done:
                    yield _outcome(reference, running.pop(reference), place)
                if told.is_set():
                    raise TrainingStopped(
                        "told to stop, with a checkpoint of each trial. Run the same command again to resume"
                    )
                if not done:
                    yield None
    finally:
        if running:
            say(f"stopping: {len(running)} trials finish their step and write a checkpoint")
            tell_to_stop(list(running.values()), place.out)
            ray.wait(list(running), num_returns=len(running), timeout=_STOPPING)


def _train(trial: Trial, place: Place, run: RunFolder, tags: dict[str, str]) -> None:
    recipe, dataset = trial.training, open_dataset(place.data)
    check_run_accepts(recipe, dataset, run.path)
    parameters = recipe.model_dump(mode="json")
    with recorded(run.path, kind="train", name=trial.name, parent=place.out, parameters=parameters):
        note = {"mlflow.note.content": trial.description or ", ".join(trial.words), "failure": "none"}
        tags = _inherited(place.out) | tags | note
        try:
            begin_run(recipe, dataset, run, tags=tags)
            train_run(recipe, dataset, run)
        except TrainingStopped:
            raise
        except Exception as error:
            update_record(run.path, tags=tags | {"failure": _in_a_line(error)})
            raise
        update_record(run.path, artifacts=[*HEAD, "metrics.jsonl", "figures"])


def _inherited(out: Path) -> dict[str, str]:
    """Tags on who started what: the sweep's, as a worker of Ray has neither its name nor its command."""
    parent = read_record(out)
    return {key: parent.tags[key] for key in _FROM_PARENT if key in parent.tags} if parent else {}


def _require_shared_disk(place: Place) -> None:
    mark = TrialsFolder(place.out).mark
    if not mark.exists() or read_within(place.out, mark.name) != place.mark.encode():
        raise WorkflowError(f"this trial does not see {place.out} as the driver does: --out must be on a shared disk")


def _require_room(cpus: int, gpus: float) -> None:
    for option, wanted, resource in (("--cpus-per-trial", cpus, "CPU"), ("--gpus-per-trial", gpus, "GPU")):
        most = _most_on_a_machine(resource)
        if wanted > most:
            raise ClusterError(
                f"{option} is {wanted:g}, but no machine of the cluster has more than {most:g} {resource}s. "
                f"Use {option} {most:g} or less, or add a larger machine"
            )


def _most_on_a_machine(resource: str) -> float:
    import ray

    alive = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    return max((float(resources.get(resource, 0)) for resources in alive), default=0.0)


def _on_device(trial: Trial, gpus: float) -> Trial:
    """Without a GPU of its own a trial keeps to its CPUs, also on a machine that has GPUs."""
    if gpus or trial.training.device == "cpu":
        return trial
    if trial.training.device == "cuda":
        raise TrainingError(f"trial {trial.name} has training.device=cuda. Give each one a GPU: --gpus-per-trial 1")
    training = trial.recipe.training.model_copy(update={"device": "cpu"})
    return replace(trial, recipe=trial.recipe.model_copy(update={"training": training}))


def _outcome(reference: Any, trial: Trial, place: Place) -> Outcome:
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        reason = f"Ray gave up on it after {_RETRIES + 1} starts ({_in_a_line(error)})"
        record = read_record(trial.folder(place.out))
        if record is not None:
            update_record(trial.folder(place.out), tags=record.tags | {"failure": reason})
            end_record(trial.folder(place.out), "FAILED")
        return Outcome(trial.name, "failed", reason)


def _in_a_line(error: Exception) -> str:
    first = first_line_of(error)
    return first if isinstance(error, DsffnetError) else f"{type(error).__name__}: {first}"
