"""The report of a comparison: tables, figures and cards on one page, as HTML and as Markdown."""

from collections.abc import Mapping
from pathlib import Path

from datagen.common.files import read_text_within
from datagen.store import Dataset, open_dataset
from training.evaluation.document import Text, plain
from training.evaluation.evaluate import NO_OPS, Row, read_rows
from training.evaluation.tables import emphasised
from training.reports.blocks import Block, Code, EmbeddedPage, Picture, Section
from training.reports.cards import dataset_card, model_card
from training.reports.report import write_report
from training.reports.run_summary import what_was_run
from workflows.studies.comparison.evaluate import FOLDER, read_inference
from workflows.studies.comparison.plan import ComparisonPlan
from workflows.studies.comparison.tables import tables_of
from workflows.studies.sweep.plan import Trial

_FIGURES = (
    ("convergence.png", "PMD over steps and seconds: thin in training, thick on new identities (paper, Figure 4)."),
    ("ablation.png", "What each variant loses against the whole network (paper, Table 3)."),
    ("examples.png", "The first triples of each list, not chosen by result: source, target, each method, truth."),
)


def write_comparison_report(plan: ComparisonPlan, out: Path, runs: Mapping[str, Path], *, command: str) -> str:
    """Write OUT/report.html and OUT/report.md; returns the tables alone, for those who see no more."""
    dataset, rows = open_dataset(str(out / "dataset.zarr")), read_rows(out / FOLDER / "rows.csv")
    tables = tables_of(plan, dataset, runs, rows, read_inference(out))
    sections = [
        Section("Results", tuple(map(emphasised, tables))),
        Section("Figures", tuple(_figures(out / FOLDER))),
        Section("What was compared", (Text(_methods(plan)), *((Code(command),) if command else ()))),
        what_was_run(out),
        dataset_card(dataset),
        *(_card(name, run, dataset, rows) for name, run in runs.items()),
    ]
    write_report(out, title=plan.title, lead=plain(plan.description), sections=sections)
    return read_text_within(out / FOLDER, "tables.md")


def _figures(folder: Path) -> list[Block]:
    pictures: list[Block] = [
        Picture(folder / "figures" / name, caption)
        for name, caption in _FIGURES
        if (folder / "figures" / name).exists()
    ]
    return [*pictures, EmbeddedPage(folder / "viewer.html", "The same transfers, to be turned with the mouse.")]


def _methods(plan: ComparisonPlan) -> str:
    shared = f"All start from recipe {plain(plan.sweep.recipe_name)} with {plain(' '.join(plan.sweep.words))}."
    lines = [f"- **{plain(name)}**: {plain(_about(trial))}" for name, trial in plan.methods.items()]
    return "\n".join([shared, "", *lines])


def _about(trial: Trial) -> str:
    return f"{trial.description} ({' '.join(trial.words)})" if trial.words else trial.description


def _card(name: str, run: Path, dataset: Dataset, rows: list[Row]) -> Section:
    card = model_card(run, dataset, [row for row in rows if row.method in (name, *NO_OPS)])
    return Section(f"{card.title}: {name}", card.body)
