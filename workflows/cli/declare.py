"""How subcommands of ``dsffnet`` are declared: a function and its options; and options that several share.

Declaring imports nothing heavy: what a command needs is imported when it runs, and its options when it is asked for.
"""

import argparse
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from workflows.recipe.names import known_recipes

Parser = argparse.ArgumentParser
_WORDS = ("result", "latest", "best")


@dataclass(frozen=True)
class Command:
    """A subcommand: ``NAME_command``, whose docstring is its help; with ``takes_recipe`` that lists keys, too: all that
    it takes, or those of one ``section``.
    """

    run: Callable[[argparse.Namespace], None]
    add_options: Callable[[Parser], None]
    takes_recipe: bool = False
    section: str = ""

    @property
    def name(self) -> str:
        """The word that a person types."""
        return self.run.__name__.removesuffix("_command").replace("_", "-")

    @property
    def summary(self) -> str:
        """What it does, in a line."""
        return (inspect.getdoc(self.run) or "").split("\n")[0]

    def add_to(self, commands: "argparse._SubParsersAction[Parser]", words: Sequence[str] | None) -> None:
        """Declare the subcommand; with the words that follow it, if it is the one, its options and all of its help."""
        text = inspect.getdoc(self.run) or ""
        made = commands.add_parser(
            self.name,
            description=text,
            epilog=recipe_keys(words, self.section) if words is not None and self.takes_recipe else None,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        made.set_defaults(command=self.run)
        if words is not None:
            self.add_options(made)
            if self.takes_recipe:
                add_help_all(made)


def add_help_all(made: Parser) -> None:
    """--help-all."""
    made.add_argument("--help-all", action="help", help="this help, with the keys of all bodies, poses and networks")


def recipe_keys(words: Sequence[str], section: str = "") -> str | None:
    """Keys of a recipe for the end of a help text, if ``words`` ask for help: of the one that they choose, or all."""
    if not any(word == "-h" or word.startswith("--h") for word in words):
        return None
    from workflows.recipe.loader import describe_fields, load_recipe

    if "--help-all" in words:
        head, keys = "keys for --set, with their defaults:", describe_fields()
        return "\n".join([head, *(key for key in keys if key.startswith(f"  {section}"))])
    asking = Parser(add_help=False, allow_abbrev=False)
    add_recipe_options(asking)
    chosen = asking.parse_known_args([word for word in words if word not in ("-h", "--help")])[0]
    recipe = load_recipe(chosen.recipe, chosen.set)
    others = " (other bodies and networks: --help-all)" if section != "evaluation" else ""
    head = f"keys for --set, with the values of --recipe {chosen.recipe}{others}:"
    return "\n".join([head, *(key for key in describe_fields(recipe=recipe) if key.startswith(f"  {section}"))])


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
