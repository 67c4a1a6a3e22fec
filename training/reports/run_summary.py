"""What was run: command, commit, versions, machine, and the stages with their times, from the records in a folder."""

import importlib.metadata
import os
import re
import shlex
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter
from typing_extensions import TypedDict

from datagen.common.errors import DamagedFileError, ReportError, UnsafeFileError
from datagen.common.files import read_json, read_text_within
from training.evaluation.document import Table
from training.reports.blocks import Block, Code, Facts, Section, shown
from training.tracking.journal import read_journal
from training.tracking.progress import duration as in_units
from training.tracking.provenance import Provenance, provenance_of, this_commit, this_machine
from training.tracking.record import Record, find_records, read_record

COMMAND_TAG = "dsffnet.command"
"""The tag of a record that holds the command line, where it was noted."""

_PACKAGES = ("torch", "numpy", "scipy", "zarr", "ray", "mlflow", "anny")


def what_was_run(out: Path) -> Section:
    """Command, commit, versions, machine, and when each stage ran for how long, of whatever left its record in ``out``.

    Raises
    ------
    ReportError
        There is no record.
    """
    record = read_record(out)
    if record is None:
        raise ReportError(f"{out} holds no record.json, so nothing was run there. Name the folder of a workflow")
    body: list[Block] = [Facts(_facts(record, out)), _stages(out)]
    with suppress(FileNotFoundError):
        body.append(Code(read_text_within(out, "recipe.yaml"), folded="The whole recipe (recipe.yaml)"))
    return Section("What was run", tuple(body))


def moment(milliseconds: float) -> str:
    """A time since 1970 as people write it, in UTC."""
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(milliseconds / 1000))


def duration(seconds: float) -> str:
    """Seconds as people say them: 4.1 s, 41 s, 6 min 42 s, 3 h 5 min."""
    return f"{seconds:.1f} s" if round(seconds) < 10 else in_units(seconds)


def _facts(record: Record, out: Path) -> dict[str, str | int | float | Code]:
    command = record.tags.get(COMMAND_TAG)
    script = Path(record.tags.get("mlflow.source.name", "workflows/full.py"))
    script_name = f"{script.parent.name}/{script.name}" if script.suffix == ".py" else script.name
    packages = {name: _version(name) for name in _PACKAGES}
    noted = next(filter(None, map(provenance_of, _below(out))), Provenance())
    commit, hardware = noted.get("git_commit"), noted.get("hardware")
    facts: dict[str, str | int | float | Code] = {"name": f"{record.name} ({record.kind})"}
    if command:
        facts["command"] = Code(_shareable(command, out))
    if record.kind == "workflow":
        again = ["python", script_name, "--recipe", f"{shown(out)}/recipe.yaml", "--out", "OUT"]
        facts["the same again"] = Code(shlex.join(again))
    facts["begun"] = moment(record.started)
    facts["status"] = _status(record, out)
    facts["commit" if commit else "commit of this report"] = Code(commit or this_commit())
    facts["versions"] = ", ".join(f"{name} {version}" for name, version in packages.items() if version)
    facts["machine" if hardware else "machine of this report"] = "; ".join((hardware or this_machine()).values())
    return facts


def _status(record: Record, out: Path) -> str:
    """How it ended; of what still runs, as a workflow does while it writes its report, how its stages did."""
    status, ended = record.status.lower(), record.ended
    if record.ended is None or record.status == "RUNNING":
        stages = [stage for folder in _below(out) if (stage := read_record(folder))]
        if not stages or any(stage.ended is None or stage.status != "FINISHED" for stage in stages):
            return "still running when this report was written"
        status, ended = "stages finished", max(stage.ended or 0 for stage in stages)
    assert ended is not None
    seconds = _between(record.started, ended)
    return f"{status} {moment(ended)}" + ("" if seconds is None else f", {duration(seconds)} after it began")


def _between(began: int, ended: int) -> float | None:
    """Seconds between two times in milliseconds; None where the clock was put back meanwhile."""
    return (ended - began) / 1000 if ended >= began else None


def _shareable(command: str, out: Path) -> str:
    """A command without passwords in URLs, its absolute paths cut to what they name, so that it can be handed on."""
    named = re.sub(r"://[^/@\s]+@", "://", command.replace(str(out.resolve()), shown(out)))
    return re.sub(r"(?<![\w.:/])/(?:[^\s'\"/]+/)+([^\s'\"/]+)", r"\1", named)


def _stages(out: Path) -> Table:
    """A line for each record below ``out``, in the order of their beginnings."""
    lines = [["stage", "folder", "begun", "took", "status", "CPU %, mean", "memory GB, most", "GPU %, mean"]]
    lines += [_stage(folder, out) for folder in _below(out)]
    kept = [place for place in range(len(lines[0])) if place < 5 or any(line[place] for line in lines[1:])]
    return Table([[line[place] for place in kept] for line in lines], "Stages", _NOTES)


_NOTES = """\
*Took*: of the command that finished the stage, where that was noted, else from its first beginning to its end. Load is
the whole machine's, every five seconds, other programs included."""


def _below(out: Path) -> list[Path]:
    return [folder for folder in find_records(out) if folder != out.resolve()]


def _stage(folder: Path, out: Path) -> list[str]:
    record = read_record(folder)
    assert record is not None
    load = read_journal(folder / "system.jsonl")
    relative = Path(os.path.relpath(folder, out.resolve())).as_posix()
    status = "running" if record.ended is None else record.status.lower()
    seconds = _seconds(record, out)
    return [
        record.name,
        relative,
        moment(record.started),
        "" if seconds is None else duration(seconds),
        status,
        _load(load, "system/cpu_utilization_percentage"),
        _load(load, "system/system_memory_usage_megabytes", most=True, unit=1e3, decimals=1),
        _load(load, "system/gpu_0_utilization_percentage"),
    ]


def _load(rows: list[dict[str, Any]], key: str, *, most: bool = False, unit: float = 1.0, decimals: int = 0) -> str:
    values = [row[key] / unit for row in rows if key in row]
    if not values:
        return ""
    return f"{max(values) if most else sum(values) / len(values):.{decimals}f}"


def _seconds(record: Record, out: Path) -> float | None:
    """The time of the command that finished a stage; a mark that is older than the stage's end is an earlier one's."""
    if record.ended is None:
        return None
    mark = out / "stages" / f"{record.name}.json"
    with suppress(OSError, DamagedFileError, UnsafeFileError):
        if mark.stat().st_mtime * 1000 >= record.ended:
            return read_json(out, f"stages/{record.name}.json", _SECONDS)["seconds"]
    return _between(record.started, record.ended)


class _Seconds(TypedDict):
    seconds: Annotated[float, Field(ge=0, lt=1e12)]


_SECONDS = TypeAdapter(_Seconds)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""
