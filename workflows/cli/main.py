"""The ``dsffnet`` command: one subcommand for each thing that a person does with datasets, runs and meshes."""

import argparse
import importlib
import re
import sys
from collections.abc import Sequence

from workflows.pipeline.console import guarded

_GROUPS = {
    ("generate", "append", "inspect", "verify", "import", "export", "convert-body", "stand-in"): (
        "workflows.cli.data",
        "add_data_commands",
    ),
    ("train", "evaluate", "sync", "recipe"): ("workflows.cli.runs", "add_run_commands"),
    ("sweep", "compare", "ablation", "robustness", "generalisation"): (
        "workflows.cli.studies",
        "add_study_commands",
    ),
    ("transfer",): ("workflows.cli.transfer", "add_transfer"),
    ("submit",): ("workflows.cli.submit", "add_submit"),
    ("ui",): ("workflows.cli.ui", "add_ui"),
}
"""Subcommands that are declared together -> module and function that declare them."""

_AXES = re.compile(r"-[XYZxyz](,-?[XYZxyz])?")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    words = with_axes_joined(sys.argv[1:] if arguments is None else arguments)
    guarded(lambda: _run(words))


def _run(words: Sequence[str]) -> None:
    options = _parser(words).parse_args(words)
    options.command(options)


def with_axes_joined(words: Sequence[str]) -> list[str]:
    """``--front -Y`` as ``--front=-Y``: argparse takes every word that begins with a minus for an option."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in ("--up", "--front") and _AXES.fullmatch(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """A parser of the subcommand that is asked for and its like, as importing all takes seconds; else of all."""
    made = argparse.ArgumentParser(
        prog="dsffnet",
        description="3-D pose transfer: datasets, training, evaluation, and posing your own meshes.",
        epilog="From nothing to a trained and evaluated model in one go: python workflows/full.py",
    )
    commands = made.add_subparsers(required=True, metavar="COMMAND")
    asked = {names: place for names, place in _GROUPS.items() if set(words[:1]) & set(names)}
    for module, function in (asked or _GROUPS).values():
        getattr(importlib.import_module(module), function)(commands)
    return made
