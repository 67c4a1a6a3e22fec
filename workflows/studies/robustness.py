"""Robustness as a command: its files, what it prints."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from datagen.common.errors import RecipeError
from datagen.common.files import write_atomically
from datagen.store import open_dataset
from training.evaluation.disturbances import DISTURBANCES, Disturbance
from training.evaluation.document import Text, document_markdown, plain
from training.evaluation.measure import LoadedMethod
from training.evaluation.robustness import (
    Case,
    RobustnessRow,
    amounts_table,
    cases_of,
    curve,
    limits_table,
    measured,
    no_op,
    read_rows,
    refusal,
    steps,
    write_rows,
)
from training.reports.plots.robustness import (
    disturbance_picture,
    millimetres,
    noise_levels,
    one_of_each,
    robustness_curves,
)
from workflows.pipeline.console import print_text
from workflows.pipeline.progress import bar
from workflows.pipeline.ray_cluster import require_reachable
from workflows.studies.common import (
    about_weights,
    folder_of,
    methods_of,
    same_settings,
    study,
    sync_words,
    weights_of,
)

_FILES = ("robustness.md", "rows.csv", "curves.png", "noise.png", "disturbances.png")
_KNOWN = tuple(its.name for its in DISTURBANCES)


def robustness_command(options: argparse.Namespace) -> None:
    """Disturb the source (noise, missing parts, other sampling, rotation) and measure what comes out."""
    disturbances = _asked(options)
    weights, data = weights_of(options), require_reachable(options.data, option="--data", urls=True)
    dataset, methods = open_dataset(data), methods_of(weights)
    cases = cases_of(dataset, options.triples)
    _require_example(options, cases)
    folder = folder_of(options, weights, "robustness")
    settings = {
        "weights": about_weights(weights),
        "methods": [method.name for method in methods],
        "dataset": dataset.uuid,
        "triples": len(cases),
        "emd_points": options.emd_points,
        "amounts": {its.name: list(its.amounts) for its in DISTURBANCES},
    }
    with study(folder, "robustness", weights, settings, _FILES) as metrics:
        rows = _measured(folder, settings, methods, cases, disturbances, options)
        metrics.update(_metrics(rows, methods))
        _draw(folder, rows, methods, cases[options.example])
        text = report(rows, methods, disturbances, data=Path(data).name, cases=len(cases))
        write_atomically(folder / "robustness.md", text.encode())
    print_text(f"{text}\npictures, rows, this text: {folder} ({', '.join(_FILES)}). To MLflow: {sync_words(folder)}")


def _asked(options: argparse.Namespace) -> list[Disturbance]:
    unknown = [name for name in options.only or () if name not in _KNOWN]
    if unknown:
        raise RecipeError(f"--only {unknown[0]}: there is no such disturbance. Choose from {', '.join(_KNOWN)}")
    if options.triples < 1 or options.emd_points < 0:
        raise RecipeError(f"--triples {options.triples} --emd-points {options.emd_points}: use 1 and 0 or more")
    return [its for its in DISTURBANCES if not options.only or its.name in options.only]


def _require_example(options: argparse.Namespace, cases: Sequence[Case]) -> None:
    if not 0 <= options.example < len(cases):
        raise RecipeError(f"--example {options.example}: there are the triples 0 to {len(cases) - 1}")


def _measured(
    folder: Path,
    settings: dict[str, Any],
    methods: Sequence[LoadedMethod],
    cases: Sequence[Case],
    disturbances: Sequence[Disturbance],
    options: argparse.Namespace,
) -> list[RobustnessRow]:
    """All rows of the folder: those that were there with these settings, and what is missing of the disturbances."""
    same_settings(folder, settings)
    rows = read_rows(folder / "rows.csv")
    there = {row.key for row in rows}
    missing = [its for its in steps(methods, disturbances) if (its[1].name, its[0].name, its[2]) not in there]
    found = measured(methods, cases, disturbances, emd_points=options.emd_points or None, done=rows)
    for number, some in enumerate(bar(found, total=len(missing) + (not rows), what="robustness", unit="amount")):
        rows += some
        if number % 20 == 19:  # a run that is stopped goes on from here
            write_rows(rows, folder / "rows.csv")
    write_rows(rows, folder / "rows.csv")
    return rows


def _draw(folder: Path, rows: Sequence[RobustnessRow], methods: Sequence[LoadedMethod], case: Case) -> None:
    robustness_curves(rows, folder / "curves.png", title=f"A disturbed source: PMD over {_count(rows)} triples")
    who = "to identity {2} from identity {0}, pose {1}".format(*case.triple)
    title = f"Noise on the source, standard deviation in half the longest box edge ({who})"
    disturbance_picture(case, methods, noise_levels(), folder / "noise.png", title=title)
    title = f"Other disturbances of the source ({who})"
    disturbance_picture(case, methods, one_of_each(), folder / "disturbances.png", title=title)


def _metrics(rows: Sequence[RobustnessRow], methods: Sequence[LoadedMethod]) -> dict[str, float]:
    """PMD (1e-4) at the most of each disturbance, as MLflow shows it: ``pmd/NOISE/METHOD``."""
    found = {}
    for method in methods:
        for disturbance in DISTURBANCES:
            levels = curve(rows, method.name, disturbance.name)
            if levels:
                name = method.name.replace(" ", "_").translate(str.maketrans("", "", "()"))
                found[f"pmd/{disturbance.name}/{name}"] = levels[-1].mean * 1e4
    return found


def report(
    rows: Sequence[RobustnessRow],
    methods: Sequence[LoadedMethod],
    disturbances: Sequence[Disturbance],
    *,
    data: str,
    cases: int,
) -> str:
    """The study as Markdown: what was done, where it breaks, every number."""
    left_out = [_left_out(method, disturbances) for method in methods]
    start = ", ".join(f"{plain(its.name)} {_undisturbed(rows, its):.2f}" for its in methods)
    trained = "; ".join(f"{plain(method.name)}: step {method.step:,}" for method in methods)
    about = (
        f"Weights: {trained}. Dataset {plain(data)}, its first {cases} "
        "evaluation triples of new identities. Only the source is changed, before its normalisation; ground truth and "
        "target stay. PMD: mean over vertices and coordinates of (output - truth)^2 in the normalised box, times 1e4. "
        f"Undisturbed: {start}; returning the target unchanged: {no_op(rows) * 1e4:.2f}. Amounts "
        f"in half box edges: 0.01 is {millimetres(0.01):.1f} mm on a body of 1.7 m."
    )
    pictures = Text("\n\n".join(f"![{name}]({name}.png)" for name in ("curves", "noise", "disturbances")))
    parts = (Text(about), limits_table(rows), Text("".join(left_out)), pictures, amounts_table(rows))
    return document_markdown("Robustness to a disturbed source", parts)


def _left_out(method: LoadedMethod, disturbances: Sequence[Disturbance]) -> str:
    """A line that says what a method could not take, and why."""
    refused = [its for its in disturbances if refusal(method, its)]
    names = ", ".join(its.heading.lower() for its in refused)
    return f"- {plain(method.name)} without {names}: {refusal(method, refused[0])}.\n\n" if refused else ""


def _undisturbed(rows: Sequence[RobustnessRow], method: LoadedMethod) -> float:
    levels = [curve(rows, method.name, its.name) for its in DISTURBANCES]
    return next(its[0].mean * 1e4 for its in levels if its)


def _count(rows: Sequence[RobustnessRow]) -> int:
    return len({row.triple for row in rows})
