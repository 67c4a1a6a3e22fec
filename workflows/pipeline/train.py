"""The stage that trains, and what every training of a command has in common."""

import os
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from pydantic import TypeAdapter

from datagen.common.errors import DsffnetError, TrainingError
from datagen.common.files import read_json_if_whole, refuse_links_out, resolve_within
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset, open_dataset
from datagen.store.attributes import check_same_recipe
from datagen.store.schema import open_group
from training.checkpoints.checkpoint import is_finished, load_checkpoint, require_checkpoint
from training.data.triples import last_step_of, order_of
from training.engine.launch import launch
from training.engine.resume import newest_of, require_same_training
from training.evaluation.document import plain
from training.inference.domain_check import noted, seen_in
from training.objectives import PMD_UNIT
from training.recipes.networks import NetworkRecipe
from training.recipes.training import TrainingRecipe
from training.reports.plots.training_curve import draw_coefficients, draw_training_curve
from training.tracking.journal import read_journal
from training.tracking.provenance import write_run_head
from training.tracking.record import MODEL, about_dataset, update_record
from workflows.pipeline.generate import is_complete
from workflows.pipeline.progress import following
from workflows.pipeline.run_folder import RunFolder, WorkflowFolder
from workflows.pipeline.stage import recorded, say
from workflows.pipeline.tasks import TaskRunner

HEAD = ["recipe.yaml", "provenance.json"]
_WHERE: TypeAdapter[dict[Literal["where"], str]] = TypeAdapter(dict[Literal["where"], str])


def train_model(
    recipe: TrainingRecipe,
    data: str,
    run: RunFolder,
    *,
    parent: Path | None,
    tasks: TaskRunner,
    name: str = "train",
    model: str = MODEL,
) -> None:
    """Train to the recipe's last step, from the newest checkpoint if there is one, and register the ``model``.

    ``name`` is that of its record.
    """
    dataset = open_dataset(data)
    check_run_accepts(recipe, dataset, run.path)
    parameters = recipe.model_dump(mode="json")
    if parent:
        update_record(parent, dataset=about_dataset(dataset))  # the whole names it from now on
    with run.alone(), recorded(run.path, kind="train", name=name, parent=parent, parameters=parameters):
        begin_run(recipe, dataset, run)
        per_epoch, placed = order_of(recipe, dataset).steps_per_epoch, tasks.training(recipe)
        with following(run.journal, steps=last_step_of(recipe, dataset), steps_per_epoch=per_epoch):
            train_run(placed, dataset, run)
        _say_where_meshes_were(run.path)
        draw_coefficients(run.path, run.coefficients)
        step = require_checkpoint(run.path, "result").step
        update_record(
            run.path,
            artifacts=[
                *HEAD,
                *(name for name in ("metrics.jsonl", "figures", "pictures") if (run.path / name).exists()),
            ],
            model=model,
            model_version=f"{dataset.uuid} step {step}",
            model_about=about_model(recipe.network, step, dataset, _pmd_at(step, run)),
        )


def begin_run(recipe: TrainingRecipe, dataset: Dataset, run: RunFolder, **record: Any) -> None:
    """Note in a run's folder and ``record`` what is trained, with what and on what, before the work starts."""
    update_record(run.path, dataset=about_dataset(dataset), artifacts=HEAD, **record)
    write_head(recipe, dataset, run.path)


def write_head(recipe: TrainingRecipe, dataset: Dataset, run: Path) -> None:
    """Write recipe.yaml and provenance.json."""
    write_run_head(
        run,
        recipe.model_dump(mode="json"),
        dataset=about_dataset(dataset),
        seen=noted(seen_in(dataset)) if len(dataset.identities("training")) else None,  # that is refused later
        data_provenance=dataset.attributes["provenance"],
    )


def train_run(recipe: TrainingRecipe, dataset: Dataset, run: RunFolder) -> None:
    """Train to the last step, and draw the curve; the errors are those of :func:`train_to_end`."""
    train_to_end(recipe, dataset.url, run.path, last_step_of(recipe, dataset))
    draw_training_curve(run.path, run.curve, baselines={})


def train_to_end(recipe: TrainingRecipe, data: str, run: Path, last: int) -> None:
    """Train to the ``last`` step.

    Raises
    ------
    TrainingError
        It ended before that.
    """
    launch(recipe, data=data, run=run)
    reached = require_checkpoint(run)
    if not is_finished(reached, last):
        raise TrainingError(
            f"training in {run} ended at step {reached.step} of {last}. Run the same command again to resume"
        )


def _pmd_at(step: int, run: RunFolder) -> dict[str, float]:
    """PMD by pose type as the training measured it last up to a step."""
    rows = [row for row in read_journal(run.journal) if row["step"] <= step]
    found = {key: value for row in rows for key, value in row.items() if key.startswith("evaluation/pmd_")}
    return {key.removeprefix("evaluation/pmd_"): value for key, value in found.items()}


def about_model(network: NetworkRecipe, step: int, dataset: Dataset, pmd: Mapping[str, float]) -> str:
    """Weights in two paragraphs of markup: on what they were trained, and their PMD by pose type."""
    people, poses = len(dataset.identities("training")), len(dataset.grid.poses("seen"))
    name = plain(PurePosixPath(dataset.url).name)
    scores = ", ".join(f"{value / PMD_UNIT:.2f}e-4 in {pose_type} poses" for pose_type, value in pmd.items())
    return (
        f"{plain(network.title)}, step {step:,} of a training on {name}: {dataset.recipe.body.family} "
        f"bodies, {people:,} identities in {poses:,} poses ({dataset.uuid}).\n\n"
        f"PMD of new identities: {scores or 'not measured'}."
    )


def _say_where_meshes_were(run: Path) -> None:
    """What rank 0 noted; its own log does not reach the driver of a local Ray."""
    noted = read_json_if_whole(run, "input.json", _WHERE)
    if noted:
        say(f"train: meshes were kept in {noted['where']}")


def refuse_conflicts(recipe: DatasetRecipe, folder: WorkflowFolder, runs: Mapping[Path, TrainingRecipe]) -> None:
    """Refuse a folder of another kind of work, or whose dataset or ``runs`` were made by other recipes.

    Raises
    ------
    RecipeError, DatasetError, CheckpointError
        It is one; nothing in it was touched.
    UnsafeFileError
        A link leads out of it, where something would be written; the dataset may lie elsewhere.
    """
    folder.require_kind()
    refuse_links_out(folder.path, but=(folder.dataset.name,))
    for run in runs:
        resolve_within(folder.path, os.path.relpath(run, folder.path))
    if not (folder.dataset / "zarr.json").exists():
        return
    group = open_group(folder.data)
    if "format_version" in group.attrs:  # it is missing where the very first write was cut short
        check_same_recipe(folder.data, group, recipe)
    if is_complete(folder.data):
        dataset = open_dataset(folder.data)
        for run, training in runs.items():
            section = "beside" if run == folder.path / "beside" else "training"  # as in a SingleRunFolder
            check_run_accepts(training, dataset, run, section=section)


def check_run_accepts(recipe: TrainingRecipe, dataset: Dataset, run: Path, *, section: str = "training") -> None:
    """Refuse a run that was trained by another recipe or on other data, before anything in it is touched.

    Raises
    ------
    CheckpointError, RecipeError
        It did; the message says what differs.
    """
    if found := newest_of(run):
        require_same_training(recipe, dataset, run, found, section=section)


def is_trained(recipe: TrainingRecipe, data: str, run: Path) -> bool:
    """Whether a run holds a sound checkpoint of the end of this recipe's training on this dataset."""
    try:
        dataset, found = open_dataset(data), load_checkpoint(run)
        if found is None:
            return False
        require_same_training(recipe, dataset, run, found)
        return is_finished(found, last_step_of(recipe, dataset))
    except DsffnetError:
        return False
