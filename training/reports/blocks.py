"""What reports are made of. They hold content alone; HTML and Markdown are written from the same blocks.

Where a field is said to be *markup*, the little Markdown of :mod:`training.reports.markup` is understood in it, and
words of users go through :func:`~training.reports.markup.plain` first. All else is shown character for character.
"""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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


_ONE = r"[-+±~<>≤≥x]?\s?(?:\d[\d,]*\.?\d*|\.\d+)(?:e[-+]?\d+)?(?:\s?(?:%|°|[A-Za-zµ]{1,3}))?"
_NUMBER = re.compile(rf"{_ONE}(?:\s?(?:[/±]|to)\s?{_ONE})*(?:\s\({_ONE}(?:\s?to\s?{_ONE})?\))?")
_MARKED = re.compile(r"(?P<stars>\*{1,3})(?P<text>[^*\s](?:[^*]*[^*\s])?)(?P=stars)")
_NONE = {"", "-", "--", "–", "—", "nan", "n/a"}


@dataclass(frozen=True)
class Text:
    """Paragraphs, lists and small headings: markup."""

    markdown: str


@dataclass(frozen=True)
class Table:
    """Cells of plain text, the first line being the heading; ``**12.3**`` is bold, ``*12.3*`` in italics.

    Caption and notes are markup. Columns of numbers are set to the right. :func:`with_best` marks the best values.
    """

    lines: Sequence[Sequence[str]]
    caption: str = ""
    notes: str = ""

    def __post_init__(self) -> None:
        for number, line in enumerate(self.lines):
            if len(line) != len(self.lines[0]):
                raise ValueError(
                    f"table {self.caption!r}: line {number} has {len(line)} cells, its heading {len(self.lines[0])}"
                )

    @property
    def numeric(self) -> list[bool]:
        """Of each column whether it holds numbers and nothing else (of blanks: no)."""
        columns = list(zip(*self.lines[1:], strict=True)) or [()] * len(self.lines[0])
        return [_is_numeric([cell_of(cell).text for cell in column]) for column in columns]


@dataclass(frozen=True)
class Picture:
    """An image file, with a caption (markup) that is also what a reader who cannot see it is told."""

    path: Path
    caption: str = ""


@dataclass(frozen=True)
class Page:
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


Block = Text | Table | Picture | Page | Facts | Code


@dataclass(frozen=True)
class Section:
    """A heading (plain text) and what stands under it."""

    title: str
    body: tuple[Block, ...]


@dataclass(frozen=True)
class Cell:
    """What a table's cell shows: its text, and whether it is bold (the best) or in italics (a paper's own number)."""

    text: str
    bold: bool = False
    italic: bool = False

    @property
    def stars(self) -> str:
        """The marks before and behind it."""
        return "*" * (2 * self.bold + self.italic)


def cell_of(cell: str) -> Cell:
    """A cell with the marks taken off that stand around the whole of it."""
    found = _MARKED.fullmatch(cell)
    if not found:
        return Cell(cell)
    stars = len(found["stars"])
    return Cell(found["text"], bold=stars > 1, italic=stars != 2)


def with_best(
    lines: Sequence[Sequence[str]], *, columns: Sequence[int], group: int | None = None, highest: bool = False
) -> list[list[str]]:
    """A table's lines with the lowest (or highest) number of each of some columns in bold, equal ones alike.

    ``group``: a column of whose every value the best are looked for apart, such as seen and unseen poses.
    Cells that are no number, and groups of one line, are left alone.
    """
    marked = [list(line) for line in lines]
    for members in _groups(marked[1:], group):
        for column in columns:
            values = {place: value for place in members if (value := _value(marked[place + 1][column])) is not None}
            if len(values) > 1:
                best = max(values.values()) if highest else min(values.values())
                for place in (place for place, value in values.items() if value == best):
                    marked[place + 1][column] = _bold(marked[place + 1][column])
    return marked


def _groups(lines: Sequence[Sequence[str]], column: int | None) -> list[list[int]]:
    found: dict[str, list[int]] = {}
    for place, line in enumerate(lines):
        found.setdefault("" if column is None else line[column], []).append(place)
    return list(found.values())


def _bold(cell: str) -> str:
    stars = replace(cell_of(cell), bold=True).stars
    return f"{stars}{cell_of(cell).text}{stars}"


def _value(cell: str) -> float | None:
    try:
        return float(cell_of(cell).text.replace(",", ""))
    except ValueError:
        return None


def _is_numeric(cells: Sequence[str]) -> bool:
    stated = [cell.strip() for cell in cells if cell.strip().lower() not in _NONE]
    return bool(stated) and all(_NUMBER.fullmatch(cell) for cell in stated)
