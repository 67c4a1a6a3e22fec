"""How subcommands of ``dsffnet`` are declared: a function and its options; and options that several share.

Declaring imports nothing heavy: what a command needs is imported when it runs, and its options when it is asked for.
"""

import argparse
import inspect
from collections.abc import Callable
from dataclasses import dataclass

from workflows.recipe.names import known_recipes

Parser = argparse.ArgumentParser
_WORDS = ("result", "latest", "best")


@dataclass(frozen=True)
class Command:
    """A subcommand: ``NAME_command``, whose docstring is its help; with ``takes_recipe`` that lists all keys, too."""

    run: Callable[[argparse.Namespace], None]
    add_options: Callable[[Parser], None]
    takes_recipe: bool = False

    @property
    def name(self) -> str:
        """The word that a person types."""
        return self.run.__name__.removesuffix("_command").replace("_", "-")

    def add_to(self, commands: "argparse._SubParsersAction[Parser]", *, whole: bool) -> None:
        """Declare the subcommand; ``whole``: with its options and all of its help, not only its name."""
        text = inspect.getdoc(self.run) or ""
        made = commands.add_parser(
            self.name,
            help=text.split("\n")[0],
            description=text,
            epilog=recipe_keys() if whole and self.takes_recipe else None,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        made.set_defaults(command=self.run)
        if whole:
            self.add_options(made)


def recipe_keys() -> str:
    """Every key of a recipe, for the end of a help text."""
    from workflows.recipe.loader import describe_fields

    return "\n".join(["keys for --set, with their defaults:", *describe_fields()])


def which_checkpoint(word: str) -> str | int:
    """``result``, ``latest``, ``best`` or a step, as it comes from a command line."""
    if word in _WORDS:
        return word
    if word.isdecimal():
        return int(word)
    raise argparse.ArgumentTypeError(f"{word!r} is none of result, latest, best, nor a step such as 2000")


def add_recipe_options(made: Parser) -> None:
    """--recipe and --set."""
    made.add_argument(
        "--recipe",
        default="quickstart",
        metavar="NAME|FILE|X.zarr",
        help=f"a YAML file, or the recipe that a dataset was made by, or one of {', '.join(known_recipes())}",
    )
    add_set_option(made)


def add_set_option(made: Parser) -> None:
    """--set."""
    made.add_argument(
        "--set",
        action="extend",
        nargs="+",
        default=[],
        metavar="section.key=value",
        help="change keys of the recipe, in any order",
    )


def add_checkpoint_option(made: Parser) -> None:
    """--checkpoint."""
    made.add_argument(
        "--checkpoint",
        type=which_checkpoint,
        default="result",
        metavar="result|latest|best|STEP",
        help="which of the run's weights (result: the best where early stopping ended the run, else the latest)",
    )


def add_local_option(made: Parser) -> None:
    """--local."""
    made.add_argument("--local", action="store_true", help="all in this process, without Ray, however much it is")


def add_yes_option(made: Parser) -> None:
    """--yes."""
    made.add_argument("--yes", action="store_true", help="make the dataset though its disk looks too small for it")


def add_fresh_option(made: Parser, what: str) -> None:
    """--fresh."""
    made.add_argument("--fresh", action="store_true", help=f"remove {what} and start over")


def add_tracking_option(made: Parser) -> None:
    """--tracking-uri."""
    made.add_argument(
        "--tracking-uri", metavar="URI", help="MLflow server (default: MLFLOW_TRACKING_URI, else SQLite in the folder)"
    )
