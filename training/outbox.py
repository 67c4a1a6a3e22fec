"""What a record still has to send: FOLDER/mlflow.json notes, for each server, what it has been sent."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from datagen.mesh import write_atomically
from training.journal import journal_from

NOTE = "mlflow.json"
MetricRows = list[dict[str, Any]]


def read_sent(folder: Path, uri: str) -> dict[str, Any]:
    """What has been sent to a server: the run's id, offsets into journals, stamps of artifacts, and so on."""
    return dict(_read_note(folder).get(uri, {}))


def note_sent(folder: Path, uri: str, sent: dict[str, Any]) -> None:
    """Note what has been sent to a server; the note is replaced whole."""
    write_atomically(folder / NOTE, json.dumps(_read_note(folder) | {uri: sent}, indent=1).encode())


def unsent_rows(folder: Path, offsets: dict[str, int], *, values: int) -> Iterator[tuple[str, int, MetricRows]]:
    """Journal rows behind the noted offsets: name of the journal, offset behind the rows, rows of about so many values.

    A journal that is shorter than its offset was put back from elsewhere, and is read from its beginning.
    """
    for path in sorted(folder.glob("*.jsonl")):
        offset = offsets.get(path.name, 0)
        rows: MetricRows = []
        held = 0
        for behind, row in journal_from(path, offset if offset <= path.stat().st_size else 0):
            rows.append(row)
            held, offset = held + len(row), behind
            if held >= values:
                yield path.name, offset, rows
                rows, held = [], 0
        if rows:
            yield path.name, offset, rows


def unsent_artifacts(folder: Path, relatives: list[str], stamps: dict[str, str]) -> Iterator[tuple[Path, str, str]]:
    """Files that are new or have changed: path, name in the record's folder, stamp of its looks."""
    for relative in relatives:
        root = folder / relative
        for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
            if path.is_file() and not path.name.startswith("."):
                name, status = os.path.relpath(path, folder), path.stat()
                stamp = f"{status.st_mtime_ns} {status.st_size}"
                if stamps.get(name) != stamp:
                    yield path, name, stamp


def _read_note(folder: Path) -> dict[str, Any]:
    path = folder / NOTE
    return dict(json.loads(path.read_text())) if path.exists() else {}
