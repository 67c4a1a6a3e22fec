"""The arguments of the commands of :mod:`workflows.data_commands`, one function a command."""

import argparse
from typing import get_args

from datagen.exporters import ExportLayout
from datagen.layouts import Layout
from datagen.recipe import AnnyTopology
from datagen.standins import Kind
from workflows.console import add_local_option, add_recipe_options, add_set_option, add_yes_option


def declare_generate(made: argparse.ArgumentParser) -> None:
    add_recipe_options(made)
    _add_making(made)
    made.add_argument("--fresh", action="store_true", help="remove what is there first")


def declare_append(made: argparse.ArgumentParser) -> None:
    made.add_argument("out", metavar="X.zarr", help="a complete dataset")
    for name, what in (
        ("training", "training identities"),
        ("evaluation", "evaluation identities"),
        ("seen", "poses that occur in training"),
        ("unseen", "poses kept for evaluation"),
    ):
        made.add_argument(f"--{name}", type=int, metavar="TOTAL", help=f"{what}, with those that are there")
    add_local_option(made)
    add_yes_option(made)
    add_set_option(made)


def declare_inspect(made: argparse.ArgumentParser) -> None:
    made.add_argument("dataset", metavar="X.zarr")
    made.add_argument("--picture", metavar="PNG", help="where the picture goes; none: no picture")


def declare_verify(made: argparse.ArgumentParser) -> None:
    made.add_argument("dataset", metavar="X.zarr")
    made.add_argument("--repair", action="store_true", help="make faulty or missing shards again")
    add_set_option(made)


def declare_import(made: argparse.ArgumentParser) -> None:
    made.add_argument("layout", choices=get_args(Layout), help="how the files lie (docs/importing.md)")
    made.add_argument("folder", metavar="FOLDER", help="where they are")
    _add_making(made)
    made.add_argument("--fresh", action="store_true", help="remove what is there first")
    add_set_option(made)


def declare_export(made: argparse.ArgumentParser) -> None:
    made.add_argument("dataset", metavar="X.zarr")
    made.add_argument("--layout", choices=get_args(ExportLayout), required=True, help="see docs/importing.md")
    made.add_argument("--out", required=True, metavar="FOLDER", help="where the files go")
    made.add_argument("--identities", type=int, nargs="+", metavar="I", help="these only")
    made.add_argument("--poses", type=int, nargs="+", metavar="P", help="these only")
    made.add_argument("--prefix", default="", help="before the numbers in npt-*: id or toy_ for 3D-CoreNet's loaders")
    made.add_argument("--fresh", action="store_true", help="write files anew that are there")


def declare_convert(made: argparse.ArgumentParser) -> None:
    made.add_argument("model", metavar="MODEL", help="the file that came with your licence (.pkl or .npz)")
    made.add_argument("--out", required=True, metavar="X.npz", help="where the arrays go")


def declare_stand_in(made: argparse.ArgumentParser) -> None:
    made.add_argument("kind", choices=get_args(Kind), help="whose layout")
    made.add_argument("--out", required=True, metavar="X.npz", help="where it goes")
    made.add_argument(
        "--topology",
        default="notoes_collapse10pc",
        choices=get_args(AnnyTopology),
        help="of the Anny body it is made from",
    )


def _add_making(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", required=True, metavar="X.zarr", help="where the dataset goes (folder or store URL)")
    add_local_option(parser)
    add_yes_option(parser)
