"""From nothing to a trained, evaluated, looked-at model: generate, train, evaluate, with MLflow watching.

    python workflows/full.py                                       # the recipe 'quickstart', into runs/quickstart
    python workflows/full.py --recipe smoke --out /tmp/smoke
    python workflows/full.py --set training.steps=8000 --out runs/longer
    ray job submit --working-dir . -- python workflows/full.py --out /data/runs/quickstart

Run the same command again to go on from where it was; finished stages are skipped.
"""

import os
import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[1])
if sys.path[0] != _ROOT:  # a script's own folder comes first otherwise, and its files would hide packages
    sys.path[0] = _ROOT

from contextlib import ExitStack
from functools import partial

from datagen.common.files import read_text_within
from datagen.store import open_dataset
from datagen.store.attributes import check_same_recipe
from datagen.store.schema import open_group
from training.reports.report import NAMES, report_is_current, workflow_report
from training.tracking.mlflow_mirror import Mirror
from training.tracking.record import has_record, read_record, update_record
from workflows.pipeline.console import (
    add_local_option,
    alone_in,
    closing_words,
    guarded,
    print_text,
    server_of,
    start_over,
    workflow_parser,
)
from workflows.pipeline.data_size import announce_size
from workflows.pipeline.ray_cluster import require_reachable
from workflows.pipeline.stage import Stage, once, refuse_other_kind, run_stage
from workflows.pipeline.stage_functions import (
    check_run_accepts,
    evaluate_stage,
    generate_stage,
    is_complete,
    is_evaluated,
    is_trained,
    recorded,
    train_stage,
)
from workflows.pipeline.tasks import TaskRunner
from workflows.recipe.loader import WorkflowRecipe, load_recipe, save_recipe


def main(arguments: list[str] | None = None) -> None:
    """Parse, then run the stages while a mirror keeps MLflow up to date."""
    parser = workflow_parser(__doc__ or "")
    add_local_option(parser)
    options = parser.parse_args(arguments)
    recipe = load_recipe(options.recipe, options.set)
    name = Path(options.recipe).stem
    out = Path(require_reachable(options.out or f"runs/{name}", option="--out"))
    announce_size(recipe.data, str(out / "dataset.zarr"), anew=options.fresh, yes=options.yes, local=options.local)
    server = server_of(out, options.tracking_uri)
    mirror = Mirror(out, server)
    with alone_in(out):
        if options.fresh:
            start_over(out)
        mirror.start()
        try:
            run_workflow(recipe, out, TaskRunner(local=options.local))
        finally:
            outage = mirror.close()
    print_text(closing_words(out, server))
    if outage:
        raise outage


def run_workflow(recipe: WorkflowRecipe, out: Path, tasks: TaskRunner) -> None:
    """All stages of a recipe into the folder ``out``; finished ones are skipped, and Ray starts for a stage with much
    to do.
    """
    data, run = str(out / "dataset.zarr"), out / "run"
    sections = recipe.model_dump(mode="json")
    refuse_other_kind(out, "workflow")
    known = has_record(out)  # the record of the whole is made again with what it shows: the evaluation and the report
    _refuse_conflicts(recipe, data, run)
    with ExitStack() as around:
        begin = once(lambda: _begin(around, recipe, out, tasks))
        generate = Stage(
            "generate",
            depends_on=sections["data"],
            intact=lambda: is_complete(data) and has_record(out / "generate"),
            work=partial(generate_stage, recipe.data, data, folder=out / "generate", parent=out, tasks=tasks),
        )
        train = Stage(
            "train",
            depends_on=[sections["data"], sections["training"]],
            intact=lambda: is_trained(recipe.training, data, run) and has_record(run),
            work=partial(train_stage, recipe.training, data, run, parent=out, tasks=tasks),
        )
        evaluate = Stage(
            "evaluate",
            depends_on=[sections["data"], sections["training"], sections["evaluation"]],
            intact=lambda: known and is_evaluated(recipe.evaluation, data, run),
            work=partial(_evaluate, recipe, data, run, out, tasks),
        )
        for stage in (generate, train, evaluate):
            run_stage(stage, out=out, before=begin)
        report = Stage(
            "report",
            depends_on=sections,
            intact=lambda: known and report_is_current(out),
            work=lambda: _report(out),
        )
        run_stage(report, out=out, before=lambda: None)


def _refuse_conflicts(recipe: WorkflowRecipe, data: str, run: Path) -> None:
    """Refuse a folder whose dataset or run was made by another recipe, before anything in it is touched."""
    if not (Path(data) / "zarr.json").exists():
        return
    group = open_group(data)
    if "format_version" in group.attrs:  # it is missing where the very first write was cut short
        check_same_recipe(data, group, recipe.data)
    if is_complete(data):
        check_run_accepts(recipe.training, open_dataset(data), run)


def _begin(around: ExitStack, recipe: WorkflowRecipe, out: Path, tasks: TaskRunner) -> None:
    """What the first stage with work to do needs: the resolved recipe on disk, a parent record, a place for tasks."""
    save_recipe(recipe, out / "recipe.yaml")
    parameters = recipe.model_dump(mode="json")
    around.enter_context(recorded(out, kind="workflow", name=out.name, parent=None, parameters=parameters))
    update_record(out, artifacts=["recipe.yaml"])
    around.enter_context(tasks)


def _evaluate(recipe: WorkflowRecipe, data: str, run: Path, out: Path, tasks: TaskRunner) -> None:
    """Evaluate, and give the parent record what a person wants to see first: table, pictures, main metrics."""
    evaluate_stage(recipe.evaluation, data, run, parent=out, tasks=tasks)
    evaluation = run / "evaluation"
    parent, child = read_record(out), read_record(evaluation)
    assert parent is not None and child is not None
    shown = [os.path.relpath(evaluation / name, out) for name in ("tables.md", "viewer.html", "figures")]
    update_record(
        out,
        artifacts=["recipe.yaml", *shown],
        metrics=child.metrics,
        tags=parent.tags | {"mlflow.note.content": read_text_within(evaluation, "tables.md")},
    )


def _report(out: Path) -> None:
    """The report of the whole, first among what the parent record shows."""
    workflow_report(out)
    record = read_record(out)
    assert record is not None
    update_record(out, artifacts=[*NAMES, *(name for name in record.artifacts if name not in NAMES)])


if __name__ == "__main__":
    guarded(main)
