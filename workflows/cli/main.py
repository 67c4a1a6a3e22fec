"""The ``dsffnet`` command: one subcommand for each thing that a person does with datasets, runs and meshes."""

import argparse
import re
import sys
from collections.abc import Sequence

from workflows.cli import avatar, data, demo, runs, skin, studies, submit, transfer, ui
from workflows.pipeline.console import guarded

_AXES = re.compile(r"-[XYZxyz](,-?[XYZxyz])?")
_COMMANDS = (
    *data.COMMANDS, *runs.COMMANDS, *studies.COMMANDS, transfer.COMMAND, skin.COMMAND, avatar.COMMAND,
    demo.COMMAND, submit.COMMAND, ui.COMMAND,
)  # fmt: skip


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
        description="3-D pose transfer: datasets, training, evaluation, and posing your own meshes.",
        epilog="From nothing to a trained and evaluated model in one go: python workflows/full.py",
    )
    commands = made.add_subparsers(required=True, metavar="COMMAND")
    for command in _COMMANDS:
        command.add_to(commands, words=words[1:] if command.name in words[:1] else None)
    return made.parse_args(_with_axes_joined(words))


def _with_axes_joined(words: Sequence[str]) -> list[str]:
    """``--front -Y`` as ``--front=-Y``: argparse takes every word that begins with a minus for an option."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in ("--up", "--front") and _AXES.fullmatch(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined
