"""Rows of a frozen dataclass of texts, whole numbers and numbers, as CSV and back.

A spreadsheet takes a text that begins with ``=``, ``+``, ``-`` or ``@`` for a formula, and runs it. Such texts are
written with an apostrophe before them, which :func:`read_csv` takes off.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

from datagen.mesh import write_atomically

RowType = TypeVar("RowType")

_FORMULA = tuple("=+-@\t\n\r＝＋－＠'")


def inert(value: Any) -> Any:
    """A cell as a CSV file holds it: a number as it is, a text such that no spreadsheet runs it."""
    if not isinstance(value, str) or _is_number(value):
        return value
    return f"'{value}" if _looks_like_formula(value) else value


def _looks_like_formula(text: str) -> bool:
    return text.startswith(_FORMULA) and text.strip("-") != ""  # dashes alone stand for no value


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", ""))
        return True
    except ValueError:
        return False


def write_csv(rows: Sequence[Any], path: Path, kind: type[Any]) -> None:
    """Write rows of a dataclass; the file appears whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(kind)])
    writer.writeheader()
    writer.writerows({name: inert(value) for name, value in asdict(row).items()} for row in rows)
    write_atomically(path, text.getvalue().encode(errors="backslashreplace"))


def read_csv(path: Path, kind: type[RowType]) -> list[RowType]:
    """Rows that :func:`write_csv` wrote."""
    types: dict[str, Any] = {field.name: field.type for field in fields(kind)}  # type: ignore[arg-type]
    with open(path, encoding="utf-8", newline="") as file:
        return [
            kind(**{name: its(_as_given(line[name])) for name, its in types.items()}) for line in csv.DictReader(file)
        ]


def _as_given(text: str) -> str:
    return text[1:] if text.startswith("'") and _looks_like_formula(text[1:]) else text
