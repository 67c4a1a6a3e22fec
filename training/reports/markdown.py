"""A report as Markdown, as GitHub shows it: tables that read well as plain text, links to the pictures beside it."""

import re
from collections.abc import Sequence
from pathlib import Path

from training.evaluation.document import Table, Text, markdown, plain_markdown, table_markdown
from training.reports.blocks import Block, Code, EmbeddedPage, Facts, Picture, Section, link_to
from training.reports.markup import inline_text


def report_markdown(folder: Path, *, title: str, lead: str, sections: Sequence[Section]) -> str:
    """The Markdown of a report that lies in ``folder``; ``title`` is plain text, ``lead`` markup."""
    parts = [f"# {plain_markdown(title)}", markdown(lead)]
    for section in sections:
        parts.append(f"## {plain_markdown(section.title)}")
        parts += [_block(block, folder) for block in section.body]
    return _joined(*parts) + "\n"


def _joined(*parts: str) -> str:
    return "\n\n".join(part for part in parts if part)


def _block(block: Block, folder: Path) -> str:
    match block:
        case Text():
            return markdown(block.markdown)
        case Table():
            caption = f"**{_words(block.caption)}**" if block.caption else ""
            return _joined(caption, table_markdown(block), markdown(block.notes))
        case Picture():
            drawn = f"![{_words(block.caption) or plain_markdown(block.path.stem)}]({link_to(block.path, folder).url})"
            return _joined(drawn, markdown(block.caption))
        case EmbeddedPage():
            link = link_to(block.path, folder)
            opened = f"[{plain_markdown(link.path)}]({link.url}), to be opened in a browser."
            return f"{opened} {markdown(block.caption)}".strip()
        case Facts():
            return "\n".join(f"- **{plain_markdown(name)}**: {_value(value)}" for name, value in block.facts.items())
        case Code():
            return _code(block)


def _words(caption: str) -> str:
    return plain_markdown(inline_text(caption))


def _value(value: object) -> str:
    if not isinstance(value, Code):
        return plain_markdown(value)
    return "`{}`".format(" ".join(value.text.replace("`", "'").split()))


def _code(code: Code) -> str:
    """Fenced by more backticks than stand in it."""
    text = code.text.strip()
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall(r"`+", text)), default=0))
    fenced = f"{fence}\n{text}\n{fence}"
    if not code.folded:
        return fenced
    return f"<details><summary>{plain_markdown(code.folded)}</summary>\n\n{fenced}\n\n</details>"
