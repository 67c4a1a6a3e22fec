r"""The little Markdown of reports: paragraphs, ``- `` and ``1. `` lists, headings, bold, italic, code, links.

Everything else is text. HTML never gets through; a backslash before punctuation makes it text, see :func:`plain`.
"""

import html
import re
from collections.abc import Iterable
from typing import Literal

from datagen.common.printable import printable
from training.reports.blocks import Block, Table, Text

_PUNCTUATION = r"!-/:-@\[-`{-~"
_TOKEN = re.compile(
    rf"\\(?P<escaped>[{_PUNCTUATION}])"
    r"|`(?P<code>[^`]+)`"
    r"|\*\*(?P<bold>(?:\\.|[^\\])+?)\*\*"
    r"|\*(?P<italic>[^*\s](?:[^*]*[^*\s])?)\*"
    r"|\[(?P<text>(?:\\.|[^\]\\])+)\]\((?P<link>[^()\s]+)\)"
)
_SPECIAL = re.compile(r"[\\`*\[\]<>|~$#&]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")
_SCHEME = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*:")
_ITEM = re.compile(r"\s{0,3}(?P<mark>[-*]|\d+[.)])\s+(?P<text>.*)")
_HEADING = re.compile(r"#{1,6}\s+(?P<text>.*)")
_RULE = re.compile(r"[|:\s-]+")
_CELLS = re.compile(r"(?<!\\)\|")

Kind = Literal["heading", "paragraph", "ul", "ol"]


def plain(text: object) -> str:
    """Any text as markup that shows it as it is, on one line."""
    return _SPECIAL.sub(lambda found: f"\\{found[0]}", printable(" ".join(str(text).split())))


def inline_html(markup: str) -> str:
    """Markup of one line as HTML."""
    parts, end = [], 0
    for token in _TOKEN.finditer(markup):
        parts += [html.escape(markup[end : token.start()]), _token_html(token)]
        end = token.end()
    return "".join([*parts, html.escape(markup[end:])])


def inline_text(markup: str) -> str:
    """What a person reads of markup, without its marks: for alternative texts."""
    return html.unescape(re.sub(r"<[^>]+>", "", inline_html(markup)))


def inline_markdown(markup: str) -> str:
    """Markup as the Markdown that a report's file holds: the same, but with HTML made harmless outside code."""
    pieces = re.split(r"(`[^`]+`)", markup)
    return "".join(piece if place % 2 else _harmless(piece) for place, piece in enumerate(pieces))


def markup_html(markup: str) -> str:
    """Markup of many lines as HTML elements."""
    return "\n".join(_element(kind, texts) for kind, texts in _elements(markup.splitlines()))


def markup_markdown(markup: str) -> str:
    """Markup of many lines as Markdown."""
    return inline_markdown(markup.strip())


def document_blocks(document: str) -> tuple[Block, ...]:
    """The tables and the text of a Markdown document that this program wrote, such as tables.md, without its title."""
    found: list[Block] = []
    gathered: list[str] = []
    in_table = False
    for line in [*document.strip().splitlines(), ""]:
        if line.startswith("|") != in_table:
            found += _block(gathered, in_table)
            gathered, in_table = [], not in_table
        if not line.startswith("# "):
            gathered.append(line)
    return (*found, *_block(gathered, in_table))


def _block(lines: list[str], is_table: bool) -> Iterable[Block]:
    if is_table:
        cells = [[_cell(cell) for cell in _CELLS.split(line.strip())[1:-1]] for line in lines]
        return [Table([line for place, line in enumerate(cells) if place != 1 or not _is_rule(line)])]
    text = "\n".join(lines).strip()
    return [Text(text)] if text else []


def _cell(text: str) -> str:
    return re.sub(rf"\\([{_PUNCTUATION}])", r"\1", text.strip())


def _is_rule(cells: list[str]) -> bool:
    return all(_RULE.fullmatch(cell) for cell in cells)


def _harmless(markdown: str) -> str:
    """Without HTML: < and & as entities; > stays where it is, for alone it does nothing."""
    return re.sub(r"\\?([<&])", lambda found: {"<": "&lt;", "&": "&amp;"}[found[1]], markdown)


def _token_html(token: "re.Match[str]") -> str:
    kind, text = token.lastgroup, token[token.lastgroup or 0]
    if kind == "escaped":
        return html.escape(text)
    if kind == "code":
        return f"<code>{html.escape(text)}</code>"
    if kind == "link":
        inside = inline_html(token["text"])
        return f'<a href="{html.escape(text)}">{inside}</a>' if _is_safe(text) else inside
    element = "strong" if kind == "bold" else "em"
    return f"<{element}>{inline_html(text)}</{element}>"


def _is_safe(link: str) -> bool:
    """Whether a link leads to a page, not to a script."""
    return link.lower().startswith(("http://", "https://")) or not _SCHEME.match(link)


def _elements(lines: Iterable[str]) -> list[tuple[Kind, list[str]]]:
    """Headings, paragraphs and lists with the text of each item; other lines go on with what stands before them."""
    found: list[tuple[Kind, list[str]]] = []
    goes_on = False
    for line in lines:
        kind, text = _begins(line) or ("paragraph", line.strip())
        if goes_on and text and kind == "paragraph":
            found[-1][1][-1] += f" {text}"
        elif goes_on and kind in ("ul", "ol") and kind == found[-1][0]:
            found[-1][1].append(text)
        elif text:
            found.append((kind, [text]))
        goes_on = bool(text) and kind != "heading"
    return found


def _begins(line: str) -> tuple[Kind, str] | None:
    """The kind and text of a line that begins something by its mark."""
    heading, item = _HEADING.fullmatch(line), _ITEM.fullmatch(line)
    if heading:
        return "heading", heading["text"]
    if item:
        return ("ul" if item["mark"] in "-*" else "ol"), item["text"]
    return None


def _element(kind: Kind, texts: list[str]) -> str:
    if kind in ("ul", "ol"):
        return f"<{kind}>" + "".join(f"<li>{inline_html(text)}</li>" for text in texts) + f"</{kind}>"
    element = "h3" if kind == "heading" else "p"
    return f"<{element}>{inline_html(texts[0])}</{element}>"
