"""The subcommands of ``dsffnet`` that make, show, check, take in and give out data."""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datagen.errors import DatasetError, RecipeError
from datagen.printable import printable
from datagen.recipe import PATH_KEYS, DatasetRecipe
from workflows.commands import Command, add_command, print_facts, print_text
from workflows.data_arguments import (
    declare_append,
    declare_convert,
    declare_export,
    declare_generate,
    declare_import,
    declare_inspect,
    declare_stand_in,
    declare_verify,
)
from workflows.recipe import change_recipe, load_recipe, override_values, recipe_faults, with_absolute_paths


def generate_command(options: argparse.Namespace) -> None:
    """Make a dataset, or what is missing of one."""
    from datagen.generate import generate

    recipe = load_recipe(options.recipe, options.set).data
    with _runner(options, recipe, anew=options.fresh) as how:
        generate(recipe, options.out, fresh=options.fresh, **how)
    _show(options.out)


def append_command(options: argparse.Namespace) -> None:
    """Give a dataset more identities or poses, up to these totals; nothing that is there is touched."""
    from datagen.generate import append, grown_recipe

    totals = {name: getattr(options, name) for name in ("training", "evaluation", "seen", "unseen")}
    if not any(total is not None for total in totals.values()):
        raise RecipeError("nothing to append: name at least one of --training, --evaluation, --seen, --unseen")
    recipe = _own_recipe(options.out, options.set)
    grown = grown_recipe(options.out, recipe, totals)
    with _runner(options, grown, anew=grown != recipe) as how:
        append(options.out, **totals, recipe=recipe, **how)
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
        print_text(f"picture: {path}")


def verify_command(options: argparse.Namespace) -> None:
    """Check every shard; with --repair, make the faulty ones again."""
    from datagen.generate import inline, repair
    from datagen.grid import Grid
    from datagen.store.verify import find_faults
    from workflows.pipeline import generation_bar, is_complete
    from workflows.progress import bar

    recipe = _own_recipe(options.dataset, options.set)
    count = Grid(recipe).shard_count
    faults = list(
        find_faults(options.dataset, progress=lambda shards: bar(shards, total=count, what="verify", unit="shard"))
    )
    for fault in faults:
        print_text(printable(f"fault: {fault.path}: {fault.reason}"))
    complete = is_complete(options.dataset)
    if not faults and complete:
        print_text(f"{options.dataset} is whole")
        return
    if not options.repair:
        found = f"has {len(faults)} faults" if faults else "is not complete"
        raise DatasetError(f"{options.dataset} {found}. Mend it: dsffnet verify {options.dataset} --repair")
    repair(options.dataset, recipe, faults, run=inline, progress=generation_bar)
    print_text(f"{options.dataset} is whole again")


def _own_recipe(url: str, overrides: Sequence[str]) -> DatasetRecipe:
    """The recipe stored with a dataset, with other paths of asset files.

    Raises
    ------
    RecipeError
        Something else than a path is changed.
    """
    from datagen.store.verify import require_recipe

    stored = require_recipe(url)
    recipe = change_recipe({"data": stored.model_dump(mode="json")}, overrides, where=url).data
    if recipe.sha256() != stored.sha256():
        raise RecipeError(f"--set can only change where the asset files of {url} lie: {', '.join(sorted(PATH_KEYS))}")
    return recipe


def import_command(options: argparse.Namespace) -> None:
    """Take meshes that exist already (FAUST, MultiGarment, NPT's layout) into a dataset."""
    from datagen.generate import generate
    from datagen.importers import found_recipe

    of_body = _body_options(options.set)
    with recipe_faults(f"import {options.layout}"):
        found = found_recipe(options.layout, options.folder, **of_body)
    base = {"data": found.model_dump(mode="json")}
    recipe = change_recipe(base, options.set, where=f"import {options.layout}").data
    with _runner(options, recipe, anew=options.fresh) as how:
        generate(recipe, options.out, fresh=options.fresh, **how)
    _show(options.out)


def _body_options(overrides: Sequence[str]) -> dict[str, Any]:
    """What ``--set data.body.*`` says: it decides which files are found."""
    section: Any = override_values(overrides)
    for name in ("data", "body"):
        section = section.get(name, {})
        if not isinstance(section, dict):
            raise RecipeError(f"--set {name}={section} is a whole section; set its keys, e.g. --set data.body.up=z")
    for fixed in section.keys() & {"family", "layout", "path"}:
        raise RecipeError(f"--set data.body.{fixed} is said by the command itself: dsffnet import LAYOUT FOLDER")
    return dict(with_absolute_paths(section, Path.cwd()))


def export_command(options: argparse.Namespace) -> None:
    """Write a dataset's meshes as files: NPT's layout for peers' code, or GLB, OBJ, PLY for people."""
    from datagen.exporters import export_dataset
    from datagen.store import open_dataset
    from workflows.progress import bar

    written = export_dataset(
        open_dataset(options.dataset),
        options.out,
        layout=options.layout,
        identities=options.identities,
        poses=options.poses,
        prefix=options.prefix,
        fresh=options.fresh,
        progress=lambda cells: bar(cells, total=len(cells), what="export", unit="mesh"),
    )
    print_text(f"{options.out}: {written} files written")


def convert_body_command(options: argparse.Namespace) -> None:
    """Write an original SMPL or SMAL file (a pickle) as plain arrays; nothing in it is executed."""
    from datagen.model_files import convert_model

    print_text(f"written: {convert_model(Path(options.model), Path(options.out))}")


def stand_in_command(options: argparse.Namespace) -> None:
    """Write a licence-free model in the layout of SMPL, SMPL-H, SMPL-X or SMAL, to try things out."""
    from datagen.standins import write_standin

    path = write_standin(options.kind, Path(options.out), topology=options.topology)
    family = "smal" if options.kind == "smal" else f"smpl data.body.model={options.kind}"
    print_text(
        f"written: {path}. It is not the licensed model. Use it: --set data.body.family={family} data.body.path={path}"
    )


@contextmanager
def _runner(options: argparse.Namespace, recipe: DatasetRecipe, *, anew: bool) -> Iterator[dict[str, Any]]:
    """Where tasks run (here or on Ray, by their size) and what shows their progress, once there is room for all."""
    from workflows.cluster import require_reachable
    from workflows.data_size import announce_size
    from workflows.pipeline import generation_bar
    from workflows.tasks import TaskRunner

    options.out = require_reachable(options.out, option="--out", urls=True)
    announce_size(recipe, options.out, anew=anew, yes=options.yes, local=options.local)
    with TaskRunner(local=options.local) as tasks:
        yield {"run": tasks.make_shards, "progress": generation_bar}


def _show(url: str) -> None:
    from datagen.store.verify import describe

    print_facts(describe(url))


_EXAMPLES: dict[Command, str] = {
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
    import_command: """\
  dsffnet import faust FAUST/training/registrations --out data/faust.zarr
  dsffnet import npt smpl_data --out data/npt.zarr --set data.identities.training=16""",
    convert_body_command: """\
  dsffnet convert-body basicModel_neutral_lbs_10_207_0_v1.0.0.pkl --out SMPL_NEUTRAL.npz""",
    stand_in_command: """\
  dsffnet stand-in smpl --out standin.npz
  dsffnet generate --recipe smpl-paper --set data.body.path=standin.npz --out data/standin.zarr""",
    export_command: """\
  dsffnet export data/quickstart.zarr --layout npt-obj --out exported
  dsffnet export data/quickstart.zarr --layout glb --identities 0 3 --poses 0 1 2 --out to-look-at""",
    verify_command: """\
  dsffnet verify data/quickstart.zarr
  dsffnet verify data/quickstart.zarr --repair""",
}


def add_data_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare them all."""

    def declared(command: Command, **options: bool) -> argparse.ArgumentParser:
        return add_command(commands, command, _EXAMPLES[command], **options)

    declare_generate(declared(generate_command, takes_recipe=True))
    declare_append(declared(append_command))
    declare_inspect(declared(inspect_command))
    declare_verify(declared(verify_command))
    declare_import(declared(import_command))
    declare_export(declared(export_command))
    declare_convert(declared(convert_body_command))
    declare_stand_in(declared(stand_in_command))
