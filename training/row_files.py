"""Rows of a frozen dataclass of texts, whole numbers and numbers, as CSV and back."""

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

from datagen.mesh import write_atomically

RowType = TypeVar("RowType")


def write_csv(rows: Sequence[Any], path: Path, kind: type[Any]) -> None:
    """Write rows of a dataclass; the file appears whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(kind)])
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    write_atomically(path, text.getvalue().encode())


def read_csv(path: Path, kind: type[RowType]) -> list[RowType]:
    """Rows that :func:`write_csv` wrote."""
    types: dict[str, Any] = {field.name: field.type for field in fields(kind)}  # type: ignore[arg-type]
    with open(path, encoding="utf-8", newline="") as file:
        return [kind(**{name: its(line[name]) for name, its in types.items()}) for line in csv.DictReader(file)]
