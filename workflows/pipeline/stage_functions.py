"""The stages' work: generate, train, evaluate. Each leaves a record for MLflow, whatever happens."""

import json
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter

from datagen.common.errors import DsffnetError, TrainingError, TrainingStopped
from datagen.common.files import read_text_within, refuse_links_out, write_atomically
from datagen.common.json_files import read_json_if_whole
from datagen.generate import generate
from datagen.grid import Grid
from datagen.mesh.geometry import bounding_box
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset, ManifestRow, open_dataset
from datagen.store.verify import describe
from training.checkpoints.checkpoint import Which, is_finished, load_checkpoint, require_checkpoint
from training.data.triples import last_step_of, order_of
from training.engine.launch import launch
from training.engine.resume import require_same_training
from training.evaluation.evaluate import NO_OPS, Method, Row, evaluate, read_rows, triples_in, write_rows
from training.evaluation.paper_numbers import method_name
from training.evaluation.tables import COLUMNS, about_weights, mean_of, methods_of, report
from training.inference.predict import load_trained
from training.recipes.training import EvaluationRecipe, TrainingRecipe
from training.reports.examples import draw_comparisons, draw_training_curve, examples_of
from training.reports.plots.training_curve import draw_coefficients
from training.reports.run_summary import this_commit, this_machine
from training.tracking.record import MODEL, Record, begin_record, end_record, flatten, read_record, update_record
from training.viz.mesh_grid import contact_sheet
from workflows.pipeline.console import alone_in
from workflows.pipeline.progress import bar, following, sampling
from workflows.pipeline.stage import say
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.weights_argument import evaluated

_CONTENT = ("uuid", "recipe_sha256", "manifest_sha256")
"""Attributes that tell a dataset from all others, wherever it lies."""


@contextmanager
def recorded(folder: Path, *, kind: str, name: str, parent: Path | None, parameters: dict[str, Any]) -> Iterator[None]:
    """Keep a record in ``folder`` while the block runs, and end it as FINISHED, FAILED or KILLED.

    Raises
    ------
    UnsafeFileError
        A link in the folder leads out of it: what is written there would go elsewhere.
    """
    if parent:  # the outermost folder may hold links of its owner's, such as a dataset on another disk
        refuse_links_out(folder)
    begin_record(folder, name=name, kind=kind, parent=parent, parameters=flatten(parameters))
    try:
        yield
    except (KeyboardInterrupt, SystemExit, TrainingStopped):
        end_record(folder, "KILLED")
        raise
    except BaseException:
        end_record(folder, "FAILED")
        raise
    end_record(folder, "FINISHED")


def generation_bar(rows: Iterable[ManifestRow], grid: Grid) -> Iterator[ManifestRow]:
    """A bar that counts meshes while shards come in."""
    with bar(total=grid.mesh_count, what="generate", unit="mesh") as shown:
        for row in rows:
            shown.update(row.rows)
            yield row


def evaluation_bar(chunks: Iterable[list[Row]], total: int, done: int) -> Iterator[list[Row]]:
    """A bar that counts triples while chunks of rows come in; ``done`` of them were measured before."""
    with bar(total=total, initial=done, what="evaluate", unit="triple") as shown:
        for rows in chunks:
            shown.update(triples_in(rows))
            yield rows


def generate_stage(recipe: DatasetRecipe, url: str, *, folder: Path, parent: Path | None, tasks: TaskRunner) -> None:
    """Make the dataset and a contact sheet of it."""
    with recorded(folder, kind="generate", name="generate", parent=parent, parameters=recipe.model_dump(mode="json")):
        with sampling(folder / "system.jsonl"):
            dataset = generate(recipe, url, run=tasks.make_shards, progress=generation_bar)
        write_atomically(folder / "dataset.json", json.dumps(describe(url), indent=1).encode())
        draw_contact_sheet(dataset, folder / "contact-sheet.png")
        statistics = dataset.attributes["statistics"]
        update_record(
            folder,
            dataset=about_dataset(dataset),
            artifacts=["dataset.json", "contact-sheet.png"],
            metrics={"meshes": float(statistics["meshes"]), "megabytes": statistics["bytes"] / 1e6},
        )


def train_stage(recipe: TrainingRecipe, data: str, run: Path, *, parent: Path | None, tasks: TaskRunner) -> None:
    """Train to the recipe's last step, from the newest checkpoint if there is one."""
    dataset = open_dataset(data)
    check_run_accepts(recipe, dataset, run)
    about = recorded(run, kind="train", name="train", parent=parent, parameters=recipe.model_dump(mode="json"))
    with alone_in(run, ".driver.lock"), about:
        _train(recipe, dataset, run, tasks)


def _train(recipe: TrainingRecipe, dataset: Dataset, run: Path, tasks: TaskRunner) -> None:
    artifacts = ["recipe.yaml", "provenance.json"]
    update_record(run, dataset=about_dataset(dataset), artifacts=artifacts)
    write_run_head(recipe, dataset, run)
    steps, per_epoch = last_step_of(recipe, dataset), order_of(recipe, dataset).steps_per_epoch
    placed = tasks.training(recipe)
    with following(run / "metrics.jsonl", steps=steps, steps_per_epoch=per_epoch):
        launch(placed, data=dataset.url, run=run)
    _say_where_meshes_were(run)
    reached = require_checkpoint(run)
    if not is_finished(reached, steps):
        raise TrainingError(
            f"training in {run} ended at step {reached.step} of {steps}. Run the same command again to go on"
        )
    draw_training_curve(run, run / "figures" / "training-curve.png", baselines={})
    draw_coefficients(run, run / "figures" / "adaptive-coefficients.png")
    artifacts += [name for name in ("metrics.jsonl", "figures", "pictures") if (run / name).exists()]
    update_record(
        run,
        artifacts=artifacts,
        model=MODEL,
        model_version=f"{dataset.uuid} step {require_checkpoint(run, 'result').step}",
    )


def _say_where_meshes_were(run: Path) -> None:
    """What rank 0 noted; its own log does not reach the driver of a local Ray."""
    noted = read_json_if_whole(run, "input.json", _WHERE)
    if noted:
        say(f"train: meshes were kept in {noted['where']}")


_WHERE: TypeAdapter[dict[Literal["where"], str]] = TypeAdapter(dict[Literal["where"], str])


def evaluate_stage(
    recipe: EvaluationRecipe,
    data: str,
    place: Path,
    *,
    parent: Path | None,
    tasks: TaskRunner,
    which: Which = "result",
) -> str:
    """Measure a run or weights, write rows, tables, figures, meshes and viewer; returns the report."""
    dataset, what = open_dataset(data), evaluated(place, which)
    network, trained, step = load_trained(what.weights)
    method = Method(method_name(trained.network), str(what.weights))
    folder = what.folder(dataset)
    parameters = recipe.model_dump(mode="json")
    about_run = recorded(folder, kind="evaluate", name="evaluate", parent=parent, parameters=parameters)
    with alone_in(folder), about_run:
        with sampling(folder / "system.jsonl"):
            keep = folder / "measured"
            runner = tasks.measure(dataset, recipe)
            rows = evaluate([method], data, recipe, tasks=runner, keep=keep, progress=evaluation_bar)
        write_rows(rows, folder / "rows.csv")
        about = about_weights(step, dataset)
        text = report(rows, title=_title(dataset), about=about, emd_points=emd_points_of(recipe, dataset))
        write_atomically(folder / "tables.md", text.encode())
        draw_comparisons(examples_of(dataset, network, recipe, rows), folder, title=_title(dataset))
        if (what.home / "metrics.jsonl").exists():  # exported weights have none
            path = folder / "figures" / "training-curve.png"
            draw_training_curve(what.home, path, baselines=_no_ops(rows))
        update_record(
            folder,
            dataset=about_dataset(dataset),
            artifacts=["rows.csv", "tables.md", "viewer.html", "figures", "meshes"],
            metrics=summary_metrics(rows),
        )
    return text


def _no_ops(rows: list[Row]) -> dict[str, float]:
    """PMD on unseen poses of the methods that do nothing."""
    found = {name: [row.pmd for row in rows if (row.method, row.pose_type) == (name, "unseen")] for name in NO_OPS}
    return {f"{name} (unseen)": float(np.mean(values)) for name, values in found.items() if values}


def check_run_accepts(recipe: TrainingRecipe, dataset: Dataset, run: Path) -> None:
    """Refuse a run that was trained by another recipe or on other data, before anything in it is touched.

    Raises
    ------
    CheckpointError, RecipeError
        It did; the message says what differs.
    """
    if found := load_checkpoint(run):
        require_same_training(recipe, dataset, run, found)


def is_complete(data: str) -> bool:
    """Whether a complete dataset is there, none of its shards missing."""
    try:
        open_dataset(data)
    except DsffnetError:
        return False
    return True


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


def is_evaluated(recipe: EvaluationRecipe, data: str, run: Path) -> bool:
    """Whether the outputs of this evaluation on this dataset are there."""
    record = read_record(run / "evaluation")
    if record is None or record.status != "FINISHED" or record.parameters != flatten(recipe.model_dump(mode="json")):
        return False
    return _is_of(record, data) and _is_whole(run / "evaluation")


def _is_of(record: Record, data: str) -> bool:
    """Whether a record's dataset has the content of this one, wherever either lies: folders are moved and copied."""
    try:
        there = about_dataset(open_dataset(data))
    except DsffnetError:
        return False
    return record.dataset is not None and all(record.dataset.get(key) == there[key] for key in _CONTENT)


def _is_whole(evaluation: Path) -> bool:
    """Whether the outputs of an evaluation are there, and those that are read again can be read."""
    shown = ("viewer.html", "figures/examples.png", "figures/training-curve.png")
    try:
        there = all((evaluation / name).is_file() and (evaluation / name).stat().st_size for name in shown)
        return there and bool(read_rows(evaluation / "rows.csv")) and bool(read_text_within(evaluation, "tables.md"))
    except (OSError, DsffnetError):
        return False


def summary_metrics(rows: list[Row]) -> dict[str, float]:
    """Means of the metrics as MLflow shows them, in the table's units: ``pmd_unseen``, ``target_unchanged/...``.

    Where several networks were measured, theirs have their names before them: ``DSFFNet/pmd_unseen``.
    """
    found, networks = {}, [method for method in methods_of(rows) if method not in NO_OPS]
    for method in methods_of(rows):
        prefix = "" if networks == [method] else f"{method.replace(' ', '_')}/"
        for pose_type in sorted({row.pose_type for row in rows}):
            for column in COLUMNS:
                mean = mean_of(rows, method=method, pose_type=pose_type, field=column.field)
                found[f"{prefix}{column.field}_{pose_type}"] = mean * column.factor
    return found


def about_dataset(dataset: Dataset) -> dict[str, str]:
    """What identifies a dataset."""
    return {"name": Path(dataset.url).name, "url": dataset.url} | {key: dataset.attributes[key] for key in _CONTENT}


def draw_contact_sheet(dataset: Dataset, path: Path, *, identities: int = 6, poses: int = 8) -> Path:
    """A picture of some identities (rows) in some poses (columns), both spread over the whole grid.

    Where training identities have no unseen poses, the seen ones are shown.
    """
    grid = dataset.grid
    chosen = np.unique(np.linspace(0, grid.identity_count - 1, identities).astype(int)).tolist()
    common = set.intersection(*(set(grid.poses_of(identity).tolist()) for identity in chosen))
    columns = [sorted(common)[i] for i in np.unique(np.linspace(0, len(common) - 1, poses).astype(int))]
    meshes = [[_standing(vertices) for vertices in dataset.vertices(i, columns)] for i in chosen]
    labels = [f"identity {i}\n{grid.split(i)}" for i in chosen]
    faces = [dataset.faces(i) for i in chosen]
    return contact_sheet(meshes, faces, labels, [f"pose {p} ({grid.pose_type(p)})" for p in columns], path)


def _standing(vertices: np.ndarray) -> np.ndarray:
    return vertices - bounding_box(vertices).centre


def _title(dataset: Dataset) -> str:
    recipe = dataset.recipe
    least, most = _vertex_counts(dataset)
    counts = f"{least:,}" if least == most else f"{least:,} to {most:,}"
    return f"Pose transfer on {recipe.body.family} bodies of {counts} vertices"


def emd_points_of(recipe: EvaluationRecipe, dataset: Dataset) -> int:
    """Vertices that the earth mover's distance is taken of: as asked, or as many as there are."""
    return min(recipe.emd_points, _vertex_counts(dataset)[1])


def _vertex_counts(dataset: Dataset) -> tuple[int, int]:
    """The fewest and the most vertices of the identities that are evaluated."""
    counts = [dataset.vertex_count(identity) for identity in dataset.identities("evaluation") or [0]]
    return min(counts), max(counts)


def write_run_head(recipe: TrainingRecipe, dataset: Dataset, run: Path) -> None:
    """recipe.yaml (what is trained) and provenance.json (with what, on what bodies), before the work starts."""
    import torch
    import yaml

    from training.inference.domain_check import noted, seen_in

    write_atomically(run / "recipe.yaml", yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False).encode())
    provenance = {
        "dataset": about_dataset(dataset),
        "seen": noted(seen_in(dataset)) if len(dataset.identities("training")) else None,  # that is refused later
        "data_provenance": dataset.attributes["provenance"],
        "python": platform.python_version(),
        "torch": torch.__version__,
        "machine": f"{platform.machine()} {platform.system()}",
        "hardware": this_machine(),
        "git_commit": this_commit(),
    }
    write_atomically(run / "provenance.json", json.dumps(provenance, indent=1).encode())
