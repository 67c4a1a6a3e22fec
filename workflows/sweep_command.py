"""A sweep as a command: its options, what it prints at the end, MLflow watching meanwhile."""

import argparse
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from datagen.errors import RecipeError
from datagen.files import read_text_within
from training.record import EXPERIMENT
from training.tracking import Mirror
from workflows.cluster import require_reachable
from workflows.commands import print_text
from workflows.console import add_recipe_options, add_tracking_option, add_yes_option, alone_in, server_of
from workflows.data_size import announce_size
from workflows.sweep_report import Result, best_of, parse_levels
from workflows.sweeping import Settings, remove_sweep, run_sweep
from workflows.trials import known_sweeps, plan_sweep


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
        print_text(closing_words(results, out, f"{server.uri}, experiment {EXPERIMENT!r}"))

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


def closing_words(results: Sequence[Result], out: Path, tracking: str) -> str:
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
