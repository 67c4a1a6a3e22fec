"""Recipes as text: files of limited size and depth, and words ``section.key=value`` that change what is in them.

Nothing in a recipe stands for anything else: no interpolation, no aliases. Somebody else's recipe could copy the
environment of whoever runs it into a dataset and its attributes otherwise.
"""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.common.errors import RecipeError, UnsafeFileError, reason_of
from datagen.common.files import read_bounded
from datagen.common.printable import nearest
from datagen.recipe.plain_yaml import load_yaml

_LONGEST = 1_000_000
"""Bytes of a file; a sweep of a thousand trials has a tenth of them."""
DEEPEST = 32
"""Levels of nesting; the deepest recipe of ours has six."""
_WIDEST = 80
"""Characters of a value that an error message shows."""

_FAULTS = 5
_Place = tuple[str | int, ...]
_SURROGATE = re.compile("[\ud800-\udfff]")

Words = Sequence[tuple[str, Any]]
"""Dotted keys and the values that they get, in order."""
Variant = tuple[str, str, Any]
"""A section of which there are several kinds, the key that says which, and which it is where that key is missing."""


def read_values(path: Path) -> Any:
    """Return what a file holds, JSON by its ending ``.json``, else YAML, as plain values.

    Raises
    ------
    RecipeError
        It cannot be read, is too long, is not text of that form, or holds an interpolation.
    """
    try:
        content = read_bounded(path, limit=_LONGEST)
        text = _decoded(content)
        values = _parse_json(text) if path.suffix == ".json" else load_yaml(text, deepest=DEEPEST)
    except UnsafeFileError as error:
        raise RecipeError(str(error)) from error
    except OSError as error:
        raise RecipeError(f"{path} cannot be read: {reason_of(error)}") from error
    except ValueError as error:
        raise RecipeError(f"{path} cannot be read: {_cut(str(error))}") from error
    require_plain(values, where=str(path))
    return values


def parse_words(words: Iterable[str], *, option: str = "") -> Words:
    """Return the dotted key and the value of each word ``section.key=value``; values are YAML.

    Parameters
    ----------
    words
        As a person writes them.
    option
        Named in errors, with a space after it, e.g. ``"--set "``.

    Raises
    ------
    RecipeError
        A word is not of that form, its value cannot be read, or holds an interpolation.
    """
    return [_parse_word(word, option) for word in words]


def changed(values: dict[str, Any], words: Words, *, kinds: Sequence[Variant] = ()) -> dict[str, Any]:
    """Return nested values with the values of dotted keys set in them, mappings merged into mappings.

    A section of another kind than before keeps none of its other keys: they would not fit it.

    Raises
    ------
    RecipeError
        A key leads through a value that is no section, or counts an entry that a list does not have.
    """
    wanted: Any = {}
    for key, value in words:
        wanted = _set(wanted, key, value)
    result: Any = values
    for section, kind, default in kinds:
        chosen = _at(wanted, f"{section}.{kind}", None)
        if chosen is not None and chosen != _at(result, f"{section}.{kind}", default):
            result = _replaced(result, section.split("."), lambda _: {}, key=section)
    for key, value in words:
        result = _set(result, key, value)
    return dict(result)


def require_plain(values: Any, *, where: str) -> None:
    """Refuse nested values that hold more than plain text and numbers can mean.

    Raises
    ------
    RecipeError
        A text holds ``${``, a NUL or what is not UTF-8, or something is nested too deep.
    """
    waiting: list[tuple[_Place, Any]] = [((), values)]
    while waiting:
        place, value = waiting.pop()
        if len(place) > DEEPEST:
            raise RecipeError(f"{where}: {_dotted(place)} is nested more than {DEEPEST} deep")
        if isinstance(value, str) and (fault := _fault_of(value)):
            raise RecipeError(f"{where}: {_dotted(place)}: {fault} (given: {shown(value)})")
        entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        waiting += [((*place, name), inner) for name, inner in entries]


def _dotted(place: _Place) -> str:
    return _cut(".".join(map(str, place)))


def _fault_of(text: str) -> str:
    """What a text holds that no value of a recipe may, or nothing."""
    if "${" in text:
        return "interpolation is not supported"
    if "\0" in text:
        return "a NUL is not supported"
    return "" if text.isascii() or not _SURROGATE.search(text) else "not UTF-8 text"


def faults_text(error: ValidationError, describe: "Callable[[Any], str] | None" = None) -> str:
    """Return what is wrong in a failed validation, in one line: its first faults, as ``describe`` words each."""
    faults = error.errors()
    words = [(describe or fault_text)(fault) for fault in faults[:_FAULTS]]
    return "; ".join([*words, *([f"and {len(faults) - _FAULTS:,} more faults"] if len(faults) > _FAULTS else [])])


def fault_text(fault: Any, *, key: str | None = None) -> str:
    """Return one fault in words: the key, what is wrong, and the value that was given."""
    key = _cut(".".join(map(str, fault["loc"]))) if key is None else key
    if fault["type"] == "union_tag_invalid":
        return _unknown_kind(fault, key)
    message = _cut(fault["msg"].removeprefix("Value error, "), 5 * _WIDEST)
    # of a whole section that does not fit together, the message names the keys
    given = "" if isinstance(fault["input"], dict) else f" (given: {shown(fault['input'])})"
    return f"{key}: {message}{given}" if key else f"{message}{given}"


def _unknown_kind(fault: Any, section: str) -> str:
    """That a section (a body, a network, poses) is of a kind that there is not; the key that names it is said."""
    name, known = (fault["ctx"][each].replace("'", "") for each in ("discriminator", "expected_tags"))
    given = fault["input"].get(name) if isinstance(fault["input"], dict) else fault["ctx"]["tag"]
    near = nearest(given, known.split(", ")) if isinstance(given, str) else ""
    return f"{'.'.join(filter(None, (section, name)))}: {shown(given)} is none of {known}{near}"


def shown(value: Any) -> str:
    """Return a value as a message shows it, however long it is."""
    try:
        return _cut(repr(value))
    except ValueError:  # Python writes no integer of more than 4,300 digits
        return f"a number of {value.bit_length():,} bits" if isinstance(value, int) else type(value).__name__


def _cut(text: str, widest: int = _WIDEST) -> str:
    return text if len(text) <= 2 * widest else f"{text[:widest]} ... ({len(text):,} characters)"


def _decoded(content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 text (byte {content[error.start]:#04x} at {error.start:,})") from error


def _parse_json(text: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except RecursionError as error:
        raise ValueError("nested too deep") from error


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"duplicate key {next(name for name in names if names.count(name) > 1)!r}")
    return values


def _parse_word(word: str, option: str) -> tuple[str, Any]:
    key, equals, text = word.partition("=")
    if not equals or not all(key.split(".")):
        raise RecipeError(f"{option}{shown(word)} is not of the form section.key=value, e.g. training.steps=100")
    if not text.strip():
        raise RecipeError(f"{option}{shown(word)} has no value after =; write {key}=null where it is to have none")
    where = option.strip() or "override"
    require_plain({key: text}, where=where)
    try:
        value = load_yaml(text, deepest=DEEPEST)
    except ValueError as error:
        raise RecipeError(f"{option}{shown(word)} cannot be read: {_cut(str(error))}") from error
    require_plain({key: value}, where=where)
    return key, value


def _set(values: Any, key: str, value: Any) -> Any:
    return _replaced(values, key.split("."), lambda old: _merged(old, value), key=key)


def _replaced(values: Any, path: list[str], change: Callable[[Any], Any], *, key: str) -> Any:
    """The same with ``change`` made of what is at a path; sections on the way are made where there are none."""
    if not path:
        return change(values)
    if len(path) > _WIDEST:
        raise RecipeError(f"key {shown(key)} has too many parts")
    first, *rest = path
    if isinstance(values, list):
        if not (first.isdecimal() and len(first) < 10 and int(first) < len(values)):
            raise RecipeError(f"key {shown(key)}: there is no entry {shown(first)} in a list of {len(values)}")
        return [_replaced(it, rest, change, key=key) if i == int(first) else it for i, it in enumerate(values)]
    if not (values is None or isinstance(values, dict)):
        raise RecipeError(f"key {shown(key)} leads through a value that is no section: {shown(values)}")
    section = values or {}
    return {**section, first: _replaced(section.get(first), rest, change, key=key)}


def _merged(old: Any, new: Any) -> Any:
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    return {**old, **{key: _merged(old.get(key), value) for key, value in new.items()}}


def _at(values: Any, key: str, default: Any) -> Any:
    for part in key.split("."):
        values = values.get(part) if isinstance(values, dict) else None
    return default if values is None else values
