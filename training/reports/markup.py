"""Markup as HTML, by markdown-it: paragraphs, lists, headings, bold, italic, code and links; all else is text.

HTML never gets through, and a link leads to a page, never to a script.
"""

import re
from functools import cache

from markdown_it import MarkdownIt
from markdown_it.token import Token

_KNOWN = ["backticks", "emphasis", "escape", "heading", "link", "list"]
_SCHEME = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*:")


def markup_html(markup: str) -> str:
    """Markup of many lines as HTML elements; every heading is one of the third rank, below a section's."""
    tokens = _parser().parse(markup)
    for token in tokens:
        if token.type in ("heading_open", "heading_close"):
            token.tag = "h3"
    return _parser().renderer.render(tokens, _parser().options, {}).strip()


def inline_html(markup: str) -> str:
    """Markup of one line as HTML."""
    return str(_parser().renderInline(markup))


def inline_text(markup: str) -> str:
    """What a person reads of markup, without its marks: for alternative texts."""
    return "".join(_text_of(token) for token in _parser().parseInline(markup))


def _text_of(token: Token) -> str:
    return "".join(map(_text_of, token.children)) if token.children else token.content


@cache
def _parser() -> MarkdownIt:
    return _Parser("zero", {"html": False}).enable(_KNOWN)


class _Parser(MarkdownIt):
    def validateLink(self, url: str) -> bool:
        """Whether a link leads to a page, not to a script."""
        return url.lower().startswith(("http://", "https://")) or not _SCHEME.match(url)
