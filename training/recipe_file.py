"""Reading a training recipe from a file and words KEY=VALUE, on a machine that has only torch and pydantic."""

import json
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.errors import RecipeError, UnsafeFileError
from datagen.files import read_bounded
from training.recipe import TrainingRecipe

_LONGEST = 2**20  # bytes
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 200


def recipe_in(path: Path, words: Sequence[str] = ()) -> TrainingRecipe:
    """The training recipe in a file, with changes.

    Parameters
    ----------
    path
        JSON, or YAML where its reader is installed: a training section, or a whole recipe (as ``dsffnet recipe``
        prints it), of which the section ``training`` is taken.
    words
        ``budget=9min``, ``network.name=npt``, ``training.steps=100``: values are JSON, and text where they are not.

    Raises
    ------
    RecipeError
        It cannot be read, or some of it is no training recipe; each fault with its key.
    """
    values = _section(_read(path), path)
    for word in words:
        _set(values, word)
    try:
        return TrainingRecipe.model_validate(values)
    except ValidationError as error:
        faults = "; ".join(_described(fault) for fault in error.errors())
        raise RecipeError(f"{path} is no training recipe: {faults}") from error


def _read(path: Path) -> Any:
    try:
        text = read_bounded(path, limit=_LONGEST).decode()
        if path.suffix == ".json":
            return json.loads(text)
        import yaml
    except ImportError as error:
        raise RecipeError(f"{path} needs PyYAML, which is not installed here. Give the recipe as JSON") from error
    except (OSError, ValueError, RecursionError, UnsafeFileError) as error:
        raise RecipeError(f"{path} cannot be read as a training recipe: {_line(error)}") from error
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # a date of month 13 is a ValueError
        raise RecipeError(f"{path} cannot be read as a training recipe: {_line(error)}") from error


def _section(values: Any, path: Path) -> dict[str, Any]:
    section = values["training"] if isinstance(values, dict) and "training" in values else values
    if isinstance(section, str):
        raise RecipeError(
            f"{path} names the training recipe {section!r}, which only dsffnet resolves. Write it out: "
            f"dsffnet recipe --recipe {path} > resolved.yaml"
        )
    if not isinstance(section, dict):
        raise RecipeError(f"{path} is no training recipe: it holds {type(values).__name__}, not keys with values")
    return dict(section)


def _set(values: dict[str, Any], word: str) -> None:
    key, equals, text = word.partition("=")
    *sections, last = key.removeprefix("training.").split(".")
    if not equals or not last:
        raise RecipeError(f"{word!r} is not of the form key=value, e.g. budget=9min")
    for section in sections:
        inner = values.get(section)
        values[section] = dict(inner) if isinstance(inner, dict) else {}
        values = values[section]
    values[last] = _value(text)


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _described(fault: Any) -> str:
    key, message = ".".join(map(str, fault["loc"])), fault["msg"].removeprefix("Value error, ")
    given = "" if isinstance(fault["input"], dict) else f" (given: {_SHORT.repr(fault['input'])})"
    return f"{key}: {message}{given}" if key else f"{message}{given}"


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
