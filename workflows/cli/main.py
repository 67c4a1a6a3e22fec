"""The ``dsffnet`` command: one subcommand for each thing that a person does with datasets, runs and meshes."""

import argparse
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from itertools import chain

from datagen.common.printable import nearest
from workflows.cli import avatar, data, demo, runs, skin, studies, submit, transfer, ui
from workflows.pipeline.console import guarded

_AXES = re.compile(r"-[XYZxyz](,-?[XYZxyz])?")
_GROUPS = {
    "pose meshes": (transfer.COMMAND, demo.COMMAND, skin.COMMAND),
    "make data": data.COMMANDS,
    "train, measure, look": (*runs.COMMANDS, ui.COMMAND, submit.COMMAND),
    "compare, vary, disturb": studies.COMMANDS,
    "people in clothes": (avatar.COMMAND,),
}
"""In the order in which somebody new needs them."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    words = sys.argv[1:] if arguments is None else arguments
    guarded(lambda: _run(words))


def _run(words: Sequence[str]) -> None:
    options = parsed(words)
    options.command(options)


def parsed(words: Sequence[str]) -> argparse.Namespace:
    """The options of a command line; ``command`` is the function that does what they ask for."""
    made = argparse.ArgumentParser(
        prog="dsffnet",
        usage="%(prog)s [-h] COMMAND ...",
        description="3-D pose transfer: posing your own meshes, datasets, training, evaluation.",
        epilog=_listed(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("--version", action="version", version=f"%(prog)s {version('dsffnet')}")
    commands = made.add_subparsers(required=True, metavar="COMMAND", help=argparse.SUPPRESS, prog=made.prog)
    known = {command.name: command for command in chain.from_iterable(_GROUPS.values())}
    if words and not words[0].startswith("-") and words[0] not in known:
        made.error(f"there is no command {words[0]!r}{nearest(words[0], list(known))}; there are {', '.join(known)}")
    for command in known.values():
        command.add_to(commands, words=words[1:] if command.name in words[:1] else None)
    return made.parse_args(_with_axes_joined(words))


def _listed() -> str:
    """The commands with what each does, by what somebody wants."""
    lines = list[str]()
    for group, commands in _GROUPS.items():
        lines += [f"{group}:", *(f"  {command.name:16}{command.summary}" for command in commands), ""]
    return "\n".join(
        [*lines, "dsffnet COMMAND --help: options and examples", "all stages in one go: python workflows/full.py"]
    )


def _with_axes_joined(words: Sequence[str]) -> list[str]:
    """``--front -Y`` as ``--front=-Y``: argparse takes every word that begins with a minus for an option."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in ("--up", "--front") and _AXES.fullmatch(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined
