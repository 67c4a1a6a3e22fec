"""What trained methods are measured on: the same triples for all; rows -> tables, figures, meshes, viewer."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from pydantic import TypeAdapter

from datagen.common.errors import DsffnetError
from datagen.common.files import read_json, write_atomically
from datagen.generate import ray_runner
from datagen.store import Dataset
from training.checkpoints.checkpoint import require_checkpoint
from training.data.batch import Batch, read_batch
from training.evaluation.document import Text, document_markdown, plain
from training.evaluation.evaluate import (
    POSE_TYPES,
    Method,
    Row,
    evaluate,
    evaluation_list,
    fingerprint_of,
    write_rows,
)
from training.evaluation.timing import Inference, measure_inference
from training.inference.predict import load_trained
from training.recipes.training import EvaluationRecipe
from training.reports.examples import comparisons_of, draw_comparisons
from training.reports.plots.ablation import ablation_figure
from training.reports.plots.convergence import convergence_figure
from workflows.pipeline.evaluate import end_evaluation, evaluation_bar, measured_methods
from workflows.pipeline.progress import sampling
from workflows.pipeline.run_folder import ComparisonFolder, EvaluationFolder
from workflows.pipeline.stage import recorded
from workflows.studies.comparison.plan import ComparisonPlan
from workflows.studies.comparison.tables import tables_of

FOLDER = "evaluation"


def weights_of(runs: Mapping[str, Path]) -> dict[str, str]:
    """The weights that each method is measured with, as a word that changes with them."""
    return {name: fingerprint_of(require_checkpoint(run, "result")) for name, run in runs.items()}


def intact(folder: EvaluationFolder) -> bool:
    """Whether the outputs of the evaluation are there, and those that are read again can be read."""
    try:
        return bool(measured_methods(folder)) and bool(read_inference(folder.path.parent))
    except (OSError, DsffnetError):
        return False


def read_inference(out: Path) -> dict[str, Inference]:
    """Size and time of each method, as :func:`evaluate_methods` measured them.

    Raises
    ------
    DamagedFileError, UnsafeFileError, OSError
        There is no such file, or it holds something else.
    """
    return read_json(out / FOLDER, "inference.json", _INFERENCE)


_INFERENCE = TypeAdapter(dict[str, Inference])


def evaluate_methods(plan: ComparisonPlan, dataset: Dataset, runs: Mapping[str, Path], out: ComparisonFolder) -> None:
    """Measure every method on the dataset's fixed triples, and show it."""
    recipe, folder = plan.recipe.evaluation, out.evaluation
    parameters = recipe.model_dump(mode="json")
    with (
        recorded(folder.path, kind="evaluate", name="evaluate", parent=out.path, parameters=parameters),
        sampling(folder.load),
    ):
        methods = [Method(name, str(require_checkpoint(run, "result").path)) for name, run in runs.items()]
        rows = evaluate(methods, dataset.url, recipe, tasks=ray_runner, keep=folder.chunks, progress=evaluation_bar)
        write_rows(rows, folder.rows)
        inference = measure_inference(methods, _first_pair(dataset, recipe))
        values = {name: asdict(measured) for name, measured in inference.items()}
        write_atomically(folder.inference, json.dumps(values, indent=1).encode())
        tables = tables_of(plan, dataset, runs, rows, inference)
        text = document_markdown(plan.title, [Text(plain(plan.description)), *tables])
        write_atomically(folder.tables, text.encode())
        _draw(plan, dataset, runs, rows, folder)
        artifacts = ["rows.csv", "tables.md", "viewer.html", "inference.json", "figures", "meshes"]
        end_evaluation(folder, dataset, rows, artifacts)


def _first_pair(dataset: Dataset, recipe: EvaluationRecipe) -> Batch:
    lists = [evaluation_list(dataset, recipe, pose_type) for pose_type in POSE_TYPES]
    return read_batch(dataset, next(triples for triples in lists if len(triples))[:1], surfaces=True)


def _draw(
    plan: ComparisonPlan, dataset: Dataset, runs: Mapping[str, Path], rows: list[Row], folder: EvaluationFolder
) -> None:
    networks = {name: load_trained(run)[0] for name, run in runs.items()}
    examples = comparisons_of(dataset, networks, plan.recipe.evaluation, rows)
    draw_comparisons(examples, folder.path, title=plan.title)
    convergence_figure(runs, folder.figures / "convergence.png")
    if plan.kind == "ablation":
        trained = [row for name in plan.methods for row in rows if row.method == name]
        ablation_figure(trained, folder.figures / "ablation.png")
