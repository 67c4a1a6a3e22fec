"""The subcommands of ``dsffnet`` about single runs: train, evaluate, sync; and printing a recipe."""

import argparse
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from datagen.common.errors import DatasetError, RecipeError
from workflows.cli.declare import (
    Command,
    Parser,
    add_checkpoint_option,
    add_fresh_option,
    add_local_option,
    add_recipe_options,
    add_tracking_option,
)
from workflows.pipeline.console import print_text, server_of, server_of_record


def _train_options(made: Parser) -> None:
    add_recipe_options(made)
    made.add_argument("--data", required=True, metavar="X.zarr", help="a complete dataset")
    made.add_argument("--out", required=True, metavar="RUN", help="run folder; an existing one is resumed")
    add_fresh_option(made, "the run")
    add_tracking_option(made)


def train_command(options: argparse.Namespace) -> None:
    """Train on a dataset into a run folder, or resume a training.

    examples:
      dsffnet train --recipe quickstart --data data/quickstart.zarr --out runs/first
      dsffnet train --recipe quickstart --set training.steps=8000 --data data/quickstart.zarr --out runs/longer
    """
    from datagen.store import open_dataset
    from workflows.pipeline.ray_cluster import require_reachable
    from workflows.pipeline.run_folder import RunFolder
    from workflows.pipeline.tasks import TaskRunner
    from workflows.pipeline.train import check_run_accepts, train_model
    from workflows.recipe.loader import load_section

    recipe = load_section(options.recipe, options.set, "training")
    run = RunFolder(Path(require_reachable(options.out, option="--out")))
    run.require_kind()
    data = require_reachable(options.data, option="--data", urls=True)
    check_run_accepts(recipe, open_dataset(data), run.path if not options.fresh else run.path / "none")
    if options.fresh:
        with run.alone():
            run.remove()
    with _mirrored(run.path, options), TaskRunner() as tasks:
        train_model(recipe, data, run, parent=None, tasks=tasks)
        out, data = shlex.quote(options.out), shlex.quote(options.data)
        print_text(f"trained: {options.out}. Next: dsffnet evaluate {out} --data {data}")


def _evaluate_options(made: Parser) -> None:
    made.add_argument("run", metavar="RUN", help="run folder of a training, a workflow's, a checkpoint or weights")
    add_checkpoint_option(made)
    made.add_argument("--data", required=True, metavar="X.zarr", help="a complete dataset")
    made.add_argument(
        "--project", metavar="NAME", help="a row more: outputs fitted by the target's rigid parts, as human sees them"
    )
    add_recipe_options(made)
    add_local_option(made)
    add_tracking_option(made)


def evaluate_command(options: argparse.Namespace) -> None:
    """Measure a run on a dataset's evaluation triples; tables, figures, meshes and viewer go into the run.

    examples:
      dsffnet evaluate runs/first --data data/quickstart.zarr
      dsffnet evaluate runs/first --data data/quickstart.zarr --checkpoint best
      dsffnet evaluate runs/first --data data/custom.zarr --set evaluation.emd_points=1024
    """
    from datagen.store import open_dataset
    from training.tracking.record import has_record
    from workflows.pipeline.evaluate import evaluate_weights
    from workflows.pipeline.ray_cluster import require_reachable
    from workflows.pipeline.tasks import TaskRunner
    from workflows.pipeline.weights_argument import evaluated, projecting
    from workflows.recipe.loader import load_section

    recipe = load_section(options.recipe, options.set, "evaluation")
    place = Path(require_reachable(options.run, option="RUN"))
    home, data = evaluated(place, options.checkpoint).home, require_reachable(options.data, option="--data", urls=True)
    open_dataset(data)
    project = projecting(options.project)
    with _mirrored(home, options), TaskRunner(local=options.local) as tasks:
        parent = home if has_record(home) else None
        about = {"parent": parent, "which": options.checkpoint, "project": project}
        print_text(evaluate_weights(recipe, data, place, tasks=tasks, **about))


def _sync_options(made: Parser) -> None:
    made.add_argument("run", metavar="RUN", help="run folder, or the folder of a whole workflow")
    add_tracking_option(made)


def sync_command(options: argparse.Namespace) -> None:
    """Send to MLflow what an outage kept back; repeating it changes nothing.

    examples:
      dsffnet sync runs/quickstart/run
      dsffnet sync runs/quickstart --tracking-uri http://127.0.0.1:5000
    """
    from training.tracking.mlflow_mirror import publish

    run = Path(options.run)
    records = _recorded(run)
    if not records:
        raise DatasetError(f"{run} holds no record of a run. Name the folder that a workflow or training wrote to")
    server = server_of_record(records[0], options.tracking_uri)
    publish(run.resolve(), server)
    print_text(f"{server.uri} is up to date with {run} ({len(records)} runs)")


def recipe_command(options: argparse.Namespace) -> None:
    """Print a resolved recipe as YAML.

    examples:
      dsffnet recipe --recipe quickstart
      dsffnet recipe --recipe mine.yaml --set training.batch=16
      dsffnet recipe --set training=npt-paper training.steps=100
    """
    import yaml

    from workflows.recipe.loader import load_recipe

    recipe = load_recipe(options.recipe, options.set)
    print(yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False), end="")


def _import_weights_options(made: Parser) -> None:
    from training.recipes.networks import NETWORK_NAMES

    published = [name for name in NETWORK_NAMES if name != "parts"]
    made.add_argument("network", choices=published, help="whose they are")
    made.add_argument("files", nargs="+", metavar="FILE", help="as published; of 3D-CoreNet *_net_G.pth *_net_Corr.pth")
    made.add_argument("--out", required=True, metavar="FOLDER", help="where the weights go")
    made.add_argument("--variant", choices=("maxpool", "origin"), help="of npt: the script that trained it (maxpool)")


def import_weights_command(options: argparse.Namespace) -> None:
    """Write the authors' published weights as ours: a folder to name where a run or model is asked for.

    examples:
      dsffnet import-weights dsffnet saved_models/model_smpl.pth --out weights/dsffnet-smpl
      dsffnet import-weights npt original_169.model --variant origin --out weights/npt
      dsffnet import-weights corenet3d latest_net_G.pth latest_net_Corr.pth --out weights/corenet3d
    """
    from training.checkpoints.folder import WEIGHTS, commit_into, weights_writer
    from training.checkpoints.weights import fill_network
    from training.networks import network_from
    from training.networks.released_weights import load_released
    from training.recipes.training import TrainingRecipe

    files = list(map(Path, options.files))
    if len(files) != (2 if options.network == "corenet3d" else 1) or (options.variant and options.network != "npt"):
        raise RecipeError("name one file, of corenet3d two (*_net_G.pth *_net_Corr.pth); --variant is for npt alone")
    section = {"name": options.network} | ({"variant": options.variant} if options.variant else {})
    recipe = TrainingRecipe.model_validate({"network": section})
    weights = load_released(files, section).state_dict()
    fill_network(network_from(recipe.network), weights, where=options.files[0])
    about = {"step": 0, "recipe": recipe.model_dump(mode="json"), "dataset": ""}
    commit_into(Path(options.out), about, {WEIGHTS: weights_writer(weights, about)})
    print_text(f"written: {options.out}. Next: dsffnet transfer --model {shlex.quote(options.out)} ...")


def _recorded(run: Path) -> list[Path]:
    """Folders in ``run``, it included, with a readable record; parents first."""
    from training.tracking.record import find_records, has_record

    return [folder for folder in find_records(run) if has_record(folder)] if run.is_dir() else []


@contextmanager
def _mirrored(run: Path, options: argparse.Namespace) -> Iterator[None]:
    """Keep MLflow up to date with a run folder while the block runs; an outage is an error only at the end."""
    from training.tracking.mlflow_mirror import Mirror

    run = run.resolve()  # the store of a run lies beside it, not beside a link to it
    records = _recorded(run)
    uri = options.tracking_uri
    with Mirror(run, server_of_record(records[0], uri) if records else server_of(run.parent, uri)):
        yield


COMMANDS = (
    Command(train_command, _train_options, takes_recipe=True, section="training"),
    Command(evaluate_command, _evaluate_options, takes_recipe=True, section="evaluation"),
    Command(recipe_command, add_recipe_options, takes_recipe=True),
    Command(import_weights_command, _import_weights_options),
    Command(sync_command, _sync_options),
)
