"""A report as Markdown, as GitHub shows it: tables that read well as plain text, links to the pictures beside it."""

import re
from collections.abc import Sequence
from pathlib import Path

from training.reports.blocks import Block, Code, Facts, Page, Picture, Section, Table, Text, cell_of, link_to
from training.reports.markup import inline_markdown, inline_text, markup_markdown, plain


def report_markdown(folder: Path, *, title: str, lead: str, sections: Sequence[Section]) -> str:
    """The Markdown of a report that lies in ``folder``; ``title`` is plain text, ``lead`` markup."""
    parts = [f"# {inline_markdown(plain(title))}", markup_markdown(lead)]
    for section in sections:
        parts.append(f"## {inline_markdown(plain(section.title))}")
        parts += [_block(block, folder) for block in section.body]
    return "\n\n".join(part for part in parts if part) + "\n"


def _block(block: Block, folder: Path) -> str:
    match block:
        case Text(markdown):
            return markup_markdown(markdown)
        case Table():
            return _table(block)
        case Picture(path, caption):
            return _picture(path, caption, folder)
        case Page(path, caption):
            return _page(path, caption, folder)
        case Facts(facts):
            return "\n".join(f"- **{_plain(name)}**: {_value(value)}" for name, value in facts.items())
        case Code(text, folded):
            return _folded(_fenced(text.strip()), folded)


def _plain(text: object) -> str:
    return inline_markdown(plain(text))


def _table(table: Table) -> str:
    lines = [[_cell(cell) for cell in line] for line in table.lines]
    widths = [max(3, *(len(line[place]) for line in lines)) for place in range(len(lines[0]))]
    columns = list(zip(widths, table.numeric, strict=True))
    texts = [
        "| " + " | ".join(_padded(cell, *column) for cell, column in zip(line, columns, strict=True)) + " |"
        for line in lines
    ]
    rule = "|" + "|".join("-" * (width + 1) + (":" if number else "-") for width, number in columns) + "|"
    drawn = "\n".join([texts[0], rule, *texts[1:]])
    caption = f"**{_plain(inline_text(table.caption))}**" if table.caption else ""
    notes = markup_markdown(table.notes)
    return "\n\n".join(part for part in (caption, drawn, notes) if part)


def _cell(cell: str) -> str:
    its = cell_of(cell)
    return f"{its.stars}{_plain(its.text)}{its.stars}"


def _padded(cell: str, width: int, number: bool) -> str:
    return cell.rjust(width) if number else cell.ljust(width)


def _picture(path: Path, caption: str, folder: Path) -> str:
    text = _plain(inline_text(caption) or path.stem)
    drawn = f"![{text}]({link_to(path, folder).url})"
    return f"{drawn}\n\n{inline_markdown(caption)}" if caption else drawn


def _page(path: Path, caption: str, folder: Path) -> str:
    link = link_to(path, folder)
    words = f" {inline_markdown(caption)}" if caption else ""
    return f"[{_plain(link.path)}]({link.url}), to be opened in a browser.{words}"


def _value(value: object) -> str:
    if not isinstance(value, Code):
        return _plain(value)
    return "`{}`".format(" ".join(value.text.replace("`", "'").split()))


def _fenced(text: str) -> str:
    longest = max((len(run) for run in re.findall(r"`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}\n{text}\n{fence}"


def _folded(content: str, folded: str) -> str:
    if not folded:
        return content
    return f"<details><summary>{_plain(folded)}</summary>\n\n{content}\n\n</details>"
