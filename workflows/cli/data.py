"""The subcommands of ``dsffnet`` that make, show, check, take in and give out data."""

import argparse
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from datagen.common.errors import DatasetError, RecipeError
from datagen.common.printable import counted, printable
from workflows.cli.declare import (
    Command,
    Parser,
    add_local_option,
    add_recipe_options,
    add_set_option,
    add_yes_option,
)
from workflows.pipeline.console import print_facts, print_text, warn

if TYPE_CHECKING:
    from datagen.recipe import DatasetRecipe
    from datagen.store import Dataset


def declare_generate(made: Parser) -> None:
    add_recipe_options(made)
    _add_making(made)
    made.add_argument("--fresh", action="store_true", help="remove what is there first")


def declare_append(made: Parser) -> None:
    made.add_argument("out", metavar="X.zarr", help="a complete dataset")
    for option, (_, what) in _TOTALS.items():
        made.add_argument(option, type=int, metavar="TOTAL", help=f"{what}, with those that are there")
    add_local_option(made)
    add_yes_option(made)
    add_set_option(made)


_TOTALS = {
    "--training-identities": ("training", "identities to train on"),
    "--evaluation-identities": ("evaluation", "identities kept for evaluation"),
    "--seen-poses": ("seen", "poses that occur in training"),
    "--unseen-poses": ("unseen", "poses kept for evaluation"),
}
"""Options of ``append``: what the grid calls it, and what it counts."""


def declare_inspect(made: Parser) -> None:
    made.add_argument("dataset", metavar="X.zarr")
    made.add_argument("--picture", metavar="PNG", help="where the picture goes (beside the dataset); none: no picture")


def declare_verify(made: Parser) -> None:
    made.add_argument("dataset", metavar="X.zarr")
    made.add_argument("--repair", action="store_true", help="make faulty or missing shards again")
    add_set_option(made)


def declare_import(made: Parser) -> None:
    from datagen.bodies.imported_layouts import Layout

    made.add_argument("layout", choices=get_args(Layout), help="how the files lie (docs/importing.md)")
    made.add_argument("folder", metavar="FOLDER", help="where they are")
    _add_making(made)
    made.add_argument("--fresh", action="store_true", help="remove what is there first")
    add_set_option(made)


def declare_export(made: Parser) -> None:
    from datagen.exporters import ExportLayout

    made.add_argument("dataset", metavar="X.zarr")
    made.add_argument("--layout", choices=get_args(ExportLayout), required=True, help="see docs/importing.md")
    made.add_argument("--out", required=True, metavar="FOLDER", help="where the files go")
    made.add_argument("--identities", type=int, nargs="+", metavar="I", help="these only")
    made.add_argument("--poses", type=int, nargs="+", metavar="P", help="these only")
    made.add_argument("--prefix", default="", help="before the numbers in npt-*: id or toy_ for 3D-CoreNet's loaders")
    made.add_argument("--fresh", action="store_true", help="write files anew that are there")


def declare_convert(made: Parser) -> None:
    made.add_argument("model", metavar="MODEL", help="the file that came with your licence (.pkl or .npz)")
    made.add_argument("--out", required=True, metavar="X.npz", help="where the arrays go")


def declare_stand_in(made: Parser) -> None:
    from datagen.bodies.standins.smpl_format import StandInKind
    from datagen.recipe import AnnyTopology

    made.add_argument(
        "kind", choices=(*get_args(StandInKind), "animals"), help="whose layout; or the twelve CC0 animals"
    )
    made.add_argument("--out", required=True, metavar="X.npz", help="where it goes; of animals a folder")
    made.add_argument(
        "--topology",
        choices=get_args(AnnyTopology),
        help="of people: of the Anny body it is made from (notoes_collapse10pc)",
    )


def _add_making(parser: Parser) -> None:
    parser.add_argument("--out", required=True, metavar="X.zarr", help="where the dataset goes (folder or store URL)")
    add_local_option(parser)
    add_yes_option(parser)


def generate_command(options: argparse.Namespace) -> None:
    """Make a dataset, or what is missing of one.

    examples:
      dsffnet generate --recipe quickstart --out data/quickstart.zarr
      dsffnet generate --recipe quickstart --set data.identities.seed=7 --out data/custom.zarr
      dsffnet generate --recipe data/custom.zarr --out data/custom-again.zarr
    """
    from datagen.generate import generate
    from workflows.recipe.loader import load_section

    recipe = load_section(options.recipe, options.set, "data")
    with _runner(options, recipe, anew=options.fresh) as how:
        made = generate(recipe, options.out, fresh=options.fresh, **how)
    _show(made)


def append_command(options: argparse.Namespace) -> None:
    """Give a dataset more identities or poses, up to these totals; nothing that is there is touched.

    examples:
      dsffnet append data/quickstart.zarr --training-identities 24
      dsffnet append data/quickstart.zarr --evaluation-identities 12 --unseen-poses 400
    """
    from datagen.generate import append, grown_recipe
    from workflows.pipeline.generate import is_complete

    given = vars(options)
    totals = {name: given[option.lstrip("-").replace("-", "_")] for option, (name, _) in _TOTALS.items()}
    if not any(total is not None for total in totals.values()):
        raise RecipeError(f"nothing to append: name at least one of {', '.join(_TOTALS)}")
    recipe = _own_recipe(options.out, options.set)
    grown = grown_recipe(options.out, recipe, totals)
    nothing = grown == recipe and is_complete(options.out)
    with _runner(options, grown, anew=grown != recipe) as how:
        made = append(options.out, **totals, recipe=recipe, **how)
    if nothing:
        print_text(f"nothing was to be appended: {options.out} has these totals already")
    _show(made)


def inspect_command(options: argparse.Namespace) -> None:
    """Show what a dataset holds, at any status, and draw identities x poses beside it.

    examples:
      dsffnet inspect data/quickstart.zarr
      dsffnet inspect data/quickstart.zarr --picture sheet.png
    """
    from datagen.store import open_dataset
    from datagen.store.verify import describe
    from training.reports.contact_sheet import draw_contact_sheet

    place = _picture_of(options.dataset, options.picture) if options.picture else _beside(options.dataset)
    print_facts(describe(options.dataset))
    if options.picture == "none":
        return
    try:
        print_text(f"picture: {draw_contact_sheet(open_dataset(options.dataset), place)}")
    except DatasetError as error:
        if options.picture:
            raise DatasetError(f"no picture was made: {error}") from error
        warn(f"no picture was made: {error}")


def _picture_of(dataset: str, name: str) -> Path:
    """Where the picture goes that was asked for; what is no picture, or part of the dataset, is not written over."""
    from datagen.store.objects import plain

    place, within = Path(name), os.path.realpath(plain(dataset))
    if name != "none" and (
        place.suffix.lower() != ".png" or place.is_dir() or Path(os.path.realpath(place)).is_relative_to(within)
    ):
        raise RecipeError(
            f"--picture {name!r}: a picture is a file that ends in .png and lies outside the dataset, e.g. sheet.png"
        )
    return place


def _beside(dataset: str) -> Path:
    """Where the picture of a dataset goes: beside it, or here where nothing can be written there."""
    path = Path(dataset.rstrip("/"))
    name = f"{path.name.removesuffix('.zarr')}-contact-sheet.png"
    is_here = "://" in dataset or not os.access(path.parent, os.W_OK)
    return Path(name) if is_here else path.parent / name


def verify_command(options: argparse.Namespace) -> None:
    """Check every shard; with --repair, make the faulty ones again.

    examples:
      dsffnet verify data/quickstart.zarr
      dsffnet verify data/quickstart.zarr --repair
    """
    from datagen.generate import inline, repair
    from datagen.store.verify import Fault, find_faults
    from workflows.pipeline.generate import generation_bar, is_complete
    from workflows.pipeline.progress import bar

    recipe = _own_recipe(options.dataset, options.set)

    def shown(shards: Iterable[Fault | None], total: int) -> Iterable[Fault | None]:
        return bar(shards, total=total, what="verify", unit="shard")

    faults = list(find_faults(options.dataset, progress=shown))
    for fault in faults:
        print_text(printable(f"fault: {fault.path}: {fault.reason}"))
    complete = is_complete(options.dataset)
    if not faults and complete:
        print_text(f"{options.dataset} is whole")
        return
    if not options.repair:
        found = f"has {counted(len(faults), 'fault')}" if faults else "is not complete"
        raise DatasetError(f"{options.dataset} {found}. Repair it: dsffnet verify {options.dataset} --repair")
    repair(options.dataset, recipe, faults, run=inline, progress=generation_bar)
    print_text(f"{options.dataset} is whole again")


def _own_recipe(url: str, overrides: Sequence[str]) -> "DatasetRecipe":
    """The recipe stored with a dataset, with other paths of asset files.

    Raises
    ------
    RecipeError
        Something else than a path is changed.
    """
    from datagen.recipe import PATH_KEYS
    from datagen.store.schema import check_version, open_group, stored_recipe
    from workflows.recipe.loader import change_recipe

    group = open_group(url)
    check_version(url, group)
    stored = stored_recipe(url, group)
    recipe = change_recipe({"data": stored.model_dump(mode="json")}, overrides, where=url).data
    if recipe.sha256() != stored.sha256():
        raise RecipeError(f"--set can only change where the asset files of {url} lie: {', '.join(sorted(PATH_KEYS))}")
    return recipe


def import_command(options: argparse.Namespace) -> None:
    """Take meshes that exist already (FAUST, MultiGarment, NPT's layout) into a dataset.

    examples:
      dsffnet import faust FAUST/training/registrations --out data/faust.zarr
      dsffnet import npt smpl_data --out data/npt.zarr --set data.identities.training=16
    """
    from datagen.generate import generate
    from datagen.importers import found_recipe
    from workflows.recipe.loader import change_recipe, recipe_faults

    of_body = _body_options(options.set)
    with recipe_faults(f"import {options.layout}"):
        found = found_recipe(options.layout, options.folder, **of_body)
    base = {"data": found.model_dump(mode="json")}
    recipe = change_recipe(base, options.set, where=f"import {options.layout}").data
    with _runner(options, recipe, anew=options.fresh) as how:
        made = generate(recipe, options.out, fresh=options.fresh, **how)
    _show(made)


def _body_options(overrides: Sequence[str]) -> dict[str, Any]:
    """What ``--set data.body.*`` says: it decides which files are found."""
    from datagen.recipe.text import changed, parse_words
    from workflows.recipe.loader import with_absolute_paths

    section: Any = changed({}, parse_words(overrides, option="--set "))
    for name in ("data", "body"):
        section = section.get(name, {})
        if not isinstance(section, dict):
            raise RecipeError(f"--set {name}={section} is a whole section; set its keys, e.g. --set data.body.up=z")
    for fixed in section.keys() & {"family", "layout", "path"}:
        raise RecipeError(f"--set data.body.{fixed} is said by the command itself: dsffnet import LAYOUT FOLDER")
    return dict(with_absolute_paths(section, Path.cwd()))


def export_command(options: argparse.Namespace) -> None:
    """Write a dataset's meshes as files: NPT's layout for peers' code, or GLB, OBJ, PLY for people.

    examples:
      dsffnet export data/quickstart.zarr --layout npt-obj --out exported
      dsffnet export data/quickstart.zarr --layout glb --identities 0 3 --poses 0 1 2 --out to-look-at
      dsffnet export data/clothed-small.zarr --layout glb-animated --out to-play
    """
    from datagen.exporters import export_dataset
    from datagen.store import open_dataset
    from workflows.pipeline.progress import bar

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
    print_text(f"{options.out}: {counted(written, 'file')} written")


def convert_body_command(options: argparse.Namespace) -> None:
    """Write an original SMPL or SMAL file (a pickle) as plain arrays; nothing in it is executed.

    examples:
      dsffnet convert-body basicModel_neutral_lbs_10_207_0_v1.0.0.pkl --out SMPL_NEUTRAL.npz
    """
    from datagen.bodies.smpl_family.model_file import convert_model

    print_text(f"written: {convert_model(Path(options.model), Path(options.out))}")


def stand_in_command(options: argparse.Namespace) -> None:
    """Write a licence-free model in the layout of SMPL, -H, -X or SMAL, or CC0 animals, to try things out.

    examples:
      dsffnet stand-in smpl --out standin.npz
      dsffnet generate --recipe smpl-paper --set data.body.path=standin.npz --out data/standin.zarr
      dsffnet stand-in animals --out animals
    """
    if options.topology and options.kind in ("smal", "animals"):
        raise RecipeError(
            f"--topology {options.topology} is of people, which {options.kind} is not made from. Leave it out"
        )
    if options.kind == "animals":
        _write_animals(Path(options.out))
        return
    from datagen.bodies.standins.smpl_format import write_standin

    of_people = {"topology": options.topology} if options.topology else {}
    path = write_standin(options.kind, Path(options.out), **of_people)
    family = "smal" if options.kind == "smal" else f"smpl data.body.model={options.kind}"
    print_text(
        f"written: {path}. It is not the licensed model. Use it: --set data.body.family={family} data.body.path={path}"
    )


def _write_animals(folder: Path) -> None:
    from datagen.characters.cc0_animals import are_there, write_animals

    if not are_there():
        print_text("fetching the animals, 14 MB, once ...")
    files = write_animals(folder)
    print_text(
        f"written: {len(files)} animals (GLB, CC0) in {folder}. Pose one like another: "
        f"dsffnet transfer {folder / 'deer.glb'} {folder / 'fox.glb'} -o posed.glb"
    )


@contextmanager
def _runner(options: argparse.Namespace, recipe: "DatasetRecipe", *, anew: bool) -> Iterator[dict[str, Any]]:
    """Where tasks run (here or on Ray, by their size) and what shows their progress, once there is room for all."""
    from workflows.pipeline.forecast import announce_size
    from workflows.pipeline.generate import generation_bar
    from workflows.pipeline.ray_cluster import require_reachable
    from workflows.pipeline.tasks import TaskRunner

    options.out = require_reachable(options.out, option="--out", urls=True)
    announce_size(recipe, options.out, anew=anew, yes=options.yes, local=options.local)
    with TaskRunner(local=options.local) as tasks:
        yield {"run": tasks.make_shards, "progress": generation_bar}


def _show(made: "Dataset") -> None:
    from datagen.store.verify import describe

    print_facts(describe(made.url, written=made.sizes))


COMMANDS = (
    Command(generate_command, declare_generate, takes_recipe=True, section="data"),
    Command(inspect_command, declare_inspect),
    Command(append_command, declare_append),
    Command(verify_command, declare_verify),
    Command(export_command, declare_export),
    Command(import_command, declare_import),
    Command(convert_body_command, declare_convert),
    Command(stand_in_command, declare_stand_in),
)
