"""Many trainings on one dataset, from start to end: what a sweep and a comparison share, and the sweep itself."""

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from datagen.common.errors import TrainingStopped, WorkflowError
from datagen.common.files import read_text_within
from datagen.store import open_dataset
from training.data.triples import last_step_of
from training.objectives import PMD_UNIT
from training.tracking.record import has_record, read_record, update_record
from workflows.pipeline.generate import generate_stage
from workflows.pipeline.ray_cluster import ray_cluster
from workflows.pipeline.run_folder import SweepFolder, TrialsFolder
from workflows.pipeline.stage import once, recorded, run_stage, say
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import refuse_conflicts
from workflows.recipe.loader import save_recipe
from workflows.studies.sweep.plan import Sweep, Trial, varied_values, write_sweep
from workflows.studies.sweep.progress import SweepProgress
from workflows.studies.sweep.ray_trials import Outcome, Place, is_finished, prepare, ray_trials
from workflows.studies.sweep.report import FILES, TrialResult, best_of, results_of, write_report

Trials = Generator[Outcome | None, None, None]
TrialRunner = Callable[..., Trials]
"""Runs trials somewhere, see :func:`workflows.studies.sweep.ray_trials.ray_trials`."""
HEAD = ["recipe.yaml", "trials.yaml"]
Made = TypeVar("Made")
Finish = Callable[[list[Outcome], Callable[[], None]], Made]
"""How the trials ended that ran now, and what to call before any work of its own -> what it makes of them."""


@dataclass(frozen=True)
class Settings:
    """How trials are run and reported; nothing of it changes what is trained."""

    name: str
    cpus: int = 1
    gpus: float = 0.0
    strict: bool = False


@dataclass(frozen=True)
class Work:
    """Trials in a folder, and what the record of the whole and of each trial hold beside them."""

    sweep: Sweep
    folder: TrialsFolder
    settings: Settings
    parameters: dict[str, str]
    tags: Callable[[Trial], dict[str, str]]


def run_trials(
    work: Work, *, runner: TrialRunner, finish: Finish[Made], told: Callable[[], None] = lambda: None
) -> Made:
    """Make the dataset, train every trial that is not finished, and ``finish`` what came out, in one record.

    What is finished is skipped, without so much as starting Ray.

    Parameters
    ----------
    work
        What to train, and where.
    runner
        Trials and their place -> a generator of how they end: :func:`workflows.studies.sweep.ray_trials.ray_trials`.
    finish
        See :data:`Finish`.
    told
        Called whenever a trial has ended.
    """
    trials, folder = work.sweep.trials, work.folder
    runs = {trial.folder(folder.path): trial.training for trial in trials}
    refuse_conflicts(work.sweep.recipe.data, folder, runs)
    with ExitStack() as around:
        begin = once(lambda: _begin(around, work))
        run_stage(generate_stage(work.sweep.recipe.data, folder, TaskRunner()), out=folder.path, before=begin)
        waiting = [trial for trial in trials if not is_finished(trial, folder.data, folder.path)]
        if skipped := len(trials) - len(waiting):
            say(f"trials: {skipped} of {len(trials)} skipped, finished before")
        return finish(_train(work, waiting, runner, begin, told) if waiting else [], begin)


def _begin(around: ExitStack, work: Work) -> None:
    """The resolved recipe and trials on disk, a parent record, a connected Ray."""
    folder, recipe = work.folder, work.sweep.recipe
    save_recipe(recipe, folder.recipe)
    write_sweep(work.sweep, folder.plan)
    parameters = recipe.model_dump(mode="json") | work.parameters
    about = recorded(folder.path, kind=folder.kind, name=work.settings.name, parent=None, parameters=parameters)
    around.enter_context(about)
    update_record(folder.path, artifacts=HEAD)
    around.enter_context(ray_cluster())


def _train(
    work: Work, waiting: Sequence[Trial], runner: TrialRunner, begin: Callable[[], None], told: Callable[[], None]
) -> list[Outcome]:
    begin()
    say(f"trials: {len(waiting)} begin")
    place = prepare(waiting, data=work.folder.data, out=work.folder.path)
    running = runner(waiting, place, tags=work.tags, cpus=work.settings.cpus, gpus=work.settings.gpus)
    return _follow(work.sweep, place, running, told)


def _follow(sweep: Sweep, place: Place, running: Trials, told: Callable[[], None]) -> list[Outcome]:
    """Follow trials until all have ended."""
    dataset, outcomes = open_dataset(place.data), []
    steps = {trial.name: last_step_of(trial.training, dataset) for trial in sweep.trials}
    with closing(running), SweepProgress(sweep.trials, steps, place.out) as progress:
        for outcome in running:
            if outcome is not None:
                outcomes.append(outcome)
                progress.report(outcome)
                told()
            progress.look()
    return outcomes


def run_sweep(
    sweep: Sweep,
    out: Path,
    settings: Settings,
    *,
    runner: TrialRunner = ray_trials,
    show: Callable[[list[TrialResult]], None] = lambda results: None,
) -> list[TrialResult]:
    """Dataset, trials and report into ``out``.

    Returns
    -------
    list of TrialResult
        Of all trials, the best first; ``show`` is given them before anything that failed is raised.

    Raises
    ------
    WorkflowError, TrainingStopped
        See :func:`judge`.
    """
    report = partial(_report, sweep, out, settings)

    def finish(outcomes: list[Outcome], begin: Callable[[], None]) -> list[TrialResult]:
        if not has_record(out):
            begin()
            report()
        results = results_of(sweep, out) if outcomes else _write_report(sweep, out, settings)
        show(results)
        judge(outcomes, of=len(sweep.trials), strict=settings.strict)
        return results

    values = {key: [varied_values(sweep, trial).get(key, "") for trial in sweep.trials] for key in sweep.varied}
    varied = {f"varied.{key}": ", ".join(dict.fromkeys(found)) for key, found in values.items()}
    parameters = {"trials": str(len(sweep.trials))} | varied
    work = Work(sweep, SweepFolder(out), settings, parameters, partial(_tags, sweep))
    return run_trials(work, runner=runner, finish=finish, told=report)


def _tags(sweep: Sweep, trial: Trial) -> dict[str, str]:
    return {f"varied.{key}": value for key, value in varied_values(sweep, trial).items()}


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
    artifacts = [*HEAD, *(name for name in FILES if (out / name).exists())]
    update_record(out, tags=tags, metrics=metrics, artifacts=artifacts)


def _write_report(sweep: Sweep, out: Path, settings: Settings) -> list[TrialResult]:
    return write_report(sweep, out, name=settings.name, cpus=settings.cpus)


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
        error = TrainingStopped(
            f"{_names(stopped)} not finished: {stopped[0].reason}. Run the same command again to resume"
        )
        error.exit_status = stopped[0].exit_status
        raise error
    if failed and (strict or len(failed) == of):
        raise WorkflowError(
            f"{_names(failed)} failed, the first because: {failed[0].reason}. Run the same command again to try them "
            "once more, or leave them out"
        )


def _names(outcomes: Sequence[Outcome]) -> str:
    names = ", ".join(outcome.name for outcome in outcomes)
    return f"{len(outcomes)} trial{'s' if len(outcomes) > 1 else ''} ({names})"
