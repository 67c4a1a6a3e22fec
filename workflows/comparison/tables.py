"""The tables of a comparison: the paper's with its numbers beside ours, what training cost, and every metric."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from datagen.store import Dataset
from training.data.triples import last_step_of
from training.evaluation.evaluate import Row
from training.evaluation.paper_numbers import PaperData
from training.evaluation.tables import DEFINITIONS, markdown, note_1, note_2, note_3, summary, table_1, table_2, table_3
from training.evaluation.timing import Inference
from training.reports.markup import plain
from training.reports.plots.sweep import PMD_UNIT, run_curve
from training.tracking.journal import read_journal
from workflows.comparison.plan import ComparisonPlan
from workflows.pipeline.stage_functions import emd_points_of


@dataclass(frozen=True)
class NamedTable:
    """A table with its heading, and what must be known to read it."""

    title: str
    lines: list[list[str]]
    notes: str = ""


def tables_of(
    plan: ComparisonPlan,
    dataset: Dataset,
    runs: Mapping[str, Path],
    rows: list[Row],
    inference: Mapping[str, Inference],
) -> list[NamedTable]:
    """All tables, the paper's first."""
    points, here = emd_points_of(plan.recipe.evaluation, dataset), _here(dataset)
    if plan.kind == "ablation":
        first = [NamedTable("Table 3: what its parts are worth", table_3(rows), note_3(here=here, emd_points=points))]
    else:
        data: PaperData = "SMAL" if plan.recipe.data.body.family in _ANIMALS else "SMPL"
        note = note_1(data=data, here=here, emd_points=points)
        first = [
            NamedTable("Table 1: error on new identities", table_1(rows, data=data), note),
            NamedTable("Table 2: size, and time of one transfer", table_2(inference), note_2(inference)),
        ]
    return [
        *first,
        NamedTable("What training cost", _costs(plan, dataset, runs), _COSTS),
        NamedTable("Every metric", summary(rows), DEFINITIONS.format(points=points)),
    ]


def as_markdown(plan: ComparisonPlan, tables: list[NamedTable], about: str) -> str:
    """The tables as one Markdown document."""
    parts = [f"## {plain(table.title)}\n\n{markdown(table.lines)}\n\n{table.notes}".rstrip() for table in tables]
    return "\n\n".join([f"# {plain(plan.title)}", plain(about), *parts]) + "\n"


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
    counts = [dataset.vertex_count(identity) for identity in identities]
    span = f"{min(counts):,}" if min(counts) == max(counts) else f"{min(counts):,} to {max(counts):,}"
    learned = f"{len(dataset.identities('training'))} x {len(grid.poses('seen')):,}"
    return (
        f"{dataset.recipe.body.family} bodies of {span} vertices, {len(identities)} new identities, "
        f"{learned} meshes learned"
    )


_ANIMALS = ("rigged", "smal")
_COSTS = (
    "Minutes of training with its evaluations, by the run's own journal; trainings shared the machine. PMD x1e-4 over "
    "the fixed triples that were watched in training."
)
