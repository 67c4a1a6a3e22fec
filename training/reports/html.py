"""A report as one HTML file: pictures and style inside; pages that lie beside it in frames; nothing else loaded.

What the page looks like is in ``assets/report.html``, a template that escapes every text that is no markup.
"""

import base64
import hashlib
import os
import re
import struct
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from datagen.common.errors import ReportError
from datagen.common.files import read_within
from training.evaluation.document import Cell, Table
from training.reports.blocks import Picture, Section, link_to
from training.reports.markup import inline_html, inline_text, markup_html

KINDS = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".gif": "image/gif",
    ".svg": "image/svg+xml",
    ".webp": "image/webp",
}
"""Picture formats that every browser shows."""

_LARGEST = 64 * 2**20
"""Bytes of a picture."""

_SHORT = 26
"""Letters of a cell up to which a line is not broken."""


def report_html(folder: Path, *, title: str, lead: str, sections: Sequence[Section]) -> str:
    """The page of a report that lies in ``folder``; ``title`` is plain text, ``lead`` markup.

    Raises
    ------
    ReportError
        A picture is missing or of a format that browsers do not show.
    """
    return (
        _templates()
        .get_template("report.html")
        .render(
            title=title,
            lead=lead,
            sections=list(zip(_anchors([section.title for section in sections]), sections, strict=True)),
            picture=lambda block: _picture(block, folder),
            link=lambda block: link_to(block.path, folder),
        )
    )


@cache
def _templates() -> Environment:
    loader = PackageLoader("training.reports", "assets")
    made = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    style, script = (Markup(loader.get_source(made, name)[0]) for name in ("report.css", "report.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    made.globals |= {"style": style, "script": script, "script_hash": digest, "table": _table}
    made.filters |= {
        "markup": lambda text: Markup(markup_html(text)),
        "inline": lambda text: Markup(inline_html(text)),
        "words": inline_text,
    }
    made.tests |= {"kind": lambda block, name: type(block).__name__ == name}
    return made


def _anchors(titles: Sequence[str]) -> list[str]:
    """A name for each heading, no two alike."""
    found: list[str] = []
    for title in titles:
        name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "section"
        found.append(name if name not in found else f"{name}-{len(found) + 1}")
    return found


def _table(table: Table) -> dict[str, Any]:
    """The cells of a table, the class of each column, and of each line whether it begins a group."""
    heading, *lines = table.cells
    classes = [
        "number" if numeric else "short" if all(len(cell.text) <= _SHORT for cell in column) else "long"
        for numeric, column in zip(table.numeric, zip(*table.cells, strict=True), strict=True)
    ]  # numbers stand at the right; short words are not broken, and long ones have room
    return {"heading": heading, "lines": list(zip(_begins_group(lines), lines, strict=True)), "classes": classes}


def _begins_group(lines: Sequence[Sequence[Cell]]) -> list[bool]:
    """Of each line whether it begins a group, where lines of one group begin with the same word."""
    firsts = [line[0].text for line in lines]
    grouped = any(one == other for one, other in pairwise(firsts))
    return [grouped and place > 0 and first != firsts[place - 1] for place, first in enumerate(firsts)]


def _picture(picture: Picture, folder: Path) -> dict[str, Any]:
    """A picture inside a report's folder as a data URL, and width and height in pixels where it is a PNG."""
    path = picture.path
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        raise ReportError(f"{path} is no picture that a report can show; formats are {', '.join(KINDS)}")
    try:
        content = read_within(folder, os.path.relpath(path, folder), limit=_LARGEST)
    except OSError as error:
        raise ReportError(
            f"the report wants picture {path}, which cannot be read ({error.strerror}). Run the stage that draws it"
        ) from error
    is_png = kind == "image/png" and len(content) >= 24
    width, height = struct.unpack(">II", content[16:24]) if is_png else (None, None)
    return {"url": f"data:{kind};base64,{base64.b64encode(content).decode()}", "width": width, "height": height}
