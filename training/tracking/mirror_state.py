"""What a record still has to send: FOLDER/mlflow.json notes, for each server, what it has been sent.

Nothing outside a record's folder is sent, whatever the record or a link in the folder names.
"""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NotRequired

from pydantic import ConfigDict, Field, TypeAdapter
from typing_extensions import TypedDict

from datagen.common.errors import UnsafeFileError
from datagen.common.files import read_json_if_whole, resolve_within, set_aside, warn_once, write_atomically
from training.tracking.journal import journal_from

NOTE = "mlflow.json"
MetricRows = list[dict[str, Any]]


class Sent(TypedDict):
    """What a server has: the run's id, offsets into journals, stamps of artifacts, and the rest of the record."""

    __pydantic_config__ = ConfigDict(strict=True)  # type: ignore[misc]

    run: str
    offsets: dict[str, Annotated[int, Field(ge=0)]]
    artifacts: dict[str, str]
    tags: NotRequired[dict[str, str]]
    metrics: NotRequired[dict[str, float]]
    dataset: NotRequired[str]
    model: NotRequired[str]
    about: NotRequired[str]
    status: NotRequired[str]


_NOTE: TypeAdapter[dict[str, Any]] = TypeAdapter(dict[str, Sent])


def read_sent(folder: Path, uri: str) -> dict[str, Any]:
    """What has been sent to a server, see :class:`Sent`; empty where nothing is noted or the note is unreadable."""
    return dict((_read_note(folder) or {}).get(uri, {}))


def note_sent(folder: Path, uri: str, sent: dict[str, Any]) -> None:
    """Note what has been sent to a server; the note is replaced whole, and an unreadable one is set aside."""
    before = _read_note(folder)
    if before is None:
        set_aside(folder / NOTE)
    write_atomically(folder / NOTE, json.dumps((before or {}) | {uri: sent}, indent=1).encode())


def unsent_rows(folder: Path, offsets: dict[str, int], *, values: int) -> Iterator[tuple[str, int, MetricRows]]:
    """Journal rows after the noted offsets: name of the journal, offset after the rows, rows of about so many values.

    A journal that is shorter than its offset was put back from elsewhere, and is read from its beginning.
    """
    for path in sorted(path for path in folder.glob("*.jsonl") if _is_own(folder, path.name)):
        offset = offsets.get(path.name, 0)
        rows: MetricRows = []
        held = 0
        for after, row in journal_from(path, offset if offset <= path.stat().st_size else 0):
            rows.append(row)
            held, offset = held + len(row), after
            if held >= values:
                yield path.name, offset, rows
                rows, held = [], 0
        if rows:
            yield path.name, offset, rows


class Artifact(NamedTuple):
    """A file to send: its ``name`` in the record's folder, the folder on the server ("" for none), and a stamp."""

    path: Path
    name: str
    place: str
    stamp: str


def unsent_artifacts(folder: Path, relatives: list[str], stamps: dict[str, str]) -> Iterator[Artifact]:
    """Files that are new or have changed. On the server each of ``relatives`` is without the folders above it.

    What a name or a link leads to outside the folder is left out, with a warning; so is what is no regular file.
    """
    for relative in (relative for relative in relatives if _is_own(folder, relative)):
        root = folder / relative
        above = os.path.dirname(os.path.relpath(root, folder))
        for path in _files_below(root) if root.is_dir() else [root]:
            name = os.path.relpath(path, folder)
            if not path.name.startswith(".") and _is_own(folder, name) and path.is_file():
                status = path.stat()
                stamp = f"{status.st_mtime_ns} {status.st_size}"
                if stamps.get(name) != stamp:
                    yield Artifact(path, name, os.path.dirname(os.path.relpath(name, above or os.curdir)), stamp)


def _files_below(root: Path) -> Iterator[Path]:
    for folder, _, names in sorted(os.walk(root)):  # it follows no links to folders
        yield from (Path(folder) / name for name in sorted(names))


def _is_own(folder: Path, name: str) -> bool:
    """Whether a name leads to somewhere inside the folder; a warning where it does not."""
    try:
        resolve_within(folder, name)
    except UnsafeFileError as error:
        warn_once(f"not sent to MLflow: {error}")
        return False
    return True


def _read_note(folder: Path) -> dict[str, Any] | None:
    return read_json_if_whole(folder, NOTE, _NOTE)
