"""The study of robustness: its files, what it prints."""

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from datagen.common.errors import RecipeError
from datagen.store import open_dataset
from training.evaluation.disturbances import DISTURBANCES, Disturbance
from training.evaluation.document import Text, document_markdown, plain
from training.evaluation.measure import LoadedMethod
from training.evaluation.robustness import (
    NO_OP,
    Case,
    RobustnessRow,
    amounts_table,
    cases_of,
    curve,
    limits_table,
    measured,
    no_op,
    refusal,
    steps,
)
from training.objectives import PMD_UNIT
from training.reports.plots.robustness import (
    disturbance_picture,
    millimetres,
    noise_levels,
    one_of_each,
    robustness_curves,
)
from workflows.pipeline.progress import bar
from workflows.pipeline.ray_cluster import require_reachable
from workflows.studies.common import Study, about_weights, folder_of, methods_of, metric_name, weights_of

_KNOWN = tuple(disturbance.name for disturbance in DISTURBANCES)


class RobustnessStudy(Study[RobustnessRow]):
    """Weights on a dataset's first evaluation triples, whose sources are disturbed.

    Raises
    ------
    RecipeError
        An option is invalid, or the folder holds other work.
    CheckpointError, DatasetError
        Weights or evaluation triples are missing.
    """

    name, row = "robustness", RobustnessRow
    pictures = ("curves.png", "noise.png", "disturbances.png")

    def __init__(self, options: argparse.Namespace) -> None:
        self.disturbances = _asked(options)
        self.weights, data = weights_of(options), require_reachable(options.data, option="--data", urls=True)
        dataset, self.methods, self.data = open_dataset(data), methods_of(self.weights), Path(data).name
        self.cases, self.emd_points = cases_of(dataset, options.triples), options.emd_points or None
        self.example = _example(options, self.cases)
        self.folder = folder_of(options, self.weights, self.name)
        self.settings = {
            "weights": about_weights(self.weights),
            "methods": [method.name for method in self.methods],
            "dataset": dataset.uuid,
            "triples": len(self.cases),
            "emd_points": options.emd_points,
            "amounts": {disturbance.name: list(disturbance.amounts) for disturbance in DISTURBANCES},
        }

    def measure(self, done: list[RobustnessRow]) -> Iterable[list[RobustnessRow]]:
        there = {row.key for row in done}
        asked = [(step[1].name, step[0].name, step[2]) for step in steps(self.methods, self.disturbances)]
        missing = sum(key not in there for key in [(NO_OP, "", 0.0), *asked])
        found = measured(self.methods, self.cases, self.disturbances, emd_points=self.emd_points, done=done)
        return bar(found, total=missing, what="robustness", unit="amount")

    def draw(self, rows: list[RobustnessRow]) -> None:
        title = f"A disturbed source: PMD over {len({row.triple for row in rows})} triples"
        robustness_curves(rows, self.folder / "curves.png", title=title)
        who = "to identity {2} from identity {0}, pose {1}".format(*self.example.triple)
        for name, chosen, what in (
            ("noise.png", noise_levels(), "Noise on the source, standard deviation in half the longest box edge"),
            ("disturbances.png", one_of_each(), "Other disturbances of the source"),
        ):
            disturbance_picture(self.example, self.methods, chosen, self.folder / name, title=f"{what} ({who})")

    def metrics(self, rows: list[RobustnessRow]) -> dict[str, float]:
        """PMD (1e-4) at the most of each disturbance: ``pmd/NOISE/METHOD``."""
        curves = {
            f"pmd/{disturbance.name}/{metric_name(method.name)}": curve(rows, method.name, disturbance.name)
            for method in self.methods
            for disturbance in DISTURBANCES
        }
        return {name: levels[-1].mean / PMD_UNIT for name, levels in curves.items() if levels}

    def report(self, rows: list[RobustnessRow]) -> str:
        """What was done, where it breaks, every number."""
        start = ", ".join(f"{plain(method.name)} {_undisturbed(rows, method):.2f}" for method in self.methods)
        trained = "; ".join(f"{plain(method.name)}: step {method.step:,}" for method in self.methods)
        about = (
            f"Weights: {trained}. Dataset {plain(self.data)}, its first {len(self.cases)} "
            "evaluation triples of new identities. Only the source is changed, before its normalisation; ground truth "
            "and target stay. PMD: mean over vertices and coordinates of (output - truth)^2 in the normalised box, "
            f"times 1e4. Undisturbed: {start}; returning the target unchanged: {no_op(rows) / PMD_UNIT:.2f}. Amounts "
            f"in half box edges: 0.01 is {millimetres(0.01):.1f} mm on a body of 1.7 m."
        )
        left_out = Text("".join(_left_out(method, self.disturbances) for method in self.methods))
        pictures = Text("\n\n".join(f"![{Path(name).stem}]({name})" for name in self.pictures))
        parts = (Text(about), limits_table(rows), left_out, pictures, amounts_table(rows))
        return document_markdown("Robustness to a disturbed source", parts)


def _asked(options: argparse.Namespace) -> list[Disturbance]:
    unknown = [name for name in options.only or () if name not in _KNOWN]
    if unknown:
        raise RecipeError(f"--only {unknown[0]}: there is no such disturbance. Choose from {', '.join(_KNOWN)}")
    for option, given, least in (("--triples", options.triples, 1), ("--emd-points", options.emd_points, 0)):
        if given < least:
            raise RecipeError(f"{option} {given}: use {least} or more")
    return [disturbance for disturbance in DISTURBANCES if not options.only or disturbance.name in options.only]


def _example(options: argparse.Namespace, cases: Sequence[Case]) -> Case:
    if not 0 <= options.example < len(cases):
        raise RecipeError(f"--example {options.example}: there are the triples 0 to {len(cases) - 1}")
    return cases[options.example]


def _left_out(method: LoadedMethod, disturbances: Sequence[Disturbance]) -> str:
    """A line that says what a method could not take, and why."""
    refused = [disturbance for disturbance in disturbances if refusal(method, disturbance)]
    names = ", ".join(disturbance.heading.lower() for disturbance in refused)
    return f"- {plain(method.name)} without {names}: {refusal(method, refused[0])}.\n\n" if refused else ""


def _undisturbed(rows: Sequence[RobustnessRow], method: LoadedMethod) -> float:
    levels = [curve(rows, method.name, disturbance.name) for disturbance in DISTURBANCES]
    return next(curve_levels[0].mean / PMD_UNIT for curve_levels in levels if curve_levels)
