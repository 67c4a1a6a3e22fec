"""A run that was downloaded, or that a power failure left: no file of it does more than end in one line."""

import hashlib
import io
import json
import os
import pickle
import resource
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from datagen.common.errors import CheckpointError, DsffnetError, UnsafeFileError
from tests.support.recipes import tiny_training
from training.checkpoints.checkpoint import load_checkpoint, require_checkpoint, save_checkpoint
from training.checkpoints.folder import manifest_of, write_manifest
from training.engine.launch import failure_of
from training.engine.trainer import train
from training.evaluation import generalisation, robustness
from training.evaluation.results import kept_rows, read_rows
from training.inference.domain_check import seen_by
from training.inference.predict import load_trained
from training.recipes.files import recipe_in
from training.reports.run_summary import what_was_run
from training.tracking.journal import Journal, read_journal
from training.tracking.mirror_state import read_sent, unsent_artifacts, unsent_rows
from training.tracking.provenance import provenance_of
from training.tracking.record import begin_record, find_records, read_record, update_record
from workflows.studies.mesh_kinds import own_recipe

STEP = "checkpoints/step-00000008"
FILES: dict[str, tuple[str, ...]] = {
    "record.json": ("records", "what was run", "begin again"),
    "mlflow.json": ("outbox",),
    "latest": ("newest",),
    "best": ("best",),
    "provenance.json": ("provenance", "seen", "own recipe", "what was run"),
    "failure.json": ("failure",),
    "metrics.jsonl": ("journal", "rows to send", "append"),
    "system.jsonl": ("rows to send", "what was run"),
    "recipe.yaml": ("recipe", "what was run", "files to send"),
    "rows.csv": ("rows", "files to send"),
    "stages/train.json": ("what was run",),
    f"{STEP}/manifest.json": ("newest", "best", "by step", "weights", "network"),
    f"{STEP}/weights.safetensors": ("newest", "by step", "weights", "network", "files to send"),
    f"{STEP}/state.pt": ("newest", "by step", "state"),
}
"""Where something is put -> who reads it."""
DEEP = b'{"step": ' + b"[" * 5000 + b"]" * 5000 + b"}\n"
CONTENTS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "null": lambda path: path.write_bytes(b"null\n"),
    "a list": lambda path: path.write_bytes(b"[1, 2]\n"),
    "text": lambda path: path.write_bytes(b'"../../../secret"\n'),
    "no UTF-8": lambda path: path.write_bytes(b'{"name": "\xff\xfe"}\n'),
    "zeros": lambda path: path.write_bytes(bytes(5000)),
    "wrong types": lambda path: path.write_bytes(
        b'{"step": "x", "name": 3, "kind": null, "seen": [1], "dataset": 5, "sha256": [], "message": {}, "x": {}}\n'
    ),
    "unknown keys": lambda path: path.write_bytes(b'{"name": "a", "kind": "b", "step": 1, "\xc3\xbc": 1}\n'),
    "numbers beyond measure": lambda path: path.write_bytes(
        b'{"step": 1' + b"0" * 4000 + b', "time": 1e300, "seconds": 1e300, "started": 1e300}\n'
    ),
    "deep": lambda path: path.write_bytes(DEEP),
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a link out": lambda path: path.symlink_to(path.parents[len(path.parents) - 1] / "etc/hostname"),
}
READERS: dict[str, Callable[[Path], object]] = {
    "records": lambda run: [read_record(folder) for folder in find_records(run)],
    "outbox": lambda run: read_sent(run, "uri"),
    "rows to send": lambda run: list(unsent_rows(run, {}, values=10)),
    "files to send": lambda run: list(unsent_artifacts(run, [*FILES, "checkpoints"], {})),
    "newest": lambda run: require_checkpoint(run).weights(),
    "best": lambda run: load_checkpoint(run, "best"),
    "by step": lambda run: load_checkpoint(run, 8),
    "state": lambda run: require_checkpoint(run / STEP).state(),
    "network": load_trained,
    "weights": lambda run: require_checkpoint(run / STEP / "weights.safetensors"),
    "provenance": provenance_of,
    "seen": seen_by,
    "own recipe": own_recipe,
    "journal": lambda run: read_journal(run / "metrics.jsonl"),
    "append": lambda run: Journal(run / "metrics.jsonl").close(),
    "failure": failure_of,
    "rows": lambda run: read_rows(run / "rows.csv"),
    "recipe": lambda run: recipe_in(run / "recipe.yaml"),
    "what was run": what_was_run,
    "begin again": lambda run: begin_record(run, name="train", kind="train", parent=None, parameters={}),
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, _pristine: Path) -> Path:
    run = tmp_path_factory.mktemp("trained") / "run"
    begin_record(run, name="train", kind="train", parent=None, parameters={})
    train(tiny_training(), data=str(_pristine), run=run)
    (run / "stages").mkdir()
    return run


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    (tmp_path / "secret").write_text("secret")
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.fixture(autouse=True)
def _bounded_memory() -> Iterator[None]:
    """Two gigabytes more than now: what reads a device for ever ends in a MemoryError."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 2 * 2**30, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def put(path: Path, content: str) -> None:
    path.parent.mkdir(exist_ok=True)
    if path.is_dir():
        path.rmdir()
    path.unlink(missing_ok=True)
    CONTENTS[content](path)


@pytest.mark.parametrize("name", FILES)
def test_whatever_lies_in_the_place_of_a_file_every_reader_ends_in_one_line(run: Path, name: str) -> None:
    for content in CONTENTS:
        put(run / name, content)
        for reader in FILES[name]:
            try:
                READERS[reader](run)
            except (DsffnetError, OSError) as error:
                assert "\n" not in str(error) and len(str(error)) < 1000, (content, reader)


@pytest.mark.parametrize("content", CONTENTS)
def test_an_unreadable_record_is_reported_set_aside_and_made_again(
    run: Path, content: str, caplog: pytest.LogCaptureFixture
) -> None:
    put(run / "record.json", content)
    for _ in range(3):
        assert read_record(run) is None
    begin_record(run, name="train", kind="train", parent=None, parameters={})
    update_record(run, status="FINISHED")
    record = read_record(run)
    assert record is not None and record.status == "FINISHED" and os.path.lexists(run / "record.json.unreadable")
    assert len(caplog.messages) == (content != "a link to nothing"), caplog.messages
    assert all("record.json" in line and "made again" in line for line in caplog.messages)


@pytest.mark.parametrize("content", CONTENTS)
@pytest.mark.parametrize("name", ["latest", "best"])
def test_latest_and_best_are_derived_from_the_checkpoints(run: Path, dataset: str, name: str, content: str) -> None:
    put(run / name, content)
    assert require_checkpoint(run).step == 8 and require_checkpoint(run, "best").best


@pytest.mark.parametrize("name", ["../../../secret", "/etc/hostname", "step-00000008/../../../secret", "step-x", "."])
def test_the_best_is_no_path_but_a_checkpoint(run: Path, name: str) -> None:
    best = require_checkpoint(run, "best").path
    (run / "best").write_text(name)
    assert require_checkpoint(run, "best").path == best


@pytest.mark.parametrize("linked", ["checkpoints", STEP, f"{STEP}/weights.safetensors", f"{STEP}/state.pt"])
def test_checkpoints_elsewhere_are_neither_read_nor_removed(run: Path, trained: Path, linked: str) -> None:
    path, before = run / linked, sorted(trained.rglob("*"))
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    path.symlink_to(trained / linked)
    with pytest.raises((UnsafeFileError, CheckpointError), match=r"link that leads out of it|no such|No such"):
        require_checkpoint(run, 8)
    try:
        state, about = {}, {"step": 9, "recipe": {}, "dataset": ""}
        save_checkpoint(run, about=about, weights={"w": torch.ones(1)}, state=state, keep=1)
    except DsffnetError:
        pass
    assert sorted(trained.rglob("*")) == before


def resealed(folder: Path, **changes: Any) -> Path:
    """Change a checkpoint's manifest as somebody does who knows how it is sealed."""
    write_manifest(folder, {k: v for k, v in manifest_of(folder).items() if k != "manifest_sha256"} | changes)
    return folder


def nested(depth: int) -> dict[str, Any]:
    value: dict[str, Any] = {}
    for _ in range(depth):
        value = {"a": value}
    return value


@pytest.mark.parametrize(
    "changes",
    [
        {"step": "x"}, {"step": -1}, {"step": 10**30}, {"step": True}, {"recipe": []}, {"dataset": 5},
        {"versions": {"torch": 2}}, {"best": "yes"}, {"finished": 1}, {"last_step": [8]}, {"recipe": nested(250)},
        {"sha256": {"../../../secret": hashlib.sha256(b"secret").hexdigest()}}, {"sha256": {"/dev/zero": ""}},
        {"sha256": {"weights.safetensors": 5}}, {"sha256": None},
    ],
    ids=lambda changes: json.dumps(changes)[:40],
)  # fmt: skip
def test_a_manifest_of_other_types_or_names_is_damage(run: Path, changes: dict[str, Any]) -> None:
    folder = resealed(run / STEP, **changes)
    with pytest.raises(CheckpointError, match=r"step-00000008 is damaged or missing \(.*manifest.json") as error:
        require_checkpoint(folder)
    assert "\n" not in str(error.value) and require_checkpoint(run).step == 4, "the one before it serves"


def test_a_recipe_nested_5000_deep_is_one_line(run: Path) -> None:
    path, nest = run / STEP / "manifest.json", "[" * 5000 + "]" * 5000
    path.write_text(path.read_text().replace('"recipe": {', f'"recipe": {{"a": {nest},', 1))
    with pytest.raises(CheckpointError, match="recursion limit"):
        require_checkpoint(run / STEP)


class _Malice:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ("touch executed",)


def pickled(value: object) -> bytes:
    content = io.BytesIO()
    torch.save(value, content)
    return content.getvalue()


def bomb() -> bytes:
    """Some kilobytes that unpack to 16 megabytes."""
    content, plain = io.BytesIO(), zipfile.ZipFile(io.BytesIO(pickled({"a": torch.zeros(2)})))
    with plain, zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry in plain.infolist():
            archive.writestr(entry.filename, bytes(2**24) if "/data/" in entry.filename else plain.read(entry))
    return content.getvalue()


STATES: dict[str, Callable[[dict[str, Any]], bytes]] = {
    "empty": lambda state: b"",
    "garbage": lambda state: b"PK\x03\x04" + bytes(100),
    "cut": lambda state: pickled(state)[:1000],
    "a plain pickle": lambda state: pickle.dumps(_Malice()),
    "code": lambda state: pickled({**state, "verdict": _Malice()}),
    "a bomb": lambda state: bomb(),
    "a list": lambda state: pickled([1, 2]),
    "other keys": lambda state: pickled({"a": 1}),
    "no optimiser": lambda state: pickled({**state, "optimiser": None}),
    "moments of other shapes": lambda state: pickled(with_moments(state, torch.zeros(3))),
    "moments that are no tensors": lambda state: pickled(with_moments(state, "x")),
    "a text for a step": lambda state: pickled({**state, "schedule": {"step": "x"}}),
    "a list for a schedule": lambda state: pickled({**state, "schedule": ["step"]}),
    "a text for a verdict": lambda state: pickled({**state, "verdict": {"best": "x"}}),
    "no verdict": lambda state: pickled({**state, "verdict": None}),
    "random states of another kind": lambda state: pickled({**state, "random": [{"cpu": torch.zeros(3)}]}),
    "no random states": lambda state: pickled({**state, "random": [None]}),
}


def with_moments(state: dict[str, Any], value: object) -> dict[str, Any]:
    moments = {place: {**its, "exp_avg": value} for place, its in state["optimiser"]["state"].items()}
    return {**state, "optimiser": {**state["optimiser"], "state": moments}}


def with_state(run: Path, changed: Callable[[dict[str, Any]], bytes]) -> None:
    """Leave of a run its checkpoint of step 4, with another state under a seal that is right."""
    shutil.rmtree(run / STEP)
    folder = require_checkpoint(run).path
    content = changed(require_checkpoint(run).state())
    (folder / "state.pt").write_bytes(content)
    resealed(folder, sha256=manifest_of(folder)["sha256"] | {"state.pt": hashlib.sha256(content).hexdigest()})


def test_a_state_as_training_wrote_it_is_gone_on_from(run: Path, trained: Path, dataset: str) -> None:
    with_state(run, pickled)
    assert train(tiny_training(), data=dataset, run=run) == 8
    assert (run / STEP / "weights.safetensors").read_bytes() == (trained / STEP / "weights.safetensors").read_bytes()


@pytest.mark.parametrize("name", STATES)
def test_a_state_that_is_none_is_one_line_and_runs_nothing(
    run: Path, dataset: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run)
    with_state(run, STATES[name])
    says = r"step-00000004 (holds no|was written by).*--set training.start_from=\S+, in another --out"
    with pytest.raises(CheckpointError, match=says) as error:
        train(tiny_training(), data=dataset, run=run)
    assert "\n" not in str(error.value) and not (run / "executed").exists()


def headed(length: int, rest: bytes = b"") -> Callable[[Path], object]:
    """A file of weights that states the length of its header."""
    return lambda path: path.write_bytes(length.to_bytes(8, "little") + rest)


def telling(header: str) -> Callable[[Path], object]:
    """Whole weights with our own header."""
    return lambda path: save_file({}, path, metadata={"dsffnet": header})


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (headed(2**26), "its header would have 67,108,864 bytes"),
        (headed(2**63), "its header would have"),
        (headed(9, b"[[[[[[[[["), "cannot be read as weights"),
        (CONTENTS["empty"], "cannot be read as weights"),
        (CONTENTS["zeros"], "cannot be read as weights"),
        (CONTENTS["a device"], "not a regular file"),
        (CONTENTS["a pipe"], "not a regular file"),
        (telling("[" * 5000), "recursion limit"),
        (telling('{"step": "x"}'), "step: Input should be a valid integer"),
        (telling("null"), "cannot be read as weights"),
        (telling("{}"), "weights without their recipe"),
    ],
)
def test_a_file_that_only_claims_to_be_weights_is_one_line(tmp_path: Path, write: Any, says: str) -> None:
    path = tmp_path / "model.safetensors"
    write(path)
    with pytest.raises(DsffnetError, match=says) as error:
        load_trained(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("row", [robustness.RobustnessRow, generalisation.GeneralisationRow])
@pytest.mark.parametrize("content", ["a line", "no UTF-8", "a device", "a pipe", "a folder", "a link out"])
def test_damaged_rows_of_an_earlier_start_are_set_aside(
    tmp_path: Path, row: Any, content: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "rows.csv"
    path.write_bytes(b"method,pmd\nDSFFNet,x\n")
    if content != "a line":
        put(path, content)
    assert kept_rows(path, row) == kept_rows(path, row) == []
    assert [entry.name for entry in tmp_path.iterdir()] == ["rows.csv.unreadable"] and len(caplog.messages) == 1
