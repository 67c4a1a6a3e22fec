"""A comparison from start to end: one dataset, every method trained as a Ray task, all measured on the same triples.

OUT/dataset.zarr, OUT/trials/METHOD (ordinary runs), OUT/evaluation (rows, tables, figures, meshes, viewer),
OUT/report.html and report.md.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from datagen.store import open_dataset
from training.tracking.record import has_record, read_record, update_record
from workflows.pipeline.run_folder import AblationFolder, ComparisonFolder
from workflows.pipeline.stage import Stage, run_stage
from workflows.studies.comparison.evaluate import evaluate_methods, intact, weights_of
from workflows.studies.comparison.plan import ComparisonPlan
from workflows.studies.comparison.report import write_comparison_report
from workflows.studies.sweep.plan import Trial
from workflows.studies.sweep.ray_trials import Outcome, ray_trials
from workflows.studies.sweep.run import HEAD, Settings, Work, judge, run_trials

REPORTS = ("report.html", "report.md")


def folder_of(plan: ComparisonPlan, out: Path) -> ComparisonFolder:
    """The folder of a comparison of that kind."""
    return AblationFolder(out) if plan.kind == "ablation" else ComparisonFolder(out)


def run_comparison(
    plan: ComparisonPlan,
    out: Path,
    *,
    cpus: int = 1,
    gpus: float = 0.0,
    command: str = "",
) -> None:
    """Dataset, trainings, evaluation and report into ``out``; what is finished is skipped.

    Raises
    ------
    WorkflowError, TrainingStopped
        A training has failed or was stopped, see :func:`workflows.studies.sweep.run.judge`.
    """
    folder = folder_of(plan, out)
    runs = {name: trial.folder(out) for name, trial in plan.methods.items()}

    def finish(outcomes: list[Outcome], begin: Callable[[], None]) -> None:
        judge(outcomes, of=len(plan.methods), strict=True)
        trainings = {name: trial.training.model_dump(mode="json") for name, trial in plan.methods.items()}
        evaluate = Stage(
            "evaluate",
            depends_on=[trainings, weights_of(runs), plan.recipe.evaluation.model_dump(mode="json")],
            intact=lambda: intact(folder.evaluation) and has_record(folder.evaluation.path),
            work=lambda: _evaluate(plan, folder, runs),
        )
        if run_stage(evaluate, out=out, before=begin) or not folder.report.exists() or not has_record(out):
            begin()
            _report(plan, folder, runs, command)

    settings = Settings(plan.title, cpus=cpus, gpus=gpus)
    work = Work(plan.sweep, folder, settings, {"methods": ", ".join(plan.methods)}, partial(_tags, plan))
    run_trials(work, runner=ray_trials, finish=finish)


def _tags(plan: ComparisonPlan, trial: Trial) -> dict[str, str]:
    return {"method": next(name for name, method in plan.methods.items() if method == trial)}


def _evaluate(plan: ComparisonPlan, folder: ComparisonFolder, runs: Mapping[str, Path]) -> None:
    """Evaluate; the report of an earlier evaluation goes first, or it would pass for this one's were this cut short."""
    for report in (folder.page, folder.report):
        report.unlink(missing_ok=True)
    evaluate_methods(plan, open_dataset(folder.data), runs, folder)


def _report(plan: ComparisonPlan, folder: ComparisonFolder, runs: Mapping[str, Path], command: str) -> None:
    """Write the report, and give the parent record what a person wants to see first."""
    out = folder.path
    note = write_comparison_report(plan, out, runs, command=command)
    parent, child = read_record(out), read_record(folder.evaluation.path)
    assert parent is not None and child is not None
    names = (*REPORTS, "evaluation/tables.md", "evaluation/viewer.html", "evaluation/figures")
    update_record(
        out,
        artifacts=[*HEAD, *(name for name in names if (out / name).exists())],
        metrics=child.metrics,
        tags=parent.tags | {"mlflow.note.content": note},
    )
