"""Tables as Markdown, HTML and CSV, from lines of text cells of which the first is the heading.

In every column less is better. A line with a cell that begins with `THEIRS` holds numbers of a paper; those and ours
are told apart by how they look, and the best of a column is looked for in each of the two alone.
"""

import csv as csv_module
import io
import re
from collections.abc import Sequence
from html import escape

import numpy as np

from training.report_blocks import cell_of
from training.report_inline import plain
from training.row_files import inert

Lines = list[list[str]]

THEIRS = "paper"
"""What the cell begins with that marks a line as a paper's own numbers."""

STYLE = """\
table.results {border-collapse: collapse; margin: 1.5em 0}
table.results {font: 14px/1.4 system-ui, sans-serif; font-variant-numeric: tabular-nums}
table.results caption {caption-side: top; text-align: left; font-weight: 600; padding: 0 0 .5em}
table.results th, table.results td {padding: .25em .8em; text-align: right; white-space: nowrap; font-weight: 400}
table.results th[scope=row], table.results .words {text-align: left}
table.results thead th {border-bottom: 1.5px solid #333; font-weight: 600}
table.results tbody tr {border-bottom: 1px solid #e4e4e4}
table.results tr.theirs {color: #767676; font-style: italic}
table.results strong {font-weight: 700}
"""
"""A page's style sheet for :func:`html`."""

_NUMBER = re.compile(r"\d[\d,]*(\.\d+)?")
_BEGINS_AS_NUMBER = re.compile(r"[+-]?\d[\d,.]*( |$)")
_NO_OP = "unchanged"


def markdown(lines: Lines) -> str:
    """A Markdown table, aligned so that it also reads well as plain text."""
    lines = [[_safe(cell) for cell in line] for line in lines]
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    left = {0, 1}
    texts = [
        "| "
        + " | ".join(c.ljust(w) if i in left else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        + " |"
        for line in lines
    ]
    rule = "|" + "|".join("-" * (w + 2) if i in left else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join([texts[0], rule, *texts[1:]])


def _safe(cell: str) -> str:
    """A cell whose text, within the marks around the whole of it, is no Markdown."""
    its = cell_of(cell)
    return f"{its.stars}{plain(its.text)}{its.stars}"


def emphasised(lines: Lines) -> Lines:
    """The same for :func:`markdown`, with the best of each column bold and a paper's lines in italics."""
    best = _best(lines)
    return [lines[0], *([_marked(lines, row, place, best) for place in range(len(lines[0]))] for row in _rows(lines))]


def html(lines: Lines, *, caption: str = "") -> str:
    """An HTML table (a fragment, see `STYLE`): the best of each column in <strong>, a paper's lines grey italics."""
    heading = "".join(f'<th scope="col"{_words(lines, i)}>{escape(cell)}</th>' for i, cell in enumerate(lines[0]))
    best = _best(lines)
    body = "\n".join(_html_line(lines, row, best) for row in _rows(lines))
    title = f"<caption>{escape(caption)}</caption>\n" if caption else ""
    return (
        f'<table class="results">\n{title}<thead>\n<tr>{heading}</tr>\n</thead>\n<tbody>\n{body}\n</tbody>\n</table>\n'
    )


def csv(lines: Lines) -> str:
    """The cells as CSV, as they are printed."""
    text = io.StringIO()
    csv_module.writer(text, lineterminator="\n").writerows([inert(cell) for cell in line] for line in lines)
    return text.getvalue()


def is_theirs(line: Sequence[str]) -> bool:
    """Whether a line holds a paper's own numbers."""
    return any(cell.startswith(THEIRS) for cell in line)


def _rows(lines: Lines) -> range:
    return range(1, len(lines))


def _marked(lines: Lines, row: int, place: int, best: set[tuple[int, int]]) -> str:
    cell = lines[row][place]
    mark = "*" * ((row, place) in best) * 2 + "*" * is_theirs(lines[row])
    return f"{mark}{cell}{mark}" if cell else cell


def _html_line(lines: Lines, row: int, best: set[tuple[int, int]]) -> str:
    cells = [f"<strong>{escape(c)}</strong>" if (row, i) in best else escape(c) for i, c in enumerate(lines[row])]
    others = "".join(f"<td{_words(lines, i)}>{cell}</td>" for i, cell in enumerate(cells) if i)
    kind = ' class="theirs"' if is_theirs(lines[row]) else ""
    return f'<tr{kind}><th scope="row">{cells[0]}</th>{others}</tr>'


def _words(lines: Lines, place: int) -> str:
    """Columns of words, unlike those of numbers, begin at the left."""
    is_words = not any(_BEGINS_AS_NUMBER.match(lines[row][place]) for row in _rows(lines))
    return ' class="words"' if is_words else ""


def _best(lines: Lines) -> set[tuple[int, int]]:
    """(row, column) of the lowest numbers of each column, ours and theirs apart, poses apart, no-ops left out.

    A column in which all are equal has no best.
    """
    found: set[tuple[int, int]] = set()
    for group in _groups(lines):
        for place in range(1, len(lines[0])):
            numbers = np.array([_number(lines[row][place]) for row in group])
            if len(np.unique(numbers[np.isfinite(numbers)])) > 1:
                found |= {(group[at], place) for at in np.flatnonzero(numbers == np.nanmin(numbers)).tolist()}
    return found


def _groups(lines: Lines) -> list[list[int]]:
    groups: dict[tuple[bool, str], list[int]] = {}
    for row in _rows(lines):
        if not any(cell.endswith(_NO_OP) for cell in lines[row]):
            of = lines[row][0] if lines[0][0] == "poses" else ""
            groups.setdefault((is_theirs(lines[row]), of), []).append(row)
    return list(groups.values())


def _number(cell: str) -> float:
    return float(cell.replace(",", "")) if _NUMBER.fullmatch(cell) else float("nan")
