"""Reports: one self-contained HTML file and one Markdown file a workflow, from blocks that every workflow shares.

>>> section = Section("Results", (Table([["method", "PMD"], ["ours", "**1.2**"]], "Main results"),))
>>> write_report(folder, title="A comparison", lead="On **8** new identities.", sections=[section])  # doctest: +SKIP
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from datagen.common.errors import ReportError
from datagen.common.files import write_atomically
from datagen.common.printable import printable_lines
from datagen.store import Dataset, open_dataset
from training.checkpoints.checkpoint import recipe_of, require_checkpoint
from training.evaluation.document import Cell, Table, Text, plain, with_best
from training.evaluation.evaluate import Row, read_rows
from training.evaluation.measure import CONTROLS
from training.evaluation.tables import about_weights, mean_of, methods_of, results
from training.inference.projection import PROJECTED
from training.objectives import PMD_UNIT
from training.recipes.training import EvaluationRecipe
from training.reports.blocks import Block, Code, EmbeddedPage, Facts, Picture, Section, shown
from training.reports.card_texts import NETWORKS, span, vertex_counts
from training.reports.cards import dataset_card, model_card
from training.reports.html import report_html
from training.reports.markdown import report_markdown
from training.reports.run_summary import what_was_run
from training.tracking.record import read_record

__all__ = [
    "NAMES",
    "Block",
    "Cell",
    "Code",
    "EmbeddedPage",
    "Facts",
    "Picture",
    "ReportError",
    "Section",
    "Table",
    "Text",
    "dataset_card",
    "model_card",
    "pictures_of",
    "plain",
    "report_is_current",
    "what_was_run",
    "with_best",
    "workflow_report",
    "write_report",
]

NAMES = ("report.html", "report.md")
"""What :func:`workflow_report` leaves in a folder."""

CAPTIONS = {
    "examples": "Source, target, output, ground truth and error: the first triples of each fixed list, not chosen "
    "by result.",
    "training-curve": "Losses, PMD on fixed evaluation triples, and the learning rate, over the steps of training.",
    "sweep": "PMD on unseen poses over steps and over seconds of training.",
    "adaptive-coefficients": "The adaptive coefficients of each FFAdaIN: 0, the target's own features modulate alone; "
    "1, those mixed with the source's pose code.",
}
"""File name of a figure, without its ending -> caption (markup)."""


def write_report(
    folder: Path, *, title: str, lead: str, sections: Sequence[Section], name: str = "report"
) -> tuple[Path, Path]:
    """Write FOLDER/NAME.html, which holds its pictures, and FOLDER/NAME.md, which links them; each whole or not at all.

    Parameters
    ----------
    folder
        Where the report goes; pages and, in Markdown, pictures are linked relative to it.
    title, lead
        Plain text; markup (see :mod:`training.evaluation.document`) of what a hurried reader is to know.
    sections
        In their order; the HTML lists their titles.

    Raises
    ------
    ReportError
        A picture is missing or of a format that browsers do not show.
    StorageError
        It could not be written.
    """
    texts = {
        folder / f"{name}.html": printable_lines(report_html(folder, title=title, lead=lead, sections=sections)),
        folder / f"{name}.md": printable_lines(report_markdown(folder, title=title, lead=lead, sections=sections)),
    }
    for path, text in texts.items():
        write_atomically(path, text.encode())
    html, markdown = texts
    return html, markdown


def workflow_report(out: Path) -> tuple[Path, Path]:
    """The report of what ``workflows/full.py`` leaves in ``out``: what was run, tables, figures, curves, cards.

    Raises
    ------
    ReportError
        There is no workflow's record, or no evaluation.
    DatasetError, CheckpointError
        The dataset is missing or incomplete, or the run has no usable checkpoint.
    """
    evaluation, record = out / "run" / "evaluation", read_record(out)
    if record is None or not (evaluation / "rows.csv").is_file():
        missing = "run/evaluation/rows.csv" if record else "record.json"
        raise ReportError(f"{out} holds no finished workflow (no {missing}). Finish it with workflows/full.py")
    dataset, rows = open_dataset(str(out / "dataset.zarr")), read_rows(evaluation / "rows.csv")
    runs = _runs(out, rows)
    sections = [
        what_was_run(out),
        Section("Results", _results(runs, evaluation, dataset, rows)),
        Section("Examples", (*pictures_of(evaluation / "figures", but=("training-curve",)), *_viewer(evaluation))),
        *(Section(f"Training{_of(name, runs)}", _curves(run)) for name, run in runs.items()),
        dataset_card(dataset, picture=out / "generate" / "contact-sheet.png"),
        *(_card(name, runs, dataset, rows) for name in runs),
        _files(out, but=() if len(runs) > 1 else ("beside",)),
    ]
    sections = [section for section in sections if section.body]
    return write_report(out, title=_title(record.name, dataset), lead=_lead(runs, dataset, rows), sections=sections)


def report_is_current(out: Path) -> bool:
    """Whether both files are there and younger than the evaluation that they tell of."""
    record = read_record(out / "run" / "evaluation")
    paths = [out / name for name in NAMES]
    if record is None or record.ended is None or not all(path.is_file() for path in paths):
        return False
    return all(path.stat().st_mtime * 1000 >= record.ended for path in paths)


def pictures_of(folder: Path, *, but: Sequence[str] = ()) -> tuple[Picture, ...]:
    """The PNG files of a folder by name, except some stems, with the captions that are known of them."""
    paths = [path for path in sorted(folder.glob("*.png")) if path.stem not in but]
    return tuple(Picture(path, CAPTIONS.get(path.stem, plain(path.stem.replace("-", " ")))) for path in paths)


def _runs(out: Path, rows: Sequence[Row]) -> dict[str, Path]:
    """The trainings by the names that the rows give them: what a workflow trains, and what it trains beside it."""
    names = [name for name in methods_of(rows) if name not in CONTROLS and not name.endswith(PROJECTED)]
    main = recipe_of(require_checkpoint(out / "run", "result")).network.title
    if len(names) != 2 or main not in names:
        return {methods_of(rows)[0]: out / "run"}
    names.remove(main)
    return {main: out / "run", names[0]: out / "beside"}


def _of(name: str, runs: Mapping[str, Path]) -> str:
    return f": {name}" if len(runs) > 1 else ""


def _card(name: str, runs: Mapping[str, Path], dataset: Dataset, rows: Sequence[Row]) -> Section:
    others = [each for each in runs if each != name]
    card = model_card(runs[name], dataset, [row for row in rows if row.method not in others])
    return Section(f"{card.title}{_of(name, runs)}", card.body)


def _results(runs: Mapping[str, Path], evaluation: Path, dataset: Dataset, rows: Sequence[Row]) -> tuple[Block, ...]:
    """The evaluation's table with its definitions; the best values are marked."""
    steps = {name: require_checkpoint(run, "result").step for name, run in runs.items()}
    parts = results(rows, about=about_weights(steps, dataset), emd_points=_emd_points(evaluation, dataset))
    return tuple(_marked(part) if isinstance(part, Table) else part for part in parts)


def _emd_points(evaluation: Path, dataset: Dataset) -> int:
    """Vertices that the earth mover's distance was measured over: as many as asked for, or all."""
    record = read_record(evaluation)
    asked = record.parameters.get("emd_points", "") if record else ""
    known = int(asked) if asked.isdecimal() and len(asked) < 18 else EvaluationRecipe().emd_points
    return min(known, max(vertex_counts(dataset, "evaluation")))


def _marked(table: Table) -> Table:
    columns = [place for place, numeric in enumerate(table.numeric) if numeric]
    lines = with_best(table.lines, columns=columns, group=0)
    return replace(table, lines=lines, notes="The best of each column and group of poses in bold.")


def _viewer(evaluation: Path) -> tuple[EmbeddedPage, ...]:
    path = evaluation / "viewer.html"
    words = "The same examples, to be turned with the mouse: drag to turn, wheel or pinch to zoom."
    return (EmbeddedPage(path, words),) if path.is_file() else ()


def _curves(run: Path) -> tuple[Picture, ...]:
    """The training curve, with the no-op baselines where the evaluation drew it, and the run's other figures."""
    path = run / "evaluation/figures/training-curve.png"
    if not path.is_file():
        return pictures_of(run / "figures")
    return (Picture(path, CAPTIONS[path.stem]), *pictures_of(run / "figures", but=(path.stem,)))


def _title(name: str, dataset: Dataset) -> str:
    counts = span(vertex_counts(dataset))
    return f"{name}: pose transfer on {dataset.recipe.body.family} bodies of {counts} vertices"


def _lead(runs: Mapping[str, Path], dataset: Dataset, rows: list[Row]) -> str:
    method, run = next(iter(runs.items()))
    checkpoint = require_checkpoint(run, "result")
    network = recipe_of(checkpoint).network.name
    grid, kind = dataset.grid, "unseen" if any(row.pose_type == "unseen" for row in rows) else "seen"
    trained = (
        f"{NETWORKS[network]}, {checkpoint.step:,} steps on {len(grid.identities('training'))} identities in "
        f"{len(grid.poses('seen')):,} poses. "
    )
    scores = {each: mean_of(rows, method=each, pose_type=kind, field="pmd") / PMD_UNIT for each in methods_of(rows)}
    others = ", ".join(f"{plain(each)} {score:.2f}" for each, score in scores.items() if each not in runs)
    beside = "".join(f" Beside it, {plain(each)}: **{scores[each]:.2f}**." for each in runs if each != method)
    error = mean_of(rows, method=method, pose_type=kind, field="millimetres")
    return (
        f"{trained}On new identities in {kind} poses: **PMD {scores[method]:.2f} x 1e-4, mean error {error:.1f} mm**."
        f"{beside} "
        f"For comparison, doing nothing: {others} (PMD x 1e-4)."
    )


def _files(out: Path, *, but: Sequence[str]) -> Section:
    names = {
        "dataset.zarr": "the dataset",
        "run": "the training run: name this folder where a model is asked for",
        "beside": "the training beside it",
        "run/metrics.jsonl": "the journal: losses, PMD, learning rate by step",
        "run/evaluation/rows.csv": "every metric of every triple",
        "run/evaluation/tables.md": "the tables above, with their definitions",
        "run/evaluation/viewer.html": "the viewer",
        "run/evaluation/meshes": "the examples as GLB files",
        "recipe.yaml": "the whole recipe",
    }
    lines = [[path, what] for path, what in names.items() if path not in but and (out / path).exists()]
    words = f"Beside this report, in {plain(shown(out))}:"
    return Section("Files", (Text(words), Table([["path", "what it is"], *lines])))
