"""What a sweep found: each trial's journal as numbers, a table sorted by PMD on unseen poses, CSV and figure."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.common.files import write_atomically
from datagen.store import open_dataset
from training.evaluation.document import Table, Text, document_markdown, plain
from training.evaluation.results import inert
from training.evaluation.run_curves import RunCurve, run_curve
from training.objectives import PMD_UNIT
from training.reports.blocks import Section
from training.reports.card_texts import span, vertex_counts
from training.reports.cards import dataset_card
from training.reports.plots.sweep import sweep_figure
from training.reports.report import pictures_of
from training.reports.report import write_report as write_page
from training.reports.run_summary import what_was_run
from training.tracking.journal import read_journal
from training.tracking.record import read_record
from workflows.studies.sweep.plan import Sweep, Trial, varied_values

FILES = ("report.html", "report.md", "sweep.md", "sweep.csv", "figures/sweep.png", "best.yaml")
_STATES = {"FINISHED": "finished", "FAILED": "failed", "KILLED": "stopped", "RUNNING": "unfinished"}
_DEFINITION = """\
**PMD** point-wise mesh distance, times 1e4: mean over vertices and coordinates of (output - truth)^2 in the normalised
box (each mesh centred and divided by half its longest box edge), here over {triples} fixed triples of each pose type
with new identities. **end**: after the last step; **best**: the lowest on the way. **seconds**: of training, with its
evaluations, without pauses between commands; **meshes/s**: triples a second over the whole trial. Trials shared
machines, {threads} to each."""


@dataclass(frozen=True)
class TrialResult:
    """What one trial came to."""

    trial: Trial
    state: str
    reason: str
    seen: RunCurve
    unseen: RunCurve
    steps: int
    seconds: float

    @property
    def finished(self) -> bool:
        return self.state == "finished"

    @property
    def meshes_per_second(self) -> float:
        """Triples a second from the first step to the last; NaN where none was made."""
        return self.steps * self.trial.training.batch / self.seconds if self.seconds else float("nan")


def results_of(sweep: Sweep, out: Path) -> list[TrialResult]:
    """What is known of every trial, finished ones first, the lowest final PMD on unseen poses before the others."""
    found = [_result(trial, out) for trial in sweep.trials]
    return sorted(found, key=lambda result: (not result.finished, result.unseen.final))


def best_of(results: Sequence[TrialResult]) -> TrialResult | None:
    """The finished trial with the lowest final PMD on unseen poses, None where none has finished."""
    return next((result for result in results if result.finished and len(result.unseen)), None)


def twice_the_best(results: Sequence[TrialResult]) -> tuple[str, float] | None:
    """Name and PMD of the level whose first reaching is reported, None where no trial has finished."""
    best = best_of(results)
    return (f"2x best ({2 * best.unseen.final / PMD_UNIT:.1f})", 2 * best.unseen.final) if best else None


def write_report(sweep: Sweep, out: Path, *, name: str, cpus: int) -> list[TrialResult]:
    """Write what the trials' journals say now: sweep.md, sweep.csv, figures/sweep.png, best.yaml and the report."""
    from workflows.recipe.loader import save_recipe

    results = results_of(sweep, out)
    best, parts = best_of(results), parts_of(sweep, results, cpus=cpus)
    write_atomically(out / "sweep.md", document_markdown(f"Sweep {name}", parts).encode())
    write_atomically(out / "sweep.csv", table_csv(sweep, results).encode())
    curves = [result.unseen for result in results if len(result.unseen)]
    if curves:
        title = f"{name}: {len(curves)} trainings, PMD on unseen poses"
        sweep_figure(curves, out / "figures" / "sweep.png", title=title, level=twice_the_best(results))
    if best is not None:
        about = f"The best of sweep {name}: trial {best.trial.name}."
        save_recipe(best.trial.recipe.model_copy(update={"description": about}), out / "best.yaml")
    _write_page(out, name, parts)
    return results


def _write_page(out: Path, name: str, parts: Sequence[Text | Table]) -> None:
    """OUT/report.html and report.md: table, figure, trials, data."""
    dataset = open_dataset(str(out / "dataset.zarr"))
    sections = [
        Section("Results", (*parts, *pictures_of(out / "figures"))),
        what_was_run(out),
        dataset_card(dataset, picture=out / "generate" / "contact-sheet.png"),
    ]
    counts = span(vertex_counts(dataset))
    lead = f"Trainings side by side on {plain(dataset.recipe.body.family)} bodies of {counts} vertices, best first."
    write_page(out, title=f"Sweep {name}", lead=lead, sections=sections)


def parts_of(sweep: Sweep, results: Sequence[TrialResult], *, cpus: int) -> tuple[Text | Table, ...]:
    """The table with its definitions, what each trial sets, and why some failed."""
    best = best_of(results)
    threads = f"{cpus} thread{'s' if cpus > 1 else ''}"
    shared = {word.split("=", 1)[0]: word for word in sweep.words}.values()  # a key may be given twice; the last counts
    triples = min(sweep.recipe.training.evaluate_triples, sweep.recipe.data.triples.count)
    words = f" with {plain(' '.join(shared))}" if shared else ""
    described = [result.trial for result in results if result.trial.description]
    after = [
        f"Best: **{best.trial.name}** ({plain(_words(best.trial))})." if best else "No trial has finished.",
        _DEFINITION.format(triples=triples, threads=threads),
        "\n".join(f"- **{trial.name}**: {plain(f'{trial.description} ({_words(trial)})')}" for trial in described),
        *(f"- **{each.trial.name}** failed: {plain(each.reason)}" for each in results if each.state == "failed"),
    ]
    return (
        Text(f"{len(results)} trainings from recipe {plain(sweep.recipe_name)}{words}. Lower PMD is better."),
        Table(table(results)),
        *(Text(part) for part in after if part),
    )


def table(results: Sequence[TrialResult]) -> list[list[str]]:
    """Heading and one line a trial, as text."""
    level = twice_the_best(results)
    reach = [f"step to {level[0]}", "s"] if level else []
    ends = ["unseen, end", "best", "at step", "seen, end", "best"]
    lines = [["trial", "what varies", *ends, *reach, "steps", "seconds", "meshes/s", "state"]]
    for result in results:
        lines.append(
            [
                result.trial.name,
                result.trial.description or _words(result.trial),
                *_ends(result.unseen, with_step=True),
                *_ends(result.seen, with_step=False),
                *(_reached(result.unseen, level[1]) if level else []),
                f"{result.steps:,}",
                _seconds(result.seconds),
                f"{result.meshes_per_second:.1f}" if result.seconds else "-",
                result.state,
            ]
        )
    return lines


def table_csv(sweep: Sweep, results: Sequence[TrialResult]) -> str:
    """The same for programs: PMD as measured (not times 1e4), and every varied key as a column."""
    level = twice_the_best(results)
    rows = [_csv_row(sweep, result, level and level[1]) for result in results]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: inert(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _csv_row(sweep: Sweep, result: TrialResult, level: float | None) -> dict[str, object]:
    values = varied_values(sweep, result.trial)
    row: dict[str, object] = {"trial": result.trial.name, "state": result.state, "reason": result.reason}
    row |= {key: values.get(key, "") for key in sweep.varied}
    for pose_type, curve in (("unseen", result.unseen), ("seen", result.seen)):
        row[f"pmd_{pose_type}"] = curve.final if len(curve) else ""
        row[f"best_pmd_{pose_type}"] = curve.pmd.min() if len(curve) else ""
        row[f"step_of_best_{pose_type}"] = int(curve.steps[curve.pmd.argmin()]) if len(curve) else ""
    if level is not None:
        step, seconds = result.unseen.first_reached(level) or ("", "")
        row |= {"twice_the_best": level, "twice_the_best_step": step, "twice_the_best_seconds": seconds}
    return row | {
        "steps": result.steps,
        "seconds": result.seconds,
        "meshes_per_second": result.meshes_per_second if result.seconds else "",
    }


def _result(trial: Trial, out: Path) -> TrialResult:
    folder = trial.folder(out)
    record, rows = read_record(folder), read_journal(folder / "metrics.jsonl")
    state = _STATES[record.status] if record else "not begun"
    reason = record.tags.get("failure", "") if record and state == "failed" else ""
    batch, done = trial.training.batch, state == "finished"
    seen, unseen = (
        run_curve(rows, f"evaluation/pmd_{pose_type}", batch=batch, name=trial.name, finished=done)
        for pose_type in ("seen", "unseen")
    )
    clock = run_curve(rows, "meshes_per_second", batch=batch)
    return TrialResult(
        trial, state, reason, seen, unseen,
        steps=int(clock.steps[-1]) if len(clock) else 0,
        seconds=float(clock.seconds[-1]) if len(clock) else 0.0,
    )  # fmt: skip


def _ends(curve: RunCurve, *, with_step: bool) -> list[str]:
    if not len(curve):
        return ["-"] * (3 if with_step else 2)
    step = [f"{curve.steps[curve.pmd.argmin()]:,.0f}"] if with_step else []
    return [f"{curve.final / PMD_UNIT:.2f}", f"{curve.pmd.min() / PMD_UNIT:.2f}", *step]


def _reached(curve: RunCurve, level: float) -> list[str]:
    first = curve.first_reached(level)
    return [f"{first[0]:,.0f}", _seconds(first[1])] if first else ["-", "-"]


def _seconds(seconds: float) -> str:
    return f"{seconds:.{1 if seconds < 10 else 0}f}"


def _words(trial: Trial) -> str:
    return " ".join(word.removeprefix("training.") for word in trial.words) or "the recipe as it is"
