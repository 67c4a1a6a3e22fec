"""The tables of a comparison: the paper's with its numbers beside ours, what training cost, and every metric."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from datagen.store import Dataset
from training.data.triples import last_step_of
from training.evaluation.document import Table
from training.evaluation.evaluate import Row
from training.evaluation.paper_numbers import PaperData
from training.evaluation.run_curves import run_curve
from training.evaluation.tables import DEFINITIONS, summary, table_1, table_2, table_3
from training.evaluation.timing import Inference
from training.objectives import PMD_UNIT
from training.reports.card_texts import span, vertex_counts
from training.tracking.journal import read_journal
from workflows.pipeline.evaluate import emd_points_of
from workflows.studies.comparison.plan import ComparisonPlan


def tables_of(
    plan: ComparisonPlan,
    dataset: Dataset,
    runs: Mapping[str, Path],
    rows: list[Row],
    inference: Mapping[str, Inference],
) -> list[Table]:
    """All tables, the paper's first."""
    points, here = emd_points_of(plan.recipe.evaluation, dataset), _here(dataset)
    if plan.kind == "ablation":
        first = [table_3(rows, here=here, emd_points=points)]
    else:
        data: PaperData = "SMAL" if plan.recipe.data.body.family in _ANIMALS else "SMPL"
        first = [table_1(rows, data=data, here=here, emd_points=points), table_2(inference)]
    every = replace(summary(rows), caption="Every metric", notes=DEFINITIONS.format(points=points))
    return [*first, Table(_costs(plan, dataset, runs), "What training cost", _COSTS), every]


def _costs(plan: ComparisonPlan, dataset: Dataset, runs: Mapping[str, Path]) -> list[list[str]]:
    lines = [["method", "steps", "triples", "minutes", "ms a triple", "PMD unseen, last 3 evaluations"]]
    for name, trial in plan.methods.items():
        training = trial.training
        steps = last_step_of(training, dataset)
        curve = run_curve(read_journal(runs[name] / "metrics.jsonl"), "evaluation/pmd_unseen", batch=training.batch)
        seconds = float(curve.seconds[-1]) if len(curve) else float("nan")
        last = ", ".join(f"{pmd / PMD_UNIT:.1f}" for pmd in curve.pmd[-3:])
        triples = steps * training.batch
        lines.append(
            [name, f"{steps:,}", f"{triples:,}", f"{seconds / 60:.1f}", f"{1000 * seconds / triples:.1f}", last]
        )
    return lines


def _here(dataset: Dataset) -> str:
    """In a few words, what was measured on."""
    identities, grid = dataset.identities("evaluation"), dataset.grid
    counts = span(vertex_counts(dataset, "evaluation"))
    learned = f"{len(dataset.identities('training'))} x {len(grid.poses('seen')):,}"
    return (
        f"{dataset.recipe.body.family} bodies of {counts} vertices, {len(identities)} new identities, "
        f"{learned} meshes learned"
    )


_ANIMALS = ("rigged", "smal")
_COSTS = (
    "Minutes of training with its evaluations, by the run's own journal; trainings shared the machine. PMD x1e-4 over "
    "the fixed triples that were watched in training."
)
