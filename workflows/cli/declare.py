"""How subcommands of ``dsffnet`` are declared: a function, its examples, its arguments."""

import argparse
from collections.abc import Callable

Command = Callable[[argparse.Namespace], None]


def add_command(
    commands: "argparse._SubParsersAction[argparse.ArgumentParser]",
    command: Command,
    examples: str,
    *,
    takes_recipe: bool = False,
) -> argparse.ArgumentParser:
    """A subparser named after ``NAME_command`` and described by its docstring; with a recipe, all keys are listed."""
    keys = f"\n\n{_keys()}" if takes_recipe else ""
    made = commands.add_parser(
        command.__name__.removesuffix("_command").replace("_", "-"),
        help=(command.__doc__ or "").split("\n")[0],
        description=command.__doc__,
        epilog=f"examples:\n{examples}{keys}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.set_defaults(command=command)
    return made


def _keys() -> str:
    from workflows.recipe.loader import describe_fields

    return "\n".join(["keys for --set, with their defaults:", *describe_fields()])
