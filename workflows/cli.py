"""The ``dsffnet`` command: one subcommand for each thing that a person does with datasets, runs and meshes."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from datagen.errors import DatasetError
from workflows.console import add_recipe_options, add_tracking_option, guarded, server_of
from workflows.recipe import describe_fields, load_recipe

Command = Callable[[argparse.Namespace], None]


def main() -> None:
    """Entry point of the console script."""
    options = _parser().parse_args()
    guarded(lambda: options.command(options))


def generate_command(options: argparse.Namespace) -> None:
    """Make a dataset, or what is missing of one."""
    from datagen.generate import generate, inline, ray_runner
    from datagen.store.verify import describe
    from workflows.cluster import ray_cluster, require_reachable
    from workflows.pipeline import generation_bar

    recipe = load_recipe(options.recipe, options.set).data
    url = require_reachable(options.out, option="--out", urls=True)
    if options.local:
        generate(recipe, url, run=inline, progress=generation_bar, fresh=options.fresh)
    else:
        with ray_cluster():
            generate(recipe, url, run=ray_runner, progress=generation_bar, fresh=options.fresh)
    _print_facts(describe(url))


def inspect_command(options: argparse.Namespace) -> None:
    """Show what a dataset holds, at any status; with --picture, draw identities x poses."""
    from datagen.store import open_dataset
    from datagen.store.verify import describe
    from workflows.pipeline import draw_contact_sheet

    _print_facts(describe(options.dataset))
    if options.picture:
        print(draw_contact_sheet(open_dataset(options.dataset), Path(options.picture)))


def verify_command(options: argparse.Namespace) -> None:
    """Check every shard; with --repair, make the faulty ones again."""
    from datagen.generate import inline, repair
    from datagen.grid import Grid
    from datagen.store.verify import find_faults, require_recipe
    from workflows.pipeline import generation_bar, is_complete
    from workflows.progress import bar

    recipe = require_recipe(options.dataset)
    count = len(Grid(recipe).shards())
    faults = list(
        find_faults(options.dataset, progress=lambda shards: bar(shards, total=count, what="verify", unit="shard"))
    )
    for fault in faults:
        print(f"fault: {fault.path}: {fault.reason}")
    complete = is_complete(options.dataset)
    if not faults and complete:
        print(f"{options.dataset} is whole")
        return
    if not options.repair:
        found = f"has {len(faults)} faults" if faults else "is not complete"
        raise DatasetError(f"{options.dataset} {found}. Mend it: dsffnet verify {options.dataset} --repair")
    repair(options.dataset, recipe, faults, run=inline, progress=generation_bar)
    print(f"{options.dataset} is whole again")


def train_command(options: argparse.Namespace) -> None:
    """Train on a dataset into a run folder, or go on with a training."""
    from datagen.store import open_dataset
    from workflows.cluster import ray_cluster, require_reachable
    from workflows.console import alone_in, remove_run
    from workflows.pipeline import check_run_accepts, train_stage

    recipe = load_recipe(options.recipe, options.set).training
    run = Path(require_reachable(options.out, option="--out"))
    data = require_reachable(options.data, option="--data", urls=True)
    check_run_accepts(recipe, open_dataset(data), run if not options.fresh else run / "none")
    if options.fresh:
        with alone_in(run, ".driver.lock"):
            remove_run(run)
    with _mirrored(run, options), ray_cluster():
        train_stage(recipe, data, run, parent=None)
    print(f"trained: {options.out}. Next: dsffnet evaluate {options.out} --data {options.data}")


def evaluate_command(options: argparse.Namespace) -> None:
    """Measure a run on a dataset's evaluation triples; tables, figures, meshes and viewer go into the run."""
    from datagen.store import open_dataset
    from training.checkpoint import require_checkpoint
    from training.record import read_record
    from workflows.cluster import ray_cluster, require_reachable
    from workflows.pipeline import evaluate_stage

    recipe = load_recipe(options.recipe, options.set).evaluation
    run = Path(require_reachable(options.run, option="RUN"))
    require_checkpoint(run)
    open_dataset(options.data)
    with _mirrored(run, options), ray_cluster():
        parent = run if read_record(run) else None
        print(evaluate_stage(recipe, require_reachable(options.data, option="--data", urls=True), run, parent=parent))


def transfer_command(options: argparse.Namespace) -> None:
    """Pose one mesh like another."""
    from datagen.mesh import load_mesh, save_mesh
    from training.transfer import PoseTransfer

    source, target = load_mesh(options.source), load_mesh(options.target)
    posed = PoseTransfer.from_run(options.model)(source=source, target=target)
    save_mesh(posed, options.out)
    print(f"{options.out}: {len(posed.vertices):,} vertices of {options.target} in the pose of {options.source}")


def sync_command(options: argparse.Namespace) -> None:
    """Send to MLflow what an outage kept back; repeating it changes nothing."""
    from training.record import find_records
    from training.tracking import publish
    from workflows.console import server_of_record

    run = Path(options.run)
    records = find_records(run) if run.is_dir() else []
    if not records:
        raise DatasetError(f"{run} holds no record of a run. Name the folder that a workflow or training wrote to")
    server = server_of_record(records[0], options.tracking_uri)
    publish(run.resolve(), server)
    print(f"{server.uri} is up to date with {run} ({len(records)} runs)")


def recipe_command(options: argparse.Namespace) -> None:
    """Print a resolved recipe as YAML."""
    import yaml

    recipe = load_recipe(options.recipe, options.set)
    print(yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False), end="")


_EXAMPLES: dict[Command, str] = {
    generate_command: """\
  dsffnet generate --recipe quickstart --out data/quickstart.zarr
  dsffnet generate --recipe quickstart --set data.identities.seed=7 --out data/custom.zarr""",
    inspect_command: """\
  dsffnet inspect data/quickstart.zarr
  dsffnet inspect data/quickstart.zarr --picture sheet.png""",
    verify_command: """\
  dsffnet verify data/quickstart.zarr
  dsffnet verify data/quickstart.zarr --repair""",
    train_command: """\
  dsffnet train --recipe quickstart --data data/quickstart.zarr --out runs/first
  dsffnet train --recipe quickstart --set training.steps=8000 --data data/quickstart.zarr --out runs/longer""",
    evaluate_command: """\
  dsffnet evaluate runs/first --data data/quickstart.zarr
  dsffnet evaluate runs/first --data data/custom.zarr --set evaluation.emd_points=1024""",
    transfer_command: """\
  dsffnet transfer --model runs/quickstart/run --source pose.obj --target person.obj --out posed.obj""",
    sync_command: """\
  dsffnet sync runs/quickstart/run
  dsffnet sync runs/quickstart --tracking-uri http://127.0.0.1:5000""",
    recipe_command: """\
  dsffnet recipe --recipe quickstart
  dsffnet recipe --recipe mine.yaml --set training.batch=16""",
}


def _parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="dsffnet",
        description="3-D pose transfer: datasets, training, evaluation, and posing your own meshes.",
        epilog="From nothing to a trained and evaluated model in one go: python workflows/full.py",
    )
    commands = made.add_subparsers(required=True, metavar="COMMAND")

    generate = _command(commands, generate_command)
    add_recipe_options(generate)
    generate.add_argument("--out", required=True, metavar="X.zarr", help="where the dataset goes (folder or store URL)")
    generate.add_argument("--fresh", action="store_true", help="remove what is there first")
    generate.add_argument("--local", action="store_true", help="in this process, without Ray")

    inspect = _command(commands, inspect_command)
    inspect.add_argument("dataset", metavar="X.zarr")
    inspect.add_argument("--picture", metavar="PNG", help="also draw identities x poses")

    verify = _command(commands, verify_command)
    verify.add_argument("dataset", metavar="X.zarr")
    verify.add_argument("--repair", action="store_true", help="make faulty or missing shards again")

    train = _command(commands, train_command)
    add_recipe_options(train)
    train.add_argument("--data", required=True, metavar="X.zarr", help="a complete dataset")
    train.add_argument("--out", required=True, metavar="RUN", help="run folder; an existing one is gone on with")
    train.add_argument("--fresh", action="store_true", help="remove the run first")
    add_tracking_option(train)

    evaluate = _command(commands, evaluate_command)
    evaluate.add_argument("run", metavar="RUN", help="run folder of a training")
    evaluate.add_argument("--data", required=True, metavar="X.zarr", help="a complete dataset")
    add_recipe_options(evaluate)
    add_tracking_option(evaluate)

    transfer = _command(commands, transfer_command)
    transfer.add_argument("--model", required=True, metavar="RUN", help="run folder of a training")
    transfer.add_argument("--source", required=True, metavar="A", help="mesh in the wanted pose")
    transfer.add_argument("--target", required=True, metavar="B", help="mesh of the wanted identity")
    transfer.add_argument("--out", required=True, metavar="C", help="mesh to write (.obj .ply .off .glb .stl)")

    sync = _command(commands, sync_command)
    sync.add_argument("run", metavar="RUN", help="run folder, or the folder of a whole workflow")
    add_tracking_option(sync)

    add_recipe_options(_command(commands, recipe_command))
    return made


def _command(
    commands: "argparse._SubParsersAction[argparse.ArgumentParser]", command: Command
) -> argparse.ArgumentParser:
    takes_recipe = command in (generate_command, train_command, evaluate_command, recipe_command)
    keys = "\n\nkeys for --set, with their defaults:\n" + "\n".join(describe_fields()) if takes_recipe else ""
    made = commands.add_parser(
        command.__name__.removesuffix("_command"),
        help=(command.__doc__ or "").split("\n")[0],
        description=command.__doc__,
        epilog=f"examples:\n{_EXAMPLES[command]}{keys}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.set_defaults(command=command)
    return made


@contextmanager
def _mirrored(run: Path, options: argparse.Namespace) -> Iterator[None]:
    """Keep MLflow up to date with a run folder while the block runs; an outage is an error only at the end."""
    from training.tracking import Mirror

    mirror = Mirror(run, server_of(run.parent, options.tracking_uri))
    mirror.start()
    try:
        yield
    finally:
        outage = mirror.close()
    if outage:
        raise outage


def _print_facts(facts: dict[str, str]) -> None:
    width = max(map(len, facts))
    print("\n".join(f"{name:{width}}  {value}" for name, value in facts.items()))


if __name__ == "__main__":
    main()
