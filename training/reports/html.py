"""A report as one HTML file: pictures and style inside; pages that lie beside it in frames; nothing else loaded."""

import base64
import hashlib
import html
import os
import re
import struct
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from string import Template

from datagen.common.errors import ReportError
from datagen.common.files import read_within
from training.reports.blocks import Block, Code, Facts, Page, Picture, Section, Table, Text, cell_of, link_to
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

_BROAD = 900
"""Pixels from which on a picture is scrolled on a narrow screen, instead of being made too small to read."""

_LARGEST = 64 * 2**20
"""Bytes of a picture."""

_NUMBER = ' class="number"'
_SHORT = 26
"""Letters of a cell up to which a line is not broken."""

_SCRIPT = """\
const alone = !/^(file|https?):$/.test(location.protocol);
for (const frame of document.querySelectorAll("iframe[data-src]")) {
  if (alone) frame.closest("figure").classList.add("alone");
  else frame.src = frame.dataset.src;
}
document.addEventListener("click", (event) => {
  const link = alone && event.target.closest('a[href^="#"]');
  if (!link) return;
  event.preventDefault();
  document.getElementById(link.getAttribute("href").slice(1)).scrollIntoView();
});
"""
"""MLflow shows a page from memory in a locked frame: there no link leads anywhere, not even to a heading of the page
itself. So frames give way to words, and the contents list scrolls."""


def report_html(folder: Path, *, title: str, lead: str, sections: Sequence[Section]) -> str:
    """The page of a report that lies in ``folder``; ``title`` is plain text, ``lead`` markup."""
    anchors = _anchors([section.title for section in sections])
    contents = "".join(
        f'<li><a href="#{anchor}">{html.escape(section.title)}</a></li>'
        for anchor, section in zip(anchors, sections, strict=True)
    )
    bodies = [
        f'<section aria-labelledby="{anchor}"><h2 id="{anchor}">{html.escape(section.title)}</h2>\n'
        + "\n".join(_block(block, folder) for block in section.body)
        + "</section>"
        for anchor, section in zip(anchors, sections, strict=True)
    ]
    return Template(_asset("report.html")).substitute(
        title=html.escape(title),
        lead=markup_html(lead),
        contents=contents,
        body="\n".join(bodies),
        style=_asset("report.css"),
        script=_SCRIPT,
        script_hash=base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode(),
    )


def _anchors(titles: Sequence[str]) -> list[str]:
    """A name for each heading, no two alike."""
    found: list[str] = []
    for title in titles:
        name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "section"
        found.append(name if name not in found else f"{name}-{len(found) + 1}")
    return found


def _block(block: Block, folder: Path) -> str:
    match block:
        case Text(markdown):
            return markup_html(markdown)
        case Table():
            return _table(block)
        case Picture():
            return _picture(block, folder)
        case Page():
            return _page(block, folder)
        case Facts():
            return _facts(block)
        case Code(text, folded):
            return _folded(f'<pre tabindex="0"><code>{html.escape(text.strip())}</code></pre>', folded)


def _table(table: Table) -> str:
    heading, *lines = table.lines
    classes = [_class(table, place) for place in range(len(heading))]
    head = "".join(f'<th scope="col"{c}>{_unbroken(cell)}</th>' for cell, c in zip(heading, classes, strict=True))
    rows = [
        ('<tr class="first">' if begins else "<tr>")
        + "".join(_cell(cell, c, head=place == 0) for place, (cell, c) in enumerate(zip(line, classes, strict=True)))
        + "</tr>"
        for line, begins in zip(lines, _begins_group(lines), strict=True)
    ]
    label = html.escape(inline_text(table.caption) or "table")
    inside = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    caption = f"<figcaption>{inline_html(table.caption)}</figcaption>" if table.caption else ""
    notes = f'<div class="notes">{markup_html(table.notes)}</div>' if table.notes else ""
    return (
        f'<figure class="table">{caption}<div class="wide" role="region" tabindex="0" aria-label="{label}">{inside}'
        f"</div>{notes}</figure>"
    )


def _unbroken(heading: str) -> str:
    return html.escape(heading).replace(" %", "&nbsp;%")


def _class(table: Table, column: int) -> str:
    """Numbers stand at the right; short words are not broken, and long ones have room."""
    if table.numeric[column]:
        return _NUMBER
    short = all(len(line[column]) <= _SHORT for line in table.lines)
    return ' class="short"' if short else ' class="long"'


def _cell(cell: str, attributes: str, *, head: bool) -> str:
    its = cell_of(cell)
    text = html.escape(its.text)
    text = text.replace(" (", "<br>(") if attributes == _NUMBER else text  # an interval stands below its number
    text = f"<em>{text}</em>" if its.italic else text
    text = f"<strong>{text}</strong>" if its.bold else text
    return f'<th scope="row"{attributes}>{text}</th>' if head else f"<td{attributes}>{text}</td>"


def _begins_group(lines: Sequence[Sequence[str]]) -> list[bool]:
    """Of each line whether it begins a group, where lines of one group begin with the same word."""
    firsts = [cell_of(line[0]).text for line in lines]
    grouped = any(one == other for one, other in pairwise(firsts))
    return [grouped and place > 0 and first != firsts[place - 1] for place, first in enumerate(firsts)]


def _picture(picture: Picture, folder: Path) -> str:
    content, size = _embedded(picture.path, folder)
    caption = f"<figcaption>{inline_html(picture.caption)}</figcaption>" if picture.caption else ""
    text = html.escape(inline_text(picture.caption) or picture.path.stem)
    drawn = f'<img src="{content}" alt="{text}"{_size(size)}>'
    if size and size[0] >= _BROAD:
        drawn = f'<div class="wide broad" role="region" tabindex="0" aria-label="{text}">{drawn}</div>'
    return f'<figure class="picture">{drawn}{caption}</figure>'


def _size(size: tuple[int, int] | None) -> str:
    return f' width="{size[0]}" height="{size[1]}"' if size else ""


def _embedded(path: Path, folder: Path) -> tuple[str, tuple[int, int] | None]:
    """A picture inside a report's folder as a data URL, and width and height in pixels where it is a PNG."""
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
    size = struct.unpack(">II", content[16:24]) if is_png else None
    return f"data:{kind};base64,{base64.b64encode(content).decode()}", size


def _page(page: Page, folder: Path) -> str:
    link, name = link_to(page.path, folder), html.escape(page.path.name)
    label = html.escape(inline_text(page.caption) or page.path.name)
    path = html.escape(link.path)
    return (
        f'<figure class="page"><p class="open"><a href="{link.url}" target="_blank" rel="noopener">Open {name}</a> '
        f"in a window of its own: {path}, beside this report.</p>"
        f'<p class="instead">Here this report is shown without the files beside it. Choose <code>{path}</code> among '
        "the artifacts, or open the report from its folder.</p>"
        f'<iframe data-src="{link.url}" title="{label}" loading="lazy"></iframe>'
        f"<figcaption>{inline_html(page.caption)}</figcaption></figure>"
    )


def _facts(facts: Facts) -> str:
    pairs = ((html.escape(name), _value(value)) for name, value in facts.facts.items())
    return "<dl>" + "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in pairs) + "</dl>"


def _value(value: object) -> str:
    if isinstance(value, Code):
        return _folded(f"<code>{html.escape(value.text)}</code>", value.folded)
    return html.escape(str(value))


def _folded(content: str, folded: str) -> str:
    return f"<details><summary>{html.escape(folded)}</summary>{content}</details>" if folded else content


@cache
def _asset(name: str) -> str:
    return (files("training.reports") / "assets" / name).read_text(encoding="utf-8")
