"""Let the site read the cross-references of docstrings (``:class:`~package.module.Name```)."""

import re
from xml.sax.saxutils import quoteattr

from markdown import Extension, Markdown
from markdown.preprocessors import Preprocessor
from mkdocs.config.defaults import MkDocsConfig

_ROLE = re.compile(r":(?:mod|func|class|meth|data|attr|exc):`(~?)([\w.]+)`")


class _Roles(Preprocessor):
    def run(self, lines: list[str]) -> list[str]:
        return [_ROLE.sub(_reference, line) for line in lines]


class _RolesExtension(Extension):
    def extendMarkdown(self, md: Markdown) -> None:
        md.preprocessors.register(_Roles(md), "roles", 26)


def _reference(match: re.Match[str]) -> str:
    short, name = match.groups()
    shown = name.rpartition(".")[2] if short else name
    return f"<autoref identifier={quoteattr(name)} optional><code>{shown}</code></autoref>"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the extension to those of every page."""
    config.markdown_extensions.append(_RolesExtension())  # type: ignore[arg-type]
    return config
