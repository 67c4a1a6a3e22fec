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

from datagen.errors import DamagedFileError, UnsafeFileError
from datagen.files import read_text_within
from datagen.mesh import write_atomically
from training.run_files import SET_ASIDE, set_aside, warn_once

_LONGEST = 2**29  # bytes: two million rows

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
    """Rows that :func:`write_csv` wrote.

    Raises
    ------
    DamagedFileError
        It holds other than such rows.
    UnsafeFileError
        It leads out of its folder, is not a regular file, or is far too long.
    FileNotFoundError, OSError
        It is not there, or cannot be read.
    """
    types: dict[str, Any] = {field.name: field.type for field in fields(kind)}  # type: ignore[arg-type]
    lines = io.StringIO(read_text_within(path.parent, path.name, limit=_LONGEST), newline="")
    try:
        return [
            kind(**{name: its(_as_given(line[name])) for name, its in types.items()}) for line in csv.DictReader(lines)
        ]
    except (ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise DamagedFileError(f"{path} holds other than rows of measurements ({error}). Measure again") from error


def _as_given(text: str) -> str:
    return text[1:] if text.startswith("'") and _looks_like_formula(text[1:]) else text


def kept_rows(path: Path, kind: type[RowType]) -> list[RowType]:
    """Rows of an earlier start; none where there is no file or, with a warning, where it is damaged and set aside."""
    try:
        return read_csv(path, kind)
    except FileNotFoundError:
        return []
    except (DamagedFileError, UnsafeFileError) as error:
        warn_once(f"{error}. It is kept as {path.name}{SET_ASIDE}, and what it held is measured again")
        set_aside(path)
        return []
