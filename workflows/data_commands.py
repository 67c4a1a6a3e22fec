"""The subcommands of ``dsffnet`` that make, show, check, take in and give out data."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datagen.errors import DatasetError, RecipeError
from workflows.commands import add_command, print_facts
from workflows.console import add_recipe_options
from workflows.recipe import load_recipe


def generate_command(options: argparse.Namespace) -> None:
    """Make a dataset, or what is missing of one."""
    from datagen.generate import generate

    recipe = load_recipe(options.recipe, options.set).data
    with _runner(options) as how:
        generate(recipe, options.out, fresh=options.fresh, **how)
    _show(options.out)


def append_command(options: argparse.Namespace) -> None:
    """Give a dataset more identities or poses, up to these totals; nothing that is there is touched."""
    from datagen.generate import append

    totals = {name: getattr(options, name) for name in ("training", "evaluation", "seen", "unseen")}
    if not any(total is not None for total in totals.values()):
        raise RecipeError("nothing to append: name at least one of --training, --evaluation, --seen, --unseen")
    with _runner(options) as how:
        append(options.out, **totals, **how)
    _show(options.out)


def inspect_command(options: argparse.Namespace) -> None:
    """Show what a dataset holds, at any status, and draw identities x poses."""
    from datagen.store import open_dataset
    from datagen.store.verify import describe
    from workflows.pipeline import draw_contact_sheet, is_complete

    print_facts(describe(options.dataset))
    if options.picture != "none" and is_complete(options.dataset):
        default = f"{Path(options.dataset).name.removesuffix('.zarr')}-contact-sheet.png"
        path = draw_contact_sheet(open_dataset(options.dataset), Path(options.picture or default))
        print(f"picture: {path}")


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


@contextmanager
def _runner(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Where tasks run (--local: here; otherwise on Ray) and what shows their progress."""
    from datagen.generate import inline, ray_runner
    from workflows.cluster import ray_cluster, require_reachable
    from workflows.pipeline import generation_bar

    options.out = require_reachable(options.out, option="--out", urls=True)
    if options.local:
        yield {"run": inline, "progress": generation_bar}
    else:
        with ray_cluster():
            yield {"run": ray_runner, "progress": generation_bar}


def _show(url: str) -> None:
    from datagen.store.verify import describe

    print_facts(describe(url))


_EXAMPLES = {
    generate_command: """\
  dsffnet generate --recipe quickstart --out data/quickstart.zarr
  dsffnet generate --recipe quickstart --set data.identities.seed=7 --out data/custom.zarr
  dsffnet generate --recipe data/custom.zarr --out data/custom-again.zarr""",
    append_command: """\
  dsffnet append data/quickstart.zarr --training 24
  dsffnet append data/quickstart.zarr --evaluation 12 --unseen 400""",
    inspect_command: """\
  dsffnet inspect data/quickstart.zarr
  dsffnet inspect data/quickstart.zarr --picture sheet.png""",
    verify_command: """\
  dsffnet verify data/quickstart.zarr
  dsffnet verify data/quickstart.zarr --repair""",
}


def add_data_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare them all."""
    generate = add_command(commands, generate_command, _EXAMPLES[generate_command], takes_recipe=True)
    add_recipe_options(generate)
    _add_making(generate)
    generate.add_argument("--fresh", action="store_true", help="remove what is there first")

    append = add_command(commands, append_command, _EXAMPLES[append_command])
    append.add_argument("out", metavar="X.zarr", help="a complete dataset")
    for name, what in (
        ("training", "training identities"),
        ("evaluation", "evaluation identities"),
        ("seen", "poses that occur in training"),
        ("unseen", "poses kept for evaluation"),
    ):
        append.add_argument(f"--{name}", type=int, metavar="TOTAL", help=f"{what}, with those that are there")
    append.add_argument("--local", action="store_true", help="in this process, without Ray")

    inspect = add_command(commands, inspect_command, _EXAMPLES[inspect_command])
    inspect.add_argument("dataset", metavar="X.zarr")
    inspect.add_argument("--picture", metavar="PNG", help="where the picture goes; none: no picture")

    verify = add_command(commands, verify_command, _EXAMPLES[verify_command])
    verify.add_argument("dataset", metavar="X.zarr")
    verify.add_argument("--repair", action="store_true", help="make faulty or missing shards again")


def _add_making(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="X.zarr", help="where the dataset goes (folder or store URL)")
    parser.add_argument("--local", action="store_true", help="in this process, without Ray")
