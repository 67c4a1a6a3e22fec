"""Relative links from a report to the files beside it."""

import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote


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
