"""A sweep from start to end: the dataset once, every trial as a Ray task, the report; with MLflow watching."""

import shutil
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from datagen.common.errors import RecipeError, TrainingStopped, WorkflowError
from datagen.common.files import read_text_within
from datagen.store import open_dataset
from datagen.store.attributes import check_same_recipe
from datagen.store.schema import open_group
from training.data.triples import last_step_of
from training.evaluation.run_curves import PMD_UNIT
from training.tracking.record import has_record, read_record, update_record
from workflows.pipeline.console import start_over
from workflows.pipeline.ray_cluster import ray_cluster
from workflows.pipeline.stage import Stage, once, refuse_other_kind, run_stage, say
from workflows.pipeline.stage_functions import check_run_accepts, generate_stage, is_complete, recorded
from workflows.pipeline.tasks import TaskRunner
from workflows.recipe.loader import save_recipe
from workflows.sweep.plan import Sweep, Trial, varied_values, write_sweep
from workflows.sweep.progress import SweepProgress
from workflows.sweep.ray_trials import Outcome, Place, is_finished, prepare, ray_trials
from workflows.sweep.report import FILES, Result, best_of, results_of, write_report

_OWN = ("trials", "trials.yaml", ".sweep", *FILES)

Trials = Generator[Outcome | None, None, None]
Runner = Callable[..., Trials]
"""Runs trials somewhere, see :func:`workflows.sweep.ray_trials.ray_trials`."""


@dataclass(frozen=True)
class Settings:
    """How a sweep is run and reported; nothing of it changes what is learned."""

    name: str
    levels: tuple[tuple[float, bool], ...] = ((2.0, True),)
    cpus: int = 1
    gpus: float = 0.0
    strict: bool = False


def run_sweep(
    sweep: Sweep,
    out: Path,
    settings: Settings,
    *,
    runner: Runner = ray_trials,
    show: Callable[[list[Result]], None] = lambda results: None,
) -> list[Result]:
    """Dataset, trials and report into ``out``; what is finished is skipped, without so much as starting Ray.

    Returns
    -------
    list of Result
        Of all trials, the best first; ``show`` is given them before anything that failed is raised.

    Raises
    ------
    WorkflowError, TrainingStopped
        See :func:`judge`.
    """
    data = str(out / "dataset.zarr")
    refuse_conflicts(sweep, data, out, kind="sweep")
    with ExitStack() as around:
        begin = once(lambda: _begin(around, sweep, out, settings))
        outcomes = generate_and_train(
            sweep,
            out,
            begin=begin,
            running=partial(runner, tags=partial(_tags, sweep), cpus=settings.cpus, gpus=settings.gpus),
            told=lambda: _report(sweep, out, settings),
        )
        if not has_record(out):
            begin()
            _report(sweep, out, settings)
        results = results_of(sweep, out) if outcomes else _write_report(sweep, out, settings)
        show(results)
        judge(outcomes, of=len(sweep.trials), strict=settings.strict)
    return results


def generate_and_train(
    sweep: Sweep,
    out: Path,
    *,
    begin: Callable[[], None],
    running: Runner,
    told: Callable[[], None] = lambda: None,
) -> list[Outcome]:
    """Make the dataset, and train every trial that is not finished.

    Parameters
    ----------
    sweep, out
        What to train, and where.
    begin
        Called before any work; not called if there is none.
    running
        Trials and their place -> a generator of how they end, see :func:`workflows.sweep.ray_trials.ray_trials`.
    told
        Called whenever a trial has ended.

    Returns
    -------
    list of Outcome
        Of the trials that ran now.
    """
    data = str(out / "dataset.zarr")
    generate = Stage(
        "generate",
        depends_on=sweep.recipe.data.model_dump(mode="json"),
        intact=lambda: is_complete(data) and has_record(out / "generate"),
        work=partial(generate_stage, sweep.recipe.data, data, folder=out / "generate", parent=out, tasks=TaskRunner()),
    )
    run_stage(generate, out=out, before=begin)
    waiting = [trial for trial in sweep.trials if not is_finished(trial, data, out)]
    if skipped := len(sweep.trials) - len(waiting):
        say(f"trials: {skipped} of {len(sweep.trials)} skipped, finished before")
    if not waiting:
        return []
    begin()
    say(f"trials: {len(waiting)} begin")
    place = prepare(waiting, data=data, out=out)
    return _follow(sweep, place, running(waiting, place), told)


def _follow(sweep: Sweep, place: Place, running: Trials, told: Callable[[], None]) -> list[Outcome]:
    """Follow trials until all have ended."""
    dataset, outcomes = open_dataset(place.data), []
    steps = {trial.name: last_step_of(trial.training, dataset) for trial in sweep.trials}
    with closing(running), SweepProgress(sweep.trials, steps, place.out) as progress:
        for outcome in running:
            if outcome is not None:
                outcomes.append(outcome)
                progress.tell(outcome)
                told()
            progress.look()
    return outcomes


def _report(sweep: Sweep, out: Path, settings: Settings) -> None:
    """Write the report, and give the parent record what a person wants to see first: table, figure, best trial."""
    results = _write_report(sweep, out, settings)
    record, best = read_record(out), best_of(results)
    assert record is not None
    metrics = {f"trials_{state}": float(sum(r.state == state for r in results)) for state in ("finished", "failed")}
    tags = record.tags | {"mlflow.note.content": read_text_within(out, "sweep.md")}
    if best is not None:
        metrics |= {"best_pmd_unseen": best.unseen.final / PMD_UNIT}
        tags |= {"best_trial": best.trial.name}
    artifacts = ["recipe.yaml", "trials.yaml", *(name for name in FILES if (out / name).exists())]
    update_record(out, tags=tags, metrics=metrics, artifacts=artifacts)


def _write_report(sweep: Sweep, out: Path, settings: Settings) -> list[Result]:
    return write_report(sweep, out, name=settings.name, levels=settings.levels, cpus=settings.cpus)


def _begin(around: ExitStack, sweep: Sweep, out: Path, settings: Settings) -> None:
    """The resolved recipe and trials on disk, a parent record, a connected Ray."""
    save_recipe(sweep.recipe, out / "recipe.yaml")
    write_sweep(sweep, out / "trials.yaml")
    values = {key: [varied_values(sweep, trial).get(key, "") for trial in sweep.trials] for key in sweep.varied}
    varied = {f"varied.{key}": ", ".join(dict.fromkeys(found)) for key, found in values.items()}
    parameters = sweep.recipe.model_dump(mode="json") | {"trials": str(len(sweep.trials))} | varied
    around.enter_context(recorded(out, kind="sweep", name=settings.name, parent=None, parameters=parameters))
    update_record(out, artifacts=["recipe.yaml", "trials.yaml"])
    around.enter_context(ray_cluster())


def _tags(sweep: Sweep, trial: Trial) -> dict[str, str]:
    return {f"varied.{key}": value for key, value in varied_values(sweep, trial).items()}


def refuse_conflicts(sweep: Sweep, data: str, out: Path, *, kind: str) -> None:
    """Refuse a folder of another kind of work, or made by another recipe, before anything in it is touched."""
    refuse_other_kind(out, kind)
    if not (Path(data) / "zarr.json").exists():
        return
    group = open_group(data)
    if "format_version" in group.attrs:  # it is missing where the very first write was cut short
        check_same_recipe(data, group, sweep.recipe.data)
    if is_complete(data):
        for trial in sweep.trials:
            check_run_accepts(trial.training, open_dataset(data), trial.folder(out))


def remove_sweep(out: Path, *, kind: str = "sweep", own: Sequence[str] = _OWN) -> None:
    """Remove what a sweep (or what trains as one) keeps in ``out``, its dataset too; the MLflow store stays.

    Raises
    ------
    RecipeError
        The folder is not one of that kind.
    """
    record = read_record(out)
    if (out / "trials").exists() and (record is None or record.kind != kind):
        raise RecipeError(
            f"{out} holds trials, but no {kind} of ours, so --fresh leaves it alone. Choose another --out"
        )
    start_over(out)
    for path in (out / name for name in own):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def judge(outcomes: Sequence[Outcome], *, of: int, strict: bool) -> None:
    """Raise if trials were stopped, or if all of so many (strict: any) have failed.

    Raises
    ------
    TrainingStopped
        Trials were stopped before their last step; with the exit status of the first.
    WorkflowError
        Trials have failed; it names them, with the first reason.
    """
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    stopped = [outcome for outcome in outcomes if outcome.state == "stopped"]
    if stopped:
        error = TrainingStopped(f"{_names(stopped)} not finished: {stopped[0].reason}. {_AGAIN}")
        error.exit_status = stopped[0].exit_status
        raise error
    if failed and (strict or len(failed) == of):
        raise WorkflowError(f"{_names(failed)} failed, the first because: {failed[0].reason}. {_RETRY}")


_AGAIN = "Run the same command again to go on"
_RETRY = "Run the same command again to try them once more, or leave them out"


def _names(outcomes: Sequence[Outcome]) -> str:
    names = ", ".join(outcome.name for outcome in outcomes)
    return f"{len(outcomes)} trial{'s' if len(outcomes) > 1 else ''} ({names})"
