"""The stage that measures a run or weights: rows, tables, figures, meshes and viewer."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import nn

from datagen.common.errors import DsffnetError
from datagen.common.files import read_text_within, write_atomically
from datagen.store import Dataset, open_dataset
from training.checkpoints.checkpoint import Which
from training.evaluation.evaluate import NO_OPS, Method, Row, evaluate, read_rows, triples_in, write_rows
from training.evaluation.tables import COLUMNS, about_weights, mean_of, methods_of, report
from training.inference.predict import load_trained
from training.inference.projection import PROJECTED, OntoParts
from training.recipes.training import EvaluationRecipe, TrainingRecipe
from training.reports.card_texts import span, vertex_counts
from training.reports.examples import comparisons_of, draw_comparisons
from training.reports.plots.training_curve import draw_training_curve
from training.tracking.record import CONTENT, Record, about_dataset, flatten, has_record, read_record, update_record
from workflows.pipeline.progress import bar, sampling
from workflows.pipeline.run_folder import EvaluationFolder, RunFolder
from workflows.pipeline.stage import recorded
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import about_model
from workflows.pipeline.weights_argument import Evaluated, evaluated

ARTIFACTS = ["rows.csv", "tables.md", "viewer.html", "figures", "meshes"]


def evaluate_weights(
    recipe: EvaluationRecipe,
    data: str,
    place: Path,
    *,
    parent: Path | None,
    tasks: TaskRunner,
    which: Which = "result",
    project: Path | None = None,
    beside: Path | None = None,
) -> str:
    """Measure a run or weights, and show what came out; returns the report.

    Parameters
    ----------
    project
        Weights of a parts network; the outputs projected onto its parts have a row of their own.
    beside
        Another run, measured on the same triples.
    """
    dataset, what = open_dataset(data), evaluated(place, which)
    weights = [what, *([evaluated(beside)] if beside else [])]
    shown = _shown(weights)
    main = next(iter(shown))
    methods = [one.method for one in shown.values()]
    if project:
        OntoParts.of(shown[main].network, project)  # refuses what does not go together before anything is measured
        methods.append(Method(f"{main}{PROJECTED}", str(what.weights), str(project)))
    folder, parameters = EvaluationFolder(what.folder(dataset)), recipe.model_dump(mode="json")
    with (
        folder.alone(),
        recorded(folder.path, kind="evaluate", name="evaluate", parent=parent, parameters=parameters),
    ):
        with sampling(folder.load):
            runner = tasks.measure(dataset, recipe)
            rows = evaluate(methods, data, recipe, tasks=runner, keep=folder.measured, progress=evaluation_bar)
        write_rows(rows, folder.rows)
        about = about_weights({name: one.step for name, one in shown.items()}, dataset)
        text = report(rows, title=_title(dataset), about=about, emd_points=emd_points_of(recipe, dataset))
        write_atomically(folder.tables, text.encode())
        networks = {name: one.network for name, one in shown.items()}
        draw_comparisons(comparisons_of(dataset, networks, recipe, rows), folder.path, title=_title(dataset))
        if RunFolder(what.home).journal.exists():  # exported weights have none
            draw_training_curve(what.home, folder.curve, baselines=_no_ops(rows))
        end_evaluation(folder, dataset, rows, ARTIFACTS, main=main)
        for each, (name, one) in zip(weights, shown.items(), strict=True):
            _describe_model(each, one, name, dataset, rows)
    return text


class _Shown(NamedTuple):
    """Weights that are measured and drawn."""

    method: Method
    network: nn.Module
    step: int
    recipe: TrainingRecipe


def _shown(weights: Sequence[Evaluated]) -> dict[str, _Shown]:
    """Weights by the names that tables give them."""
    loaded = [load_trained(each.weights) for each in weights]
    names = names_of([trained for _, trained, _ in loaded])
    return {
        name: _Shown(Method(name, str(each.weights)), network, step, trained)
        for name, each, (network, trained, step) in zip(names, weights, loaded, strict=True)
    }


def names_of(trainings: Sequence[TrainingRecipe]) -> list[str]:
    """Return what tables call the networks of some trainings; a second one of the same name says that it is."""
    titles = [training.network.title for training in trainings]
    return [f"{title} beside" if title in titles[:place] else title for place, title in enumerate(titles)]


def _describe_model(weights: Evaluated, shown: _Shown, name: str, dataset: Dataset, rows: list[Row]) -> None:
    """Let a run's registered model say what it scores, where these rows are of its result, on its own data."""
    run = RunFolder(weights.home)
    if weights.folder(dataset) == run.evaluation.path and has_record(run.path):
        pmd = {each: mean_of(rows, method=name, pose_type=each, field="pmd") for each in _types(rows)}
        update_record(run.path, model_about=about_model(shown.recipe.network, shown.step, dataset, pmd))


def end_evaluation(
    folder: EvaluationFolder, dataset: Dataset, rows: list[Row], artifacts: list[str], *, main: str = ""
) -> None:
    """Give an evaluation's record its data, its artifacts and its metrics (see `summary_metrics`)."""
    metrics = summary_metrics(rows, main=main)
    update_record(folder.path, dataset=about_dataset(dataset), artifacts=artifacts, metrics=metrics)


def evaluation_bar(chunks: Iterable[list[Row]], total: int, done: int) -> Iterator[list[Row]]:
    """A bar that counts triples while chunks of rows come in; ``done`` of them were measured before."""
    with bar(total=total, initial=done, what="evaluate", unit="triple") as shown:
        for rows in chunks:
            shown.update(triples_in(rows))
            yield rows


def _no_ops(rows: list[Row]) -> dict[str, float]:
    """PMD on unseen poses of the methods that do nothing."""
    found = {name: [row.pmd for row in rows if (row.method, row.pose_type) == (name, "unseen")] for name in NO_OPS}
    return {f"{name} (unseen)": float(np.mean(values)) for name, values in found.items() if values}


def is_evaluated(recipe: EvaluationRecipe, data: str, run: RunFolder, names: Sequence[str] = ()) -> bool:
    """Whether the outputs of this evaluation on this dataset are there, those of networks of these names among them."""
    record = read_record(run.evaluation.path)
    if record is None or record.status != "FINISHED" or record.parameters != flatten(recipe.model_dump(mode="json")):
        return False
    shown = (run.evaluation.examples, run.evaluation.curve)
    measured = measured_methods(run.evaluation)
    return bool(measured) and measured.issuperset(names) and _is_of(record, data) and all(map(_has_content, shown))


def _is_of(record: Record, data: str) -> bool:
    """Whether a record's dataset has the content of this one, wherever either lies: folders are moved and copied."""
    try:
        there = about_dataset(open_dataset(data))
    except DsffnetError:
        return False
    return record.dataset is not None and all(record.dataset.get(key) == there[key] for key in CONTENT)


def measured_methods(evaluation: EvaluationFolder) -> set[str]:
    """The methods that an evaluation has rows of; none where its viewer is missing, or its tables are unreadable."""
    try:
        rows, tables = read_rows(evaluation.rows), read_text_within(evaluation.path, evaluation.tables.name)
    except (OSError, DsffnetError):
        return set()
    return {row.method for row in rows} if tables and _has_content(evaluation.viewer) else set()


def _has_content(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def summary_metrics(rows: list[Row], *, main: str = "") -> dict[str, float]:
    """Means of the metrics as MLflow shows them, in the table's units: ``pmd_unseen``, ``target_unchanged/...``.

    Those of all methods but the ``main`` one have their names before them: ``DSFFNet/pmd_unseen``.
    """
    found = {}
    for method in methods_of(rows):
        prefix = "" if method == main else f"{method.replace(' ', '_')}/"
        for pose_type in _types(rows):
            for column in COLUMNS:
                mean = mean_of(rows, method=method, pose_type=pose_type, field=column.field)
                found[f"{prefix}{column.field}_{pose_type}"] = mean * column.factor
    return found


def _types(rows: list[Row]) -> list[str]:
    return sorted({row.pose_type for row in rows})


def _title(dataset: Dataset) -> str:
    counts = span(vertex_counts(dataset, "evaluation"))
    return f"Pose transfer on {dataset.recipe.body.family} bodies of {counts} vertices"


def emd_points_of(recipe: EvaluationRecipe, dataset: Dataset) -> int:
    """Vertices that the earth mover's distance is taken of: as asked, or as many as there are."""
    return min(recipe.emd_points, max(vertex_counts(dataset, "evaluation")))
