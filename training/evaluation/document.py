"""Tables and paragraphs as values, and their Markdown: what evaluations, sweeps and studies write.

*Markup* is the Markdown that reports know: paragraphs, lists, headings, bold, italic, code, links. Words of users go
into it through :func:`plain`. Cells and titles are plain text, shown character for character.
"""

import math
import re
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace

from datagen.common.printable import printable

_SPECIAL = re.compile(r"[\\`*\[\]<>|~$#&]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")
_ONE = r"[-+±~<>≤≥x]?\s?(?:\d[\d,]*\.?\d*|\.\d+)(?:e[-+]?\d+)?(?:\s?(?:%|°|[A-Za-zµ]{1,3}))?"
_NUMBER = re.compile(rf"{_ONE}(?:\s?(?:[/±]|to)\s?{_ONE})*(?:\s\({_ONE}(?:\s?to\s?{_ONE})?\))?")
_NONE = {"", "-", "--", "–", "—", "nan", "n/a"}


@dataclass(frozen=True)
class Text:
    """Paragraphs, lists and small headings: markup."""

    markdown: str


@dataclass(frozen=True)
class Cell:
    """What a table's cell shows: plain text, and whether it is bold (the best) or in italics (a paper's own number)."""

    text: str
    bold: bool = False
    italic: bool = False


Line = Sequence[str | Cell]


@dataclass(frozen=True)
class Table:
    """Cells in lines, the first line being the heading. Caption and notes are markup.

    Columns of numbers are set to the right. :func:`with_best` marks the best values.

    Raises
    ------
    ValueError
        A line has more or fewer cells than the heading.
    """

    lines: Sequence[Line]
    caption: str = ""
    notes: str = ""

    def __post_init__(self) -> None:
        for number, line in enumerate(self.lines):
            if len(line) != len(self.lines[0]):
                raise ValueError(
                    f"table {self.caption!r}: line {number} has {len(line)} cells, its heading {len(self.lines[0])}"
                )

    @property
    def cells(self) -> list[list[Cell]]:
        """All cells, those of plain text too."""
        return [[cell_of(cell) for cell in line] for line in self.lines]

    @property
    def numeric(self) -> list[bool]:
        """Of each column whether it holds numbers and nothing else (of blanks: no)."""
        columns = list(zip(*self.cells[1:], strict=True)) or [()] * len(self.lines[0])
        return [_is_numeric([cell.text for cell in column]) for column in columns]


def cell_of(cell: str | Cell) -> Cell:
    """Return a cell of a table as a :class:`Cell`."""
    return cell if isinstance(cell, Cell) else Cell(cell)


def with_best(
    lines: Sequence[Line],
    *,
    columns: Sequence[int],
    group: int | Callable[[Line], Hashable | None] | None = None,
) -> list[list[Cell]]:
    """Return a table's lines with the lowest number of each of some columns in bold, equal ones alike.

    Cells that hold no number are left alone, as are groups in which all numbers are equal.

    Parameters
    ----------
    group
        The best are searched among lines of one group: those with the same value in this column (such as seen and
        unseen poses), or for which this function returns the same; a line for which it returns None takes no part.
    """
    key = group if callable(group) else lambda line: "" if group is None else cell_of(line[group]).text
    marked = [[cell_of(cell) for cell in line] for line in lines]
    groups: dict[Hashable, list[list[Cell]]] = {}
    for line in marked[1:]:
        groups.setdefault(key(line), []).append(line)
    for members in (members for name, members in groups.items() if name is not None):
        for column in columns:
            _mark_best(members, column)
    return marked


def _mark_best(lines: Sequence[list[Cell]], column: int) -> None:
    values = [_value(line[column].text) for line in lines]
    numbers = {value for value in values if value is not None}
    for line, value in zip(lines, values, strict=True):
        if len(numbers) > 1 and value == min(numbers):
            line[column] = replace(line[column], bold=True)


def _value(text: str) -> float | None:
    try:
        value = float(text.replace(",", ""))
    except ValueError:
        return None
    return None if math.isnan(value) else value


def _is_numeric(texts: Sequence[str]) -> bool:
    stated = [text.strip() for text in texts if text.strip().lower() not in _NONE]
    return bool(stated) and all(_NUMBER.fullmatch(text) for text in stated)


def plain(text: object) -> str:
    """Return any text as markup that shows it as it is, on one line."""
    return _SPECIAL.sub(lambda found: f"\\{found[0]}", printable(" ".join(str(text).split())))


def markdown(markup: str) -> str:
    """Return markup as the Markdown of a file: the same, but with HTML made harmless outside code."""
    pieces = re.split(r"(`[^`]+`)", markup.strip())
    return "".join(piece if place % 2 else _harmless(piece) for place, piece in enumerate(pieces))


def plain_markdown(text: object) -> str:
    """Return any text as the Markdown of a file that shows it as it is."""
    return markdown(plain(text))


def _harmless(markup: str) -> str:
    """Without HTML: < and & as entities; > stays where it is, for alone it does nothing."""
    return re.sub(r"\\?([<&])", lambda found: {"<": "&lt;", "&": "&amp;"}[found[1]], markup)


def table_markdown(table: Table) -> str:
    """Return the cells as a Markdown table, aligned so that it also reads well as plain text."""
    lines = [[_cell_markdown(cell) for cell in line] for line in table.cells]
    widths = [max(3, *(len(line[place]) for line in lines)) for place in range(len(lines[0]))]
    columns = list(zip(widths, table.numeric, strict=True))
    texts = [
        f"| {' | '.join(_padded(cell, *column) for cell, column in zip(line, columns, strict=True))} |"
        for line in lines
    ]
    rule = "|" + "|".join("-" * (width + 1) + (":" if number else "-") for width, number in columns) + "|"
    return "\n".join([texts[0], rule, *texts[1:]])


def _cell_markdown(cell: Cell) -> str:
    stars = "*" * (2 * cell.bold + cell.italic) if cell.text else ""
    return f"{stars}{plain_markdown(cell.text)}{stars}"


def _padded(cell: str, width: int, number: bool) -> str:
    return cell.rjust(width) if number else cell.ljust(width)


def document_markdown(title: str, parts: Sequence[Text | Table]) -> str:
    """Return a Markdown document: a title (plain text), and under it texts and tables, a caption being a heading."""
    return "\n\n".join(filter(None, [f"# {plain_markdown(title)}", *map(_part_markdown, parts)])) + "\n"


def _part_markdown(part: Text | Table) -> str:
    if isinstance(part, Text):
        return markdown(part.markdown)
    heading = f"## {markdown(part.caption)}" if part.caption else ""
    return "\n\n".join(filter(None, (heading, table_markdown(part), markdown(part.notes))))
