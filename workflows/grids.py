"""Grids of varied values as a person writes them, ``training.key=A,B,...``, and short names for their cells."""

import re
from collections.abc import Iterable

from datagen.errors import RecipeError

_OPENING, _CLOSING = "[{(", "]})"


def parse_grid(vary: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Keys and their values from words ``training.key=VALUE,VALUE,...``; commas within brackets part no values.

    Raises
    ------
    RecipeError
        A word is not of that form, names no value, or a key that another word varies too.
    """
    grid: dict[str, tuple[str, ...]] = {}
    for word in vary:
        key, sign, text = word.partition("=")
        if not (key and sign):
            raise RecipeError(f"--vary {word!r} is not of the form training.key=VALUE,VALUE,...")
        values = split_values(text)
        if not all(values):
            raise RecipeError(f"--vary {word!r} has an empty value. Write e.g. --vary {key}=A,B")
        if key in grid:
            raise RecipeError(f"--vary names {key!r} twice. Write all its values in one word: {key}=A,B,C")
        grid[key] = values
    return grid


def split_values(text: str) -> tuple[str, ...]:
    """Values between the commas that no bracket encloses."""
    values, depth = [""], 0
    for letter in text:
        depth += (letter in _OPENING) - (letter in _CLOSING)
        if letter == "," and depth == 0:
            values.append("")
        else:
            values[-1] += letter
    return tuple(value.strip() for value in values)


def short_names(keys: list[str]) -> list[str]:
    """The last parts of dotted keys, as many as it takes to tell them apart."""
    parts = [key.split(".") for key in keys]

    def short(own: list[str], length: int) -> str:
        return ".".join(own[-length:])

    longest = max(map(len, parts), default=0)
    found = []
    for own in parts:
        alike = (n for n in range(1, longest + 1) if sum(short(other, n) == short(own, n) for other in parts) == 1)
        found.append(short(own, next(alike, longest)))
    return found


def in_a_name(value: str) -> str:
    """A value with what a folder's name cannot hold replaced by dashes."""
    return re.sub(r"[^A-Za-z0-9._+-]+", "-", value).strip("-") or "-"
