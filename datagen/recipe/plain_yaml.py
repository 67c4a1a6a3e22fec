"""YAML as plain values: nothing is constructed, nothing is repeated by reference, and depth has a limit.

A recipe may come from anybody. Aliases are refused, as nine lines of them stand for gigabytes; so are tags of Python's
objects, keys that are not text or occur twice, and nesting that would end the interpreter's stack.
"""

import re
from typing import Any

import yaml

_FLOAT = re.compile(r"[-+]?(?:\d[\d_]*)?\.?\d*[eE][-+]?\d+")  # YAML 1.1 takes 1e-3 for text
_TEXT = "tag:yaml.org,2002:str"
_TIME = "tag:yaml.org,2002:timestamp"


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """PyYAML's safe loader, in which keys are text and unique, 1e-3 is a number and 2026-01-01 is text."""

    yaml_implicit_resolvers = {  # noqa: RUF012  # PyYAML's own attribute
        first: [(tag, pattern) for tag, pattern in resolvers if tag != _TIME]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = set()
        for key, _ in node.value:
            if key.tag != _TEXT:
                name = repr(key.value) if isinstance(key, yaml.ScalarNode) else "of several values"
                raise _fault(f"key {name} is not text, put it in quotes", key.start_mark)
            if key.value in names:
                raise _fault(f"duplicate key {key.value!r}", key.start_mark)
            names.add(key.value)
        return dict(super().construct_mapping(node, deep=deep))


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))


def load_yaml(text: str, *, deepest: int) -> Any:
    """Return the plain values of a YAML text that nests at most ``deepest`` levels.

    Raises
    ------
    ValueError
        It is not such YAML; the message says why and where, in one line.
    """
    try:
        _require_plain(text, deepest)
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise ValueError(_reason(error)) from error


def _require_plain(text: str, deepest: int) -> None:
    """Refuse aliases and deep nesting by the events of the parser, before anything is built."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.AliasEvent):
            raise _fault(f"alias *{event.anchor} is not supported, write its values out", event.start_mark)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > deepest:
            raise _fault(f"nested more than {deepest} deep", event.start_mark)


def _fault(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


def _reason(error: yaml.YAMLError) -> str:
    if not isinstance(error, yaml.MarkedYAMLError):
        return " ".join(str(error).split())
    mark = error.problem_mark
    return f"{error.problem} (line {mark.line + 1}, column {mark.column + 1})" if mark else str(error.problem)
