"""The subcommands of ``dsffnet`` that train or probe many: sweep, compare, ablation, robustness, generalisation."""

import argparse
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from datagen.common.errors import RecipeError
from datagen.common.files import read_text_within
from training.tracking.mlflow_mirror import Mirror
from training.tracking.record import EXPERIMENT
from workflows.cli.declare import Command, add_command
from workflows.comparison.plan import Kind, known_comparisons, plan_comparison
from workflows.comparison.run import OWN, run_comparison
from workflows.comparison.run import Settings as ComparisonSettings
from workflows.pipeline.console import (
    add_recipe_options,
    add_set_option,
    add_tracking_option,
    add_yes_option,
    alone_in,
    print_text,
    server_of,
)
from workflows.pipeline.data_size import announce_size
from workflows.pipeline.ray_cluster import require_reachable
from workflows.studies.generalisation import EXAMPLES as GENERALISATION_EXAMPLES
from workflows.studies.generalisation import add_generalisation_options, generalisation_command
from workflows.studies.robustness import EXAMPLES as ROBUSTNESS_EXAMPLES
from workflows.studies.robustness import add_robustness_options, robustness_command
from workflows.sweep.plan import known_sweeps, plan_sweep
from workflows.sweep.report import Result, best_of, parse_levels
from workflows.sweep.run import Settings, remove_sweep, run_sweep

_SCRIPTS: dict[Kind, str] = {"comparison": "compare", "ablation": "ablation"}


def add_comparison_options(made: argparse.ArgumentParser, kind: Kind) -> None:
    """Options of a comparison of methods, or of the ablations."""
    add = made.add_argument
    names = ", ".join(known_comparisons(kind))
    add("--recipe", default="small", metavar="NAME|FILE", help=f"a YAML file, or one of {names} (default small)")
    add_set_option(made)
    add("--out", metavar="DIR", help=f"folder for everything (default runs/{_SCRIPTS[kind]}-RECIPE)")
    add("--cpus-per-trial", type=int, default=1, metavar="N", help="CPUs, and threads, of each training (default 1)")
    add(
        "--gpus-per-trial", type=float, default=0.0, metavar="N",
        help="GPUs of each training; a fraction lets several share one (default 0: trainings keep to their CPUs)",
    )  # fmt: skip
    add_tracking_option(made)
    add("--fresh", action="store_true", help="remove what DIR holds of this and start over")
    add_yes_option(made)


def compare_command(options: argparse.Namespace) -> None:
    """Train DSFFNet, NPT and 3D-CoreNet under one budget on one dataset: Tables 1 and 2, Figure 4, a report."""
    _run(options, "comparison")


def ablation_command(options: argparse.Namespace) -> None:
    """Train DSFFNet and its ablations under one budget on one dataset: Table 3, its figure, a report."""
    _run(options, "ablation")


def _run(options: argparse.Namespace, kind: Kind) -> None:
    comparison = plan_comparison(options.recipe, options.set, kind=kind)
    if options.cpus_per_trial < 1 or options.gpus_per_trial < 0:
        raise RecipeError(
            f"--cpus-per-trial {options.cpus_per_trial} and --gpus-per-trial {options.gpus_per_trial:g}: a training "
            "needs one CPU or more, and no less than no GPU"
        )
    out = Path(require_reachable(options.out or f"runs/{_SCRIPTS[kind]}-{comparison.name}", option="--out"))
    announce_size(comparison.recipe.data, str(out / "dataset.zarr"), anew=options.fresh, yes=options.yes)
    server = server_of(out, options.tracking_uri)
    mirror = Mirror(out, server)
    with alone_in(out):
        if options.fresh:
            remove_sweep(out, kind=kind, own=OWN)
        mirror.start()
        try:
            settings = ComparisonSettings(options.cpus_per_trial, options.gpus_per_trial)
            run_comparison(comparison, out, settings, command=_command_line(options, kind))
        finally:
            outage = mirror.close()
    print_text(comparison_closing_words(out, f"{server.uri}, experiment {EXPERIMENT!r}"))
    if outage:
        raise outage


def _command_line(options: argparse.Namespace, kind: Kind) -> str:
    """The command that does the same again."""
    words = ["python", f"workflows/{_SCRIPTS[kind]}.py", "--recipe", options.recipe]
    words += ["--set", *options.set] if options.set else []
    words += ["--cpus-per-trial", str(options.cpus_per_trial)] if options.cpus_per_trial != 1 else []
    words += ["--gpus-per-trial", f"{options.gpus_per_trial:g}"] if options.gpus_per_trial else []
    return " ".join(map(shlex.quote, words))


def comparison_closing_words(out: Path, tracking: str) -> str:
    """The tables, and where everything lies."""
    shown = Path(os.path.relpath(out)) if out.is_relative_to(Path.cwd()) else out
    return "\n".join(
        [
            read_text_within(out, "evaluation/tables.md"),
            "Where everything lies",
            f"  report        {shown}/report.html, report.md",
            f"  pictures      {shown}/evaluation/figures",
            f"  viewer        {shown}/evaluation/viewer.html  (turn and zoom; open it in a browser)",
            f"  rows          {shown}/evaluation/rows.csv",
            f"  runs          {shown}/trials/METHOD",
            f"  dataset       {shown}/dataset.zarr",
            f"  MLflow        {tracking}",
        ]
    )


def add_sweep_options(made: argparse.ArgumentParser) -> None:
    """Options of a sweep."""
    add_recipe_options(made)
    made.set_defaults(recipe=None)
    add = made.add_argument
    add("--out", metavar="DIR", help="folder for dataset, trials and MLflow store (default runs/NAME)")
    add("--name", help="what to call the sweep (default: that of --trials, or sweep)")
    add(
        "--vary", action="extend", nargs="+", default=[], metavar="training.key=A,B,...",
        help="values to try; every combination of several keys is a trial",
    )  # fmt: skip
    sweeps = ", ".join(known_sweeps())
    add("--trials", metavar="NAME|FILE", help=f"a YAML list of trials {{name, description, set}}, or one of {sweeps}")
    add("--cpus-per-trial", type=int, default=1, metavar="N", help="CPUs, and threads, of each trial (default 1)")
    add(
        "--gpus-per-trial", type=float, default=0.0, metavar="N",
        help="GPUs of each trial; a fraction lets several share one (default 0: trials keep to their CPUs)",
    )  # fmt: skip
    add(
        "--reach", nargs="+", default=["2x"], metavar="LEVEL",
        help="PMD whose first reaching is told: 2x for twice the best final one (default), 40 for 40e-4",
    )  # fmt: skip
    add("--strict", action="store_true", help="exit status 1 if any trial failed, not only if all did")
    add_tracking_option(made)
    add("--fresh", action="store_true", help="remove what DIR holds of this sweep and start over")
    add_yes_option(made)


def sweep_command(options: argparse.Namespace) -> None:
    """Train many recipes on one dataset, and say which learned best."""
    sweep = plan_sweep(recipe=options.recipe, shared=options.set, vary=options.vary, trials=options.trials)
    if options.cpus_per_trial < 1 or options.gpus_per_trial < 0:
        raise RecipeError(
            f"--cpus-per-trial {options.cpus_per_trial} and --gpus-per-trial {options.gpus_per_trial:g}: a trial needs "
            "one CPU or more, and no less than no GPU"
        )
    name = options.name or (Path(options.trials).stem if options.trials else "sweep")
    settings = Settings(
        name, parse_levels(options.reach), options.cpus_per_trial, options.gpus_per_trial, options.strict
    )
    out = Path(require_reachable(options.out or f"runs/{name}", option="--out"))
    announce_size(sweep.recipe.data, str(out / "dataset.zarr"), anew=options.fresh, yes=options.yes)
    server = server_of(out, options.tracking_uri)
    mirror = Mirror(out, server)

    def show(results: list[Result]) -> None:
        print_text(sweep_closing_words(results, out, f"{server.uri}, experiment {EXPERIMENT!r}"))

    with alone_in(out):
        if options.fresh:
            remove_sweep(out)
        mirror.start()
        try:
            run_sweep(sweep, out, settings, show=show)
        finally:
            outage = mirror.close()
    if outage:
        raise outage


def sweep_closing_words(results: Sequence[Result], out: Path, tracking: str) -> str:
    """The table, where everything lies, and how to go on with the best trial."""
    shown = Path(os.path.relpath(out)) if out.is_relative_to(Path.cwd()) else out
    words = [
        read_text_within(out, "sweep.md"),
        "Where everything lies",
        f"  table         {shown}/sweep.md, sweep.csv",
        *([f"  figure        {shown}/figures/sweep.png"] if (out / "figures" / "sweep.png").exists() else []),
        f"  runs          {shown}/trials/NAME",
        f"  dataset       {shown}/dataset.zarr",
        f"  MLflow        {tracking}",
    ]
    best = best_of(results)
    if best is not None:
        run, data = shlex.quote(str(best.trial.folder(shown))), shlex.quote(str(shown / "dataset.zarr"))
        recipe = shlex.quote(str(shown / "best.yaml"))
        words += [
            "",
            f"Go on with the best, {best.trial.name}",
            f"  python workflows/full.py --recipe {recipe} --out runs/best",
            f"  dsffnet evaluate {run} --data {data} --recipe {recipe}",
        ]
    return "\n".join(words)


_EXAMPLES: dict[Command, str] = {
    sweep_command: "  dsffnet sweep --trials networks --out runs/networks",
    compare_command: """\
  dsffnet compare --out runs/compare
  dsffnet compare --recipe animals-small --set training.steps=500""",
    ablation_command: "  dsffnet ablation --out runs/ablation",
}
_COMPARED: dict[Command, Kind] = {compare_command: "comparison", ablation_command: "ablation"}


def add_study_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare them and their options."""
    add_sweep_options(add_command(commands, sweep_command, _EXAMPLES[sweep_command], takes_recipe=True))
    for compared, kind in _COMPARED.items():
        add_comparison_options(add_command(commands, compared, _EXAMPLES[compared], takes_recipe=True), kind)
    add_robustness_options(add_command(commands, robustness_command, ROBUSTNESS_EXAMPLES))
    add_generalisation_options(add_command(commands, generalisation_command, GENERALISATION_EXAMPLES))
