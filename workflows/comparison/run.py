"""A comparison from start to end: one dataset, every method trained as a Ray task, all measured on the same triples.

OUT/dataset.zarr, OUT/trials/METHOD (ordinary runs), OUT/evaluation (rows, tables, figures, meshes, viewer),
OUT/report.html and report.md.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from datagen.store import open_dataset
from training.tracking.record import has_record, read_record, update_record
from workflows.comparison.evaluate import FOLDER, evaluate_methods, intact, weights_of
from workflows.comparison.plan import ComparisonPlan
from workflows.comparison.report import REPORT, write_comparison_report
from workflows.pipeline.ray_cluster import ray_cluster
from workflows.pipeline.stage import Stage, once, run_stage
from workflows.pipeline.stage_functions import recorded
from workflows.recipe.loader import save_recipe
from workflows.sweep.plan import Trial, write_sweep
from workflows.sweep.ray_trials import ray_trials
from workflows.sweep.run import Runner, generate_and_train, judge, refuse_conflicts

REPORTS = ("report.html", "report.md")
OWN = ("trials", "trials.yaml", ".sweep", "evaluation", *REPORTS)
"""What a comparison keeps in its folder, beyond what every workflow does."""


@dataclass(frozen=True)
class Settings:
    """How a comparison is run; nothing of it changes what is learned."""

    cpus: int = 1
    gpus: float = 0.0


def run_comparison(
    plan: ComparisonPlan, out: Path, settings: Settings, *, runner: Runner = ray_trials, command: str = ""
) -> Path:
    """Dataset, trainings, evaluation and report into ``out``; what is finished is skipped.

    Returns
    -------
    Path
        The report as Markdown.

    Raises
    ------
    WorkflowError, TrainingStopped
        A training has failed or was stopped, see :func:`workflows.sweep.run.judge`.
    """
    sweep, data = plan.sweep, str(out / "dataset.zarr")
    refuse_conflicts(sweep, data, out, kind=plan.kind)
    with ExitStack() as around:
        begin = once(lambda: _begin(around, plan, out))
        outcomes = generate_and_train(
            sweep,
            out,
            begin=begin,
            running=partial(runner, tags=partial(_tags, plan), cpus=settings.cpus, gpus=settings.gpus),
        )
        judge(outcomes, of=len(sweep.trials), strict=True)
        runs = {name: trial.folder(out) for name, trial in plan.methods.items()}
        evaluate = Stage(
            "evaluate",
            depends_on=[_learned(plan), weights_of(runs), plan.recipe.evaluation.model_dump(mode="json")],
            intact=lambda: intact(out) and has_record(out / FOLDER),
            work=partial(_evaluate, plan, data, runs, out),
        )
        evaluated = run_stage(evaluate, out=out, before=begin)
        if evaluated or not (out / REPORT).exists() or not has_record(out):
            begin()
            _report(plan, out, runs, command)
    return out / REPORT


def _begin(around: ExitStack, plan: ComparisonPlan, out: Path) -> None:
    """The resolved recipe and methods on disk, a parent record, a connected Ray."""
    save_recipe(plan.recipe, out / "recipe.yaml")
    write_sweep(plan.sweep, out / "trials.yaml")
    parameters = plan.recipe.model_dump(mode="json") | {"methods": ", ".join(plan.methods)}
    around.enter_context(recorded(out, kind=plan.kind, name=plan.title, parent=None, parameters=parameters))
    update_record(out, artifacts=["recipe.yaml", "trials.yaml"])
    around.enter_context(ray_cluster())


def _learned(plan: ComparisonPlan) -> dict[str, object]:
    return {name: trial.training.model_dump(mode="json") for name, trial in plan.methods.items()}


def _tags(plan: ComparisonPlan, trial: Trial) -> dict[str, str]:
    return {"method": next(name for name, its in plan.methods.items() if its == trial)}


def _evaluate(plan: ComparisonPlan, data: str, runs: Mapping[str, Path], out: Path) -> None:
    """Evaluate; the report of an earlier evaluation goes first, or it would pass for this one's were this cut short."""
    for name in REPORTS:
        (out / name).unlink(missing_ok=True)
    evaluate_methods(plan, open_dataset(data), runs, out)


def _report(plan: ComparisonPlan, out: Path, runs: Mapping[str, Path], command: str) -> None:
    """Write the report, and give the parent record what a person wants to see first."""
    note = write_comparison_report(plan, out, runs, command=command)
    parent, child = read_record(out), read_record(out / "evaluation")
    assert parent is not None and child is not None
    names = (*REPORTS, "evaluation/tables.md", "evaluation/viewer.html", "evaluation/figures")
    update_record(
        out,
        artifacts=["recipe.yaml", "trials.yaml", *(name for name in names if (out / name).exists())],
        metrics=child.metrics,
        tags=parent.tags | {"mlflow.note.content": note},
    )
