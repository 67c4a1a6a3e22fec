"""What reports are made of. They hold content alone; HTML and Markdown are written from the same blocks.

Where a field is said to be *markup*, the Markdown of :mod:`training.evaluation.document` is understood in it, and words
of users go through :func:`~training.evaluation.document.plain` first. All else is shown character for character.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from training.evaluation.document import Table, Text


@dataclass(frozen=True)
class Picture:
    """An image file, with a caption (markup) that is also what a reader who cannot see it is told."""

    path: Path
    caption: str = ""


@dataclass(frozen=True)
class EmbeddedPage:
    """A page of its own, such as the viewer: linked, and in the HTML shown in a frame. The caption is markup."""

    path: Path
    caption: str = ""


@dataclass(frozen=True)
class Code:
    """Text as a terminal or a file has it; ``folded`` is the line that stands for it until it is opened."""

    text: str
    folded: str = ""


@dataclass(frozen=True)
class Facts:
    """Names and what is to be said of each; a value that is :class:`Code` is shown as such."""

    facts: Mapping[str, str | int | float | Code]


Block = Text | Table | Picture | EmbeddedPage | Facts | Code


@dataclass(frozen=True)
class Section:
    """A heading (plain text) and what stands under it."""

    title: str
    body: tuple[Block, ...]


@dataclass(frozen=True)
class Link:
    """A file as seen from a report's folder: its path for people, and as a URL in a link."""

    path: str
    url: str


def link_to(path: Path, folder: Path) -> Link:
    """The link from a report in ``folder`` to a file."""
    relative = Path(os.path.relpath(path, folder)).as_posix()
    return Link(relative, quote(os.fsencode(relative)))


def shown(path: Path) -> str:
    """A path as a report names it: below the working folder as it is, elsewhere by its last part alone.

    So a report tells nothing of the machine that it was written on, and can be handed on.
    """
    try:
        return path.resolve().relative_to(Path.cwd().resolve()).as_posix()
    except ValueError:
        return path.name
