"""What a stage tells the tracking server, kept in a folder of its own first, so that no outage loses anything.

FOLDER/record.json: name, kind, parent, parameters, dataset, status, times, artifacts, model. FOLDER/*.jsonl: metrics.
:mod:`training.tracking.mlflow_mirror` mirrors such folders to MLflow and can be repeated at any time.
"""

import getpass
import json
import os
import re
import shlex
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, TypeAdapter

from datagen.common.errors import DsffnetError
from datagen.common.files import read_json_if_whole, set_aside, write_atomically

if TYPE_CHECKING:
    from datagen.store import Dataset

Status = Literal["RUNNING", "FINISHED", "FAILED", "KILLED"]
Milliseconds = Annotated[int, Field(ge=0, lt=253_402_300_800_000)]
"""Since 1970, to the year 9999: what a date can be made of."""
FILE = "record.json"
EXPERIMENT = "dsffnet"
MODEL, ALIAS = "dsffnet", "latest-trained"
CONTENT = ("uuid", "recipe_sha256", "manifest_sha256")
"""Attributes that identify a dataset, wherever it lies."""


@dataclass(frozen=True)
class Server:
    """Where to mirror to: MLflow tracking URI, and where artifacts go if this creates the experiment (a local path).

    ``own``: nobody named the server; its store came with the folder whose records are sent, and may be a stranger's.
    """

    uri: str
    artifacts: Path | None = None
    own: bool = False


@dataclass(frozen=True)
class Record:
    """One run as MLflow will show it.

    ``parent`` leads from the record's folder up to the folder of its parent: ``..``, ``../..``; see :func:`parent_of`.
    ``artifacts`` are names of files and folders inside the record's folder.
    ``id`` is unique; servers are asked for it before a run is created, so that none is created twice.
    ``model`` is the registered name of the run's weights; it is registered again when ``model_version`` changes.
    ``model_about`` (Markdown) says of them on what they were trained and what they score.
    ``measured`` is when ``metrics`` changed, and times are in milliseconds since 1970.
    """

    __pydantic_config__: ClassVar = ConfigDict(strict=True, extra="forbid")

    name: str
    kind: str
    parent: str | None = None
    parameters: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    dataset: dict[str, str] | None = None
    artifacts: list[str] = field(default_factory=list)
    model: str | None = None
    model_version: str = ""
    model_about: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    measured: Milliseconds | None = None
    status: Status = "RUNNING"
    started: Milliseconds = 0
    ended: Milliseconds | None = None
    id: Annotated[str, Field(pattern=r"^[0-9A-Za-z-]{0,64}$")] = ""


_RECORD: TypeAdapter[Record] = TypeAdapter(Record)


def read_record(folder: Path) -> Record | None:
    """The record of a folder; None where there is none or, with a warning, an unreadable one."""
    return read_json_if_whole(folder, FILE, _RECORD)


def has_record(folder: Path) -> bool:
    """Whether a folder holds a readable record."""
    return read_record(folder) is not None


_SURROGATE = re.compile("[\ud800-\udfff]")  # of a path that is not UTF-8, which a record must be: spelled out


def write_record(folder: Path, record: Record) -> None:
    """Write a record; it appears whole or not at all."""
    text = json.dumps(asdict(record), indent=1, ensure_ascii=False)
    write_atomically(folder / FILE, _SURROGATE.sub(lambda half: f"\\\\u{ord(half[0]):x}", text).encode())


def begin_record(folder: Path, *, name: str, kind: str, parent: Path | None, parameters: dict[str, str]) -> Record:
    """Begin a record, or resume the one that is there (its start time and its id stay).

    An unreadable one is set aside. ``parent`` is kept where it holds ``folder``; a record elsewhere stands alone.
    """
    before = read_record(folder)
    if before is None:
        set_aside(folder / FILE)
    record = Record(
        name=name,
        kind=kind,
        parent=_way_up(folder, parent) if parent else None,
        parameters=parameters,
        tags=_tags() if parent else _tags() | {"dsffnet.command": _command()},
        started=before.started if before else _now(),
        id=before.id if before else uuid.uuid4().hex,
    )
    with _changing:
        write_record(folder, record)
        _begun.add(folder)
        _failed.discard(folder)
    return record


def update_record(folder: Path, **changes: Any) -> None:
    """Change fields of the record that is there; other ``metrics`` are marked as measured now."""
    with _changing:
        record = read_record(folder)
        assert record is not None, f"{folder} has no record to update"
        measured = _now() if changes.get("metrics", record.metrics) != record.metrics else record.measured
        write_record(folder, replace(record, **{"measured": measured, **changes}))


def end_record(folder: Path, status: Status) -> None:
    """Mark a record as ended now; one of :func:`fail_begun` stays as that left it."""
    with _changing:
        _begun.discard(folder)
        if folder not in _failed:
            update_record(folder, status=status, ended=_now())


_changing = threading.RLock()  # as a thread may call fail_begun
_begun: set[Path] = set()
"""Folders whose records this process has begun and not ended."""
_failed: set[Path] = set()
"""Folders whose records :func:`fail_begun` has ended."""


def fail_begun() -> None:
    """Mark all records as FAILED that this process has begun and not ended: it may be ended at any moment now.

    Those that were removed, or cannot be written, are passed over.
    """
    with _changing:
        while _begun:
            folder = _begun.pop()
            with suppress(OSError, DsffnetError):
                if has_record(folder):
                    update_record(folder, status="FAILED", ended=_now())
                    _failed.add(folder)


def parent_of(folder: Path, record: Record) -> Path | None:
    """The folder of a record's parent: one that holds the record's own; None where it names none or another."""
    steps = PurePosixPath(record.parent or "").parts
    above = Path(os.path.realpath(folder)).parents
    if set(steps) != {".."} or len(steps) > len(above):
        return None
    between = above[: len(steps) - 1]  # trials/NAME and RUN/evaluation lie so; a stranger's run in a folder of ours not
    return above[len(steps) - 1] if all(each.name == "trials" or (each / FILE).is_file() for each in between) else None


def find_records(root: Path) -> list[Path]:
    """Folders below ``root`` that hold a record, and those of their parents, parents first."""
    records = {folder.resolve(): read_record(folder) for folder in _with_records(root)}
    for folder, record in list(records.items()):
        parent = parent_of(folder, record) if record else None
        if parent and parent not in records and (above := read_record(parent)):
            records[parent] = above
    return sorted(records, key=lambda folder: _rank(records[folder]))


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


def _rank(record: Record | None) -> tuple[bool, int]:
    """Parents before children, and by their starts."""
    return (record is not None and record.parent is not None, record.started if record else 0)


def _way_up(folder: Path, parent: Path) -> str | None:
    try:
        below = Path(os.path.realpath(folder)).relative_to(os.path.realpath(parent))
    except ValueError:
        return None
    return "/".join([".."] * len(below.parts)) or None


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


def about_dataset(dataset: "Dataset") -> dict[str, str]:
    """What a record says of a dataset, wherever that lies: name, URL, and what identifies its content."""
    return {"name": Path(dataset.url).name, "url": dataset.url} | {key: dataset.attributes[key] for key in CONTENT}
