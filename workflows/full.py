"""From nothing to a trained, evaluated, looked-at model: generate, train, evaluate, with MLflow watching.

    python workflows/full.py                                       # the recipe 'quickstart', into runs/quickstart
    python workflows/full.py --recipe smoke --out /tmp/smoke
    python workflows/full.py --set training.steps=8000 --out runs/longer
    ray job submit --working-dir . -- python workflows/full.py --out /data/runs/quickstart

Run the same command again to resume; finished stages are skipped.
"""

import os
import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[1])
if sys.path[0] != _ROOT:  # a script's own folder comes first otherwise, and its files would hide packages
    sys.path[0] = _ROOT

import argparse
import shlex
import shutil
from collections.abc import Sequence
from contextlib import ExitStack

from datagen.common.files import read_text_within
from datagen.recipe import DatasetRecipe
from training.recipes.training import TrainingRecipe
from training.reports.report import NAMES, report_is_current, workflow_report
from training.tracking.mlflow_store import sqlite_file
from training.tracking.record import ALIAS, EXPERIMENT, MODEL, Server, has_record, read_record, update_record
from workflows.cli.declare import (
    add_fresh_option,
    add_help_all,
    add_local_option,
    add_recipe_options,
    add_tracking_option,
    add_yes_option,
    recipe_keys,
)
from workflows.pipeline.console import at_work, guarded, print_text
from workflows.pipeline.evaluate import evaluate_weights, is_evaluated, names_of
from workflows.pipeline.forecast import announce_times
from workflows.pipeline.generate import generate_stage
from workflows.pipeline.ray_cluster import require_reachable
from workflows.pipeline.run_folder import RunFolder, SingleRunFolder
from workflows.pipeline.stage import Stage, begin_workflow, mark_of, once, run_stage
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import is_trained, refuse_conflicts, train_model
from workflows.recipe.loader import WorkflowRecipe, load_recipe


def main(arguments: list[str] | None = None) -> None:
    """Parse, then run the stages while a mirror keeps MLflow up to date."""
    options = _parser(sys.argv[1:] if arguments is None else arguments).parse_args(arguments)
    recipe = load_recipe(options.recipe, options.set)
    out = Path(require_reachable(options.out or f"runs/{Path(options.recipe).stem}", option="--out"))
    folder = SingleRunFolder(out)
    with at_work(options, folder, recipe.data, local=options.local) as server:
        run_workflow(recipe, out, TaskRunner(local=options.local))
        print_text(closing_words(folder, server, beside=recipe.beside is not None))


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        description=__doc__, epilog=recipe_keys(words), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_recipe_options(made)
    add_help_all(made)
    made.add_argument("--out", metavar="DIR", help="folder for dataset, run and MLflow store (default runs/RECIPE)")
    add_tracking_option(made)
    add_fresh_option(made, "what DIR holds of this workflow")
    add_yes_option(made)
    add_local_option(made)
    return made


def run_workflow(recipe: WorkflowRecipe, out: Path, tasks: TaskRunner) -> None:
    """All stages of a recipe into the folder ``out``; finished ones are skipped, and Ray starts for a stage with much
    to do.
    """
    folder = SingleRunFolder(out)
    sections = {name: value for name, value in recipe.model_dump(mode="json").items() if name != "beside" or value}
    known = has_record(out)  # the record of the whole is made again with what it shows: the evaluation and the report
    trainings = [(folder.run, "train", MODEL, recipe.training)]
    if recipe.beside:
        trainings.append((folder.beside, "train-beside", f"{MODEL}-beside", recipe.beside))
    networks = names_of([training for *_, training in trainings])
    refuse_conflicts(recipe.data, folder, {run.path: training for run, _, _, training in trainings})
    announce_times(recipe.data, {name: training for run, name, _, training in trainings if not has_record(run.path)})
    with ExitStack() as around:
        begin = once(lambda: begin_workflow(around, recipe, folder, tasks))
        evaluate = Stage(
            "evaluate",
            depends_on=[sections[name] for name in ("data", "training", "beside", "evaluation") if name in sections],
            intact=lambda: known and is_evaluated(recipe.evaluation, folder.data, folder.run, networks),
            work=lambda: _evaluate(recipe, folder, tasks),
        )
        report = Stage(
            "report",
            depends_on=sections,
            intact=lambda: known and report_is_current(out),
            work=lambda: _report(out),
        )
        trained = [_training_stage(recipe.data, folder, tasks, *each) for each in trainings]
        for stage in (generate_stage(recipe.data, folder, tasks), *trained, evaluate):
            run_stage(stage, out=out, before=begin)
        run_stage(report, out=out, before=lambda: None)


def _training_stage(
    data: DatasetRecipe,
    folder: SingleRunFolder,
    tasks: TaskRunner,
    run: RunFolder,
    name: str,
    model: str,
    training: TrainingRecipe,
) -> Stage:
    def work() -> None:
        train_model(training, folder.data, run, parent=folder.path, tasks=tasks, name=name, model=model)
        if name != "train":  # the evaluation lies within the run, and is not removed with what is beside it
            mark_of(folder.path, "evaluate").unlink(missing_ok=True)

    return Stage(
        name,
        depends_on=[data.model_dump(mode="json"), training.model_dump(mode="json")],
        intact=lambda: is_trained(training, folder.data, run.path) and has_record(run.path),
        work=work,
    )


def _evaluate(recipe: WorkflowRecipe, folder: SingleRunFolder, tasks: TaskRunner) -> None:
    """Evaluate, and give the parent record what a person wants to see first: table, pictures, main metrics."""
    out, evaluation = folder.path, folder.run.evaluation
    beside = folder.beside.path if recipe.beside else None
    table = evaluate_weights(recipe.evaluation, folder.data, folder.run.path, parent=out, tasks=tasks, beside=beside)
    parent, child = read_record(out), read_record(evaluation.path)
    assert parent is not None and child is not None
    pictures = evaluation.examples, evaluation.curve
    shown = [os.path.relpath(path, out) for path in (*pictures, evaluation.viewer, evaluation.tables)]
    update_record(
        out,
        dataset=child.dataset,
        artifacts=["recipe.yaml", *shown],
        metrics=child.metrics,
        tags=parent.tags | {"mlflow.note.content": table},
    )


def _report(out: Path) -> None:
    """The report of the whole, first among what the parent record shows."""
    workflow_report(out)
    record = read_record(out)
    assert record is not None
    update_record(out, artifacts=[*NAMES, *(name for name in record.artifacts if name not in NAMES)])


def closing_words(folder: SingleRunFolder, server: Server, *, beside: bool = False) -> str:
    """The table, where everything lies, and what to try next."""
    out = folder.path
    table = read_text_within(folder.run.evaluation.path, "tables.md")
    shown = Path(os.path.relpath(out)) if out.is_relative_to(Path.cwd()) else out
    run, other = (shlex.quote(str(shown / each.path.name)) for each in (folder.run, folder.beside))
    runs, best = (f"{run}, and beside it {other}", other) if beside else (run, run)
    here = shown / "run" / "evaluation"
    meshes = shlex.quote(str(here / "meshes"))
    programs = _programs()
    dsffnet = f"{programs}dsffnet"
    ui = (
        f"make ui OUT={shlex.quote(str(shown).replace('$', '$$'))}"
        if sqlite_file(server.uri) == Path(os.path.realpath(out)) / "mlflow.db"
        else f"look at MLflow ({server.uri}), experiment {EXPERIMENT!r}"
    )
    return f"""
{table}
Where everything lies
  pictures      {here}/figures/examples.png, training-curve.png
  report        {shown}/report.html, report.md  (all of this on one page, with cards of data and model)
  viewer        {here}/viewer.html  (turn and zoom; open it in a browser)
  meshes        {here}/meshes/*.glb
  table, rows   {here}/tables.md, rows.csv
  run           {runs}  (weights in checkpoints/, metrics.jsonl)
  dataset       {shown}/dataset.zarr
  MLflow        {server.uri}, experiment {EXPERIMENT!r}, model 'models:/{MODEL}@{ALIAS}'

Try next
  {ui}
  {dsffnet} transfer --model {best} {meshes}/00-source.glb {meshes}/01-target.glb -o posed.glb --picture
  {programs}python workflows/full.py --out runs/custom --set data.identities.seed=7 data.identities.training=24
"""


def _programs() -> str:
    """Folder of this environment's programs with a slash after it, or nothing where the shell finds them anyway."""
    here = Path(sys.executable).parent
    if shutil.which("dsffnet") == str(here / "dsffnet"):
        return ""
    return f"{os.path.relpath(here) if here.is_relative_to(Path.cwd()) else here}/"


if __name__ == "__main__":
    guarded(main)
