"""Comparing methods as a command: its options, what it prints at the end, MLflow watching meanwhile."""

import argparse
import os
import shlex
from pathlib import Path

from datagen.errors import RecipeError
from datagen.files import read_text_within
from training.record import EXPERIMENT
from training.tracking import Mirror
from workflows.cluster import require_reachable
from workflows.commands import print_text
from workflows.comparing import OWN, Settings, run_comparison
from workflows.comparison_plan import Kind, known_comparisons, plan_comparison
from workflows.console import add_set_option, add_tracking_option, add_yes_option, alone_in, server_of
from workflows.data_size import announce_size
from workflows.sweeping import remove_sweep

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
            settings = Settings(options.cpus_per_trial, options.gpus_per_trial)
            run_comparison(comparison, out, settings, command=_command_line(options, kind))
        finally:
            outage = mirror.close()
    print_text(closing_words(out, f"{server.uri}, experiment {EXPERIMENT!r}"))
    if outage:
        raise outage


def _command_line(options: argparse.Namespace, kind: Kind) -> str:
    """The command that does the same again."""
    words = ["python", f"workflows/{_SCRIPTS[kind]}.py", "--recipe", options.recipe]
    words += ["--set", *options.set] if options.set else []
    words += ["--cpus-per-trial", str(options.cpus_per_trial)] if options.cpus_per_trial != 1 else []
    words += ["--gpus-per-trial", f"{options.gpus_per_trial:g}"] if options.gpus_per_trial else []
    return " ".join(map(shlex.quote, words))


def closing_words(out: Path, tracking: str) -> str:
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
