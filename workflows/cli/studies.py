"""The subcommands of ``dsffnet`` that train or probe many: sweep, compare, ablation, robustness, generalisation."""

import argparse
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.common.errors import RecipeError
from datagen.common.files import read_text_within
from training.tracking.record import EXPERIMENT, Server
from workflows.cli.declare import (
    Command,
    Parser,
    add_checkpoint_option,
    add_fresh_option,
    add_recipe_options,
    add_set_option,
    add_tracking_option,
    add_yes_option,
)
from workflows.pipeline.console import at_work, print_text

if TYPE_CHECKING:
    from datagen.recipe import DatasetRecipe
    from workflows.pipeline.run_folder import TrialsFolder
    from workflows.studies.comparison.plan import ComparisonKind
    from workflows.studies.sweep.report import TrialResult

_NAMES: "dict[ComparisonKind, str]" = {"comparison": "compare", "ablation": "ablation"}


def _trials_options(made: Parser, one: str) -> None:
    """What all commands that train many take; ``one`` of them is called so."""
    add = made.add_argument
    add("--cpus-per-trial", type=int, default=1, metavar="N", help=f"CPUs, and threads, of each {one} (default 1)")
    add(
        "--gpus-per-trial", type=float, default=0.0, metavar="N",
        help=f"GPUs of each {one}; a fraction lets several share one (default 0: {one}s keep to their CPUs)",
    )  # fmt: skip
    add_tracking_option(made)
    add_fresh_option(made, "what DIR holds of this")
    add_yes_option(made)


@contextmanager
def _at_work(options: argparse.Namespace, folder: "TrialsFolder", data: "DatasetRecipe") -> Iterator[Server]:
    """Hold a folder of trials; see :func:`workflows.pipeline.console.at_work`."""
    if options.cpus_per_trial < 1 or options.gpus_per_trial < 0:
        raise RecipeError(
            f"--cpus-per-trial {options.cpus_per_trial} and --gpus-per-trial {options.gpus_per_trial:g}: a training "
            "needs one CPU or more, and no less than no GPU"
        )
    with at_work(options, folder, data) as server:
        yield server


def _where(out: Path, server: Server, places: dict[str, str]) -> list[str]:
    """Lines that say where everything lies, below ``out`` as a person would write it."""
    shown = _shown(out)
    lines = [f"  {name:12}  {shown}/{place}" for name, place in places.items()]
    return ["Where everything lies", *lines, f"  MLflow        {server.uri}, experiment {EXPERIMENT!r}"]


def _shown(out: Path) -> Path:
    return Path(os.path.relpath(out)) if out.is_relative_to(Path.cwd()) else out


def _comparison_options(made: Parser, kind: "ComparisonKind") -> None:
    from workflows.studies.comparison.plan import known_comparisons

    add, names = made.add_argument, ", ".join(known_comparisons(kind))
    add("--recipe", default="small", metavar="NAME|FILE", help=f"a YAML file, or one of {names} (default small)")
    add_set_option(made)
    add("--out", metavar="DIR", help=f"folder for everything (default runs/{_NAMES[kind]}-RECIPE)")
    _trials_options(made, "training")


def compare_command(options: argparse.Namespace) -> None:
    """Train DSFFNet, NPT and 3D-CoreNet under one budget on one dataset: Tables 1 and 2, Figure 4, a report.

    examples:
      dsffnet compare --out runs/compare
      dsffnet compare --recipe animals-small --set training.steps=500
    """
    _compare(options, "comparison")


def ablation_command(options: argparse.Namespace) -> None:
    """Train DSFFNet and its ablations under one budget on one dataset: Table 3, its figure, a report.

    examples:
      dsffnet ablation --out runs/ablation
    """
    _compare(options, "ablation")


def _compare(options: argparse.Namespace, kind: "ComparisonKind") -> None:
    from workflows.pipeline.ray_cluster import require_reachable
    from workflows.studies.comparison.plan import plan_comparison
    from workflows.studies.comparison.run import folder_of, run_comparison

    plan = plan_comparison(options.recipe, options.set, kind=kind)
    out = Path(require_reachable(options.out or f"runs/{_NAMES[kind]}-{plan.name}", option="--out"))
    with _at_work(options, folder_of(plan, out), plan.recipe.data) as server:
        cpus, gpus = options.cpus_per_trial, options.gpus_per_trial
        run_comparison(plan, out, cpus=cpus, gpus=gpus, command=_command_line(options, kind))
        print_text(_comparison_words(out, server))


def _command_line(options: argparse.Namespace, kind: "ComparisonKind") -> str:
    """The command that does the same again."""
    words = ["dsffnet", _NAMES[kind], "--recipe", options.recipe]
    words += ["--set", *options.set] if options.set else []
    words += ["--cpus-per-trial", str(options.cpus_per_trial)] if options.cpus_per_trial != 1 else []
    words += ["--gpus-per-trial", f"{options.gpus_per_trial:g}"] if options.gpus_per_trial else []
    return shlex.join(words)


def _comparison_words(out: Path, server: Server) -> str:
    """The tables, and where everything lies."""
    places = {
        "report": "report.html, report.md",
        "pictures": "evaluation/figures",
        "viewer": "evaluation/viewer.html  (turn and zoom; open it in a browser)",
        "rows": "evaluation/rows.csv",
        "runs": "trials/METHOD",
        "dataset": "dataset.zarr",
    }
    return "\n".join([read_text_within(out, "evaluation/tables.md"), *_where(out, server, places)])


def _sweep_options(made: Parser) -> None:
    from workflows.studies.sweep.plan import known_sweeps

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
    add("--strict", action="store_true", help="exit status 1 if any trial failed, not only if all did")
    _trials_options(made, "trial")


def sweep_command(options: argparse.Namespace) -> None:
    """Train many recipes on one dataset, and report which learned best.

    examples:
      dsffnet sweep --trials networks --out runs/networks
    """
    from workflows.pipeline.ray_cluster import require_reachable
    from workflows.pipeline.run_folder import SweepFolder
    from workflows.studies.sweep.plan import plan_sweep
    from workflows.studies.sweep.run import Settings, run_sweep

    sweep = plan_sweep(recipe=options.recipe, shared=options.set, vary=options.vary, trials=options.trials)
    name = options.name or (Path(options.trials).stem if options.trials else "sweep")
    settings = Settings(name, options.cpus_per_trial, options.gpus_per_trial, options.strict)
    out = Path(require_reachable(options.out or f"runs/{name}", option="--out"))
    with _at_work(options, SweepFolder(out), sweep.recipe.data) as server:
        run_sweep(sweep, out, settings, show=lambda results: print_text(_sweep_words(results, out, server)))


def _sweep_words(results: "list[TrialResult]", out: Path, server: Server) -> str:
    """The table, where everything lies, and how to continue from the best trial."""
    from workflows.studies.sweep.report import best_of

    figure = {"figure": "figures/sweep.png"} if (out / "figures" / "sweep.png").exists() else {}
    places = {"table": "sweep.md, sweep.csv", **figure, "runs": "trials/NAME", "dataset": "dataset.zarr"}
    words, best = [read_text_within(out, "sweep.md"), *_where(out, server, places)], best_of(results)
    if best is not None:
        run, data, recipe = (
            shlex.quote(str(path))
            for path in (best.trial.folder(_shown(out)), _shown(out) / "dataset.zarr", _shown(out) / "best.yaml")
        )
        words += [
            "",
            f"Continue from the best, {best.trial.name}",
            f"  python workflows/full.py --recipe {recipe} --out runs/best",
            f"  dsffnet evaluate {run} --data {data} --recipe {recipe}",
        ]
    return "\n".join(words)


def _weights_options(made: Parser) -> None:
    made.add_argument(
        "runs", nargs="+", metavar="RUN", help="run folders of trainings, a workflow's, checkpoints or weights"
    )
    add_checkpoint_option(made)
    made.add_argument("--out", metavar="FOLDER", help="where results go (default: below the run, or runs/ for several)")


def _robustness_options(made: Parser) -> None:
    from training.evaluation.disturbances import DISTURBANCES

    _weights_options(made)
    add, known = made.add_argument, ", ".join(disturbance.name for disturbance in DISTURBANCES)
    add("--data", required=True, metavar="X.zarr", help="a complete dataset with evaluation triples")
    add("--triples", type=int, default=40, metavar="N", help="evaluation triples (default 40)")
    add("--only", nargs="+", metavar="NAME", help=f"some of {known}")
    add("--emd-points", type=int, default=0, metavar="N", help="vertices of the earth mover's distance (default: none)")
    add("--example", type=int, default=0, metavar="I", help="the triple in the pictures (default 0)")


def robustness_command(options: argparse.Namespace) -> None:
    """Disturb the source (noise, missing parts, other sampling, rotation) and measure what comes out.

    examples:
      dsffnet robustness runs/quickstart/run --data runs/quickstart/dataset.zarr
      dsffnet robustness runs/dsffnet runs/npt runs/corenet3d --data X.zarr --out runs/robustness
      dsffnet robustness RUN --data X.zarr --only noise patch --triples 100
    """
    from workflows.studies.common import run_study
    from workflows.studies.robustness import RobustnessStudy

    run_study(RobustnessStudy(options))


def _generalisation_options(made: Parser) -> None:
    from workflows.studies.sizes import OTHERS, TOPOLOGIES, Sizes

    _weights_options(made)
    sizes, add = Sizes(), made.add_argument
    add(
        "--topologies", nargs="+", choices=TOPOLOGIES, default=list(TOPOLOGIES), metavar="NAME",
        help=f"Anny's meshes to make (default: all of {', '.join(TOPOLOGIES)})",
    )  # fmt: skip
    add(
        "--others", nargs="*", choices=OTHERS, default=list(OTHERS), metavar="NAME",
        help="smpl (the stand-in in SMPL's format), animals (the CC0 ones); nothing: neither (default: both)",
    )  # fmt: skip
    add("--data", nargs="+", default=[], metavar="X.zarr", help="datasets of your own: FAUST, MultiGarment, any")
    add(
        "--recipe", metavar="NAME|FILE|X.zarr",
        help="whose people and poses (default: the first run's dataset, or quickstart)",
    )  # fmt: skip
    add("--identities", type=int, default=sizes.identities, metavar="N", help="new identities (default 4)")
    add("--poses", type=int, default=sizes.poses, metavar="N", help="new poses (default 8)")
    add("--triples", type=int, default=sizes.triples, metavar="N", help="transfers for each pair (default 16)")
    add("--seed", type=int, default=sizes.seed, metavar="N", help="of people, poses, transfers (default 1000)")


def generalisation_command(options: argparse.Namespace) -> None:
    """Transfer between bodies and vertex counts that the weights were not trained on, and measure it.

    examples:
      dsffnet generalisation runs/quickstart/run
      dsffnet generalisation runs/dsffnet runs/npt --out runs/generalisation --topologies notoes_collapse3pc anny
      dsffnet generalisation RUN --data data/faust.zarr data/multigarment.zarr
    """
    from workflows.studies.common import run_study
    from workflows.studies.generalisation import GeneralisationStudy

    run_study(GeneralisationStudy(options))


COMMANDS = (
    Command(sweep_command, _sweep_options, takes_recipe=True),
    Command(compare_command, partial(_comparison_options, kind="comparison"), takes_recipe=True),
    Command(ablation_command, partial(_comparison_options, kind="ablation"), takes_recipe=True),
    Command(robustness_command, _robustness_options),
    Command(generalisation_command, _generalisation_options),
)
