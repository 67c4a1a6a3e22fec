"""The subcommands of ``dsffnet`` about single runs: train, evaluate, sync; and printing a recipe."""

import argparse
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from datagen.common.errors import DatasetError
from workflows.cli.declare import Command, add_command
from workflows.pipeline.console import (
    add_local_option,
    add_recipe_options,
    add_tracking_option,
    print_text,
    server_of,
    server_of_record,
)
from workflows.pipeline.weights_argument import which_checkpoint
from workflows.recipe.loader import load_recipe


def train_command(options: argparse.Namespace) -> None:
    """Train on a dataset into a run folder, or go on with a training."""
    from datagen.store import open_dataset
    from workflows.pipeline.console import alone_in, remove_run
    from workflows.pipeline.ray_cluster import require_reachable
    from workflows.pipeline.stage_functions import check_run_accepts, train_stage
    from workflows.pipeline.tasks import TaskRunner

    recipe = load_recipe(options.recipe, options.set).training
    run = Path(require_reachable(options.out, option="--out"))
    data = require_reachable(options.data, option="--data", urls=True)
    check_run_accepts(recipe, open_dataset(data), run if not options.fresh else run / "none")
    if options.fresh:
        with alone_in(run, ".driver.lock"):
            remove_run(run)
    with _mirrored(run, options), TaskRunner() as tasks:
        train_stage(recipe, data, run, parent=None, tasks=tasks)
    out, data = shlex.quote(options.out), shlex.quote(options.data)
    print_text(f"trained: {options.out}. Next: dsffnet evaluate {out} --data {data}")


def evaluate_command(options: argparse.Namespace) -> None:
    """Measure a run on a dataset's evaluation triples; tables, figures, meshes and viewer go into the run."""
    from datagen.store import open_dataset
    from training.tracking.record import read_record
    from workflows.pipeline.ray_cluster import require_reachable
    from workflows.pipeline.stage_functions import evaluate_stage
    from workflows.pipeline.tasks import TaskRunner
    from workflows.pipeline.weights_argument import evaluated

    recipe = load_recipe(options.recipe, options.set).evaluation
    place = Path(require_reachable(options.run, option="RUN"))
    home, data = evaluated(place, options.checkpoint).home, require_reachable(options.data, option="--data", urls=True)
    open_dataset(data)
    with _mirrored(home, options), TaskRunner(local=options.local) as tasks:
        parent = home if read_record(home) else None
        print_text(evaluate_stage(recipe, data, place, parent=parent, tasks=tasks, which=options.checkpoint))


def sync_command(options: argparse.Namespace) -> None:
    """Send to MLflow what an outage kept back; repeating it changes nothing."""
    from training.tracking.mlflow_mirror import publish
    from training.tracking.record import find_records, has_record
    from workflows.pipeline.console import server_of_record

    run = Path(options.run)
    records = [folder for folder in find_records(run) if has_record(folder)] if run.is_dir() else []
    if not records:
        raise DatasetError(f"{run} holds no record of a run. Name the folder that a workflow or training wrote to")
    server = server_of_record(records[0], options.tracking_uri)
    publish(run.resolve(), server)
    print_text(f"{server.uri} is up to date with {run} ({len(records)} runs)")


def recipe_command(options: argparse.Namespace) -> None:
    """Print a resolved recipe as YAML."""
    import yaml

    recipe = load_recipe(options.recipe, options.set)
    print(yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False), end="")


_EXAMPLES: dict[Command, str] = {
    train_command: """\
  dsffnet train --recipe quickstart --data data/quickstart.zarr --out runs/first
  dsffnet train --recipe quickstart --set training.steps=8000 --data data/quickstart.zarr --out runs/longer""",
    evaluate_command: """\
  dsffnet evaluate runs/first --data data/quickstart.zarr
  dsffnet evaluate runs/first --data data/quickstart.zarr --checkpoint best
  dsffnet evaluate runs/first --data data/custom.zarr --set evaluation.emd_points=1024""",
    sync_command: """\
  dsffnet sync runs/quickstart/run
  dsffnet sync runs/quickstart --tracking-uri http://127.0.0.1:5000""",
    recipe_command: """\
  dsffnet recipe --recipe quickstart
  dsffnet recipe --recipe mine.yaml --set training.batch=16
  dsffnet recipe --set training=npt-paper training.steps=100""",
}


def add_run_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare them and their options."""
    train = add_command(commands, train_command, _EXAMPLES[train_command], takes_recipe=True)
    add_recipe_options(train)
    train.add_argument("--data", required=True, metavar="X.zarr", help="a complete dataset")
    train.add_argument("--out", required=True, metavar="RUN", help="run folder; an existing one is gone on with")
    train.add_argument("--fresh", action="store_true", help="remove the run first")
    add_tracking_option(train)

    evaluate = add_command(commands, evaluate_command, _EXAMPLES[evaluate_command], takes_recipe=True)
    evaluate.add_argument("run", metavar="RUN", help="run folder of a training, a workflow's, a checkpoint or weights")
    _add_checkpoint(evaluate)
    evaluate.add_argument("--data", required=True, metavar="X.zarr", help="a complete dataset")
    add_recipe_options(evaluate)
    add_local_option(evaluate)
    add_tracking_option(evaluate)

    sync = add_command(commands, sync_command, _EXAMPLES[sync_command])
    sync.add_argument("run", metavar="RUN", help="run folder, or the folder of a whole workflow")
    add_tracking_option(sync)

    add_recipe_options(add_command(commands, recipe_command, _EXAMPLES[recipe_command], takes_recipe=True))


def _add_checkpoint(made: argparse.ArgumentParser) -> None:
    made.add_argument(
        "--checkpoint",
        type=which_checkpoint,
        default="result",
        metavar="result|latest|best|STEP",
        help="which of the run's weights (result: the best where early stopping ended the run, else the latest)",
    )


@contextmanager
def _mirrored(run: Path, options: argparse.Namespace) -> Iterator[None]:
    """Keep MLflow up to date with a run folder while the block runs; an outage is an error only at the end."""
    from training.tracking.mlflow_mirror import Mirror
    from training.tracking.record import find_records, has_record

    recorded = [folder for folder in find_records(run) if has_record(folder)]
    server = (
        server_of_record(recorded[0], options.tracking_uri) if recorded else server_of(run.parent, options.tracking_uri)
    )
    mirror = Mirror(run, server)
    mirror.start()
    try:
        yield
    finally:
        outage = mirror.close()
    if outage:
        raise outage
