"""What a stage tells the tracking server, kept in a folder of its own first, so that no outage loses anything.

FOLDER/record.json: name, kind, parent, parameters, dataset, status, times, artifacts, model. FOLDER/*.jsonl: metrics.
:mod:`training.tracking` mirrors such folders to MLflow and can be repeated at any time.
"""

import getpass
import json
import os
import re
import shlex
import sys
import time
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from datagen.mesh import write_atomically

Status = Literal["RUNNING", "FINISHED", "FAILED", "KILLED"]
FILE = "record.json"
EXPERIMENT = "dsffnet"
MODEL, ALIAS = "dsffnet", "latest-trained"


@dataclass(frozen=True)
class Server:
    """Where to mirror to: MLflow tracking URI, and where artifacts go if this creates the experiment (a local path)."""

    uri: str
    artifacts: Path | None = None


@dataclass(frozen=True)
class Record:
    """One run as MLflow will show it. ``parent`` and ``artifacts`` are paths relative to the record's folder.

    ``id`` is unique; servers are asked for it before a run is created, so that none is created twice.
    ``model`` is the registered name of the run's weights; it is registered again when ``model_version`` changes.
    ``measured`` is when ``metrics`` changed, and times are in milliseconds since 1970.
    """

    name: str
    kind: str
    parent: str | None = None
    parameters: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    dataset: dict[str, str] | None = None
    artifacts: list[str] = field(default_factory=list)
    model: str | None = None
    model_version: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    measured: int | None = None
    status: Status = "RUNNING"
    started: int = 0
    ended: int | None = None
    id: str = ""


def read_record(folder: Path) -> Record | None:
    """The record of a folder, None where there is none."""
    path = folder / FILE
    return Record(**json.loads(path.read_text())) if path.exists() else None


def write_record(folder: Path, record: Record) -> None:
    """Write a record; it appears whole or not at all."""
    write_atomically(folder / FILE, json.dumps(asdict(record), indent=1).encode())


def begin_record(folder: Path, *, name: str, kind: str, parent: Path | None, parameters: dict[str, str]) -> Record:
    """Begin a record, or go on with the one that is there (its start time and its id stay)."""
    before = read_record(folder)
    record = Record(
        name=name,
        kind=kind,
        parent=os.path.relpath(parent, folder) if parent else None,
        parameters=parameters,
        tags=_tags() if parent else _tags() | {"dsffnet.command": _command()},
        started=before.started if before else _now(),
        id=(before.id if before else "") or uuid.uuid4().hex,
    )
    write_record(folder, record)
    return record


def update_record(folder: Path, **changes: Any) -> None:
    """Change fields of the record that is there; other ``metrics`` are marked as measured now."""
    record = read_record(folder)
    assert record is not None, f"{folder} has no record to update"
    measured = _now() if changes.get("metrics", record.metrics) != record.metrics else record.measured
    write_record(folder, replace(record, **{"measured": measured, **changes}))


def end_record(folder: Path, status: Status) -> None:
    """Mark a record as ended now."""
    update_record(folder, status=status, ended=_now())


def find_records(root: Path) -> list[Path]:
    """Folders below ``root`` that hold a record, and those of their parents, parents first."""
    found = {folder.resolve() for folder in _with_records(root)}
    for folder in list(found):
        record = read_record(folder)
        if record and record.parent and read_record((folder / record.parent).resolve()):
            found.add((folder / record.parent).resolve())
    return sorted(found, key=lambda folder: (_has_parent(folder), _start_of(folder)))


def _with_records(root: Path) -> Iterator[Path]:
    """Folders below ``root`` that hold a record; not those of many files and no record, such as a dataset's."""
    for folder, below, files in os.walk(root):
        below[:] = [name for name in below if name not in ("checkpoints", "mlartifacts") and not name.endswith(".zarr")]
        if FILE in files:
            yield Path(folder)


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested recipe -> dotted parameters, as MLflow shows them."""
    flat: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = str(value)
    return flat


def _has_parent(folder: Path) -> bool:
    record = read_record(folder)
    return record is not None and record.parent is not None


def _start_of(folder: Path) -> int:
    record = read_record(folder)
    return record.started if record else 0


def _tags() -> dict[str, str]:
    return {"mlflow.user": _user(), "mlflow.source.name": sys.argv[0], "mlflow.source.type": "LOCAL"}


def _command() -> str:
    """The command line, without passwords in URLs: it is shown to whoever sees the server."""
    program, *words = sys.argv
    start = ["python", program] if program.endswith(".py") else [Path(program).name]
    return re.sub(r"://[^/@\s]+@", "://", shlex.join([*start, *words]))


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):  # a container's user without a name
        return "unknown"


def _now() -> int:
    return int(time.time() * 1000)
