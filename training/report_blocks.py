"""What reports are made of. They hold content alone; HTML and Markdown are written from the same blocks.

Where a field is said to be *markup*, the little Markdown of :mod:`training.report_inline` is understood in it, and
words of users go through :func:`~training.report_inline.plain` first. All else is shown character for character.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.errors import DsffnetError

_ONE = r"[-+±~<>≤≥x]?\s?\d[\d,]*\.?\d*(?:e[-+]?\d+)?(?:\s?(?:%|°|[A-Za-zµ]{1,3}))?"
_NUMBER = re.compile(rf"{_ONE}(?:\s?[/±]\s?{_ONE})*")
_NONE = {"", "-", "--", "–", "—", "nan", "n/a"}


class ReportError(DsffnetError):
    """A report that asks for something that is not there."""


@dataclass(frozen=True)
class Text:
    """Paragraphs, lists and small headings: markup."""

    markdown: str


@dataclass(frozen=True)
class Table:
    """Cells of plain text, the first line being the heading; ``**12.3**`` is bold. Caption and notes are markup.

    Columns of numbers are set to the right. See :func:`with_best` for marking the best values.
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
        return [_is_numeric([bare(cell) for cell in column]) for column in columns]


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


def bare(cell: str) -> str:
    """A cell without the marks of a bold one."""
    return cell[2:-2] if is_marked(cell) else cell


def is_marked(cell: str) -> bool:
    """Whether a cell is bold as a whole."""
    return len(cell) > 4 and cell.startswith("**") and cell.endswith("**")


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
                    marked[place + 1][column] = f"**{bare(marked[place + 1][column])}**"
    return marked


def _groups(lines: Sequence[Sequence[str]], column: int | None) -> list[list[int]]:
    found: dict[str, list[int]] = {}
    for place, line in enumerate(lines):
        found.setdefault("" if column is None else line[column], []).append(place)
    return list(found.values())


def _value(cell: str) -> float | None:
    try:
        return float(bare(cell).replace(",", ""))
    except ValueError:
        return None


def _is_numeric(cells: Sequence[str]) -> bool:
    stated = [cell.strip() for cell in cells if cell.strip().lower() not in _NONE]
    return bool(stated) and all(_NUMBER.fullmatch(cell) for cell in stated)
