"""MLflow's SQLite store: whole or not there at all, where it was asked for, and valid after its folder has moved."""

import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import mlflow
import mlflow.store.db.utils as mlflow_tables
import pytest
from mlflow.tracking._tracking_service.utils import _artifact_repos_cache

from datagen.common.errors import RecipeError, RegistryError, StorageError, TrackingError, UnsafeFileError
from tests.support.files import tree_hash
from training.tracking import mlflow_mirror, mlflow_store
from training.tracking.mirror_state import note_sent
from training.tracking.mlflow_mirror import publish
from training.tracking.mlflow_store import prepare_store, sqlite_server
from training.tracking.record import EXPERIMENT, Server, begin_record, update_record
from workflows import full
from workflows.cli import runs, transfer
from workflows.pipeline.console import guarded, server_of, server_of_record
from workflows.pipeline.run_folder import (
    AblationFolder,
    AvatarFolder,
    ComparisonFolder,
    SingleRunFolder,
    SweepFolder,
    WorkflowFolder,
)

ROOT = Path(__file__).parents[3]
AWKWARD = "a b #1 & 'q' \"d\" ; 日本é [x]{y}|~ $HOME 50:50 @=+,!<>"


def recorded(out: Path, store: Path | None = None) -> Path:
    """A folder with a record, an artifact and, if asked for, a store with all its tables."""
    begin_record(out, name=out.name, kind="workflow", parent=None, parameters={"training.batch": "8"})
    (out / "figures").mkdir()
    (out / "figures" / "curve.png").write_bytes(b"png")
    update_record(out, artifacts=["figures"])
    if store:
        shutil.copy(store, out / "mlflow.db")
    return out


def server(out: Path) -> Server:
    """The store of a folder by default, as a process of its own would see it: MLflow remembers the one before."""
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    _artifact_repos_cache.clear()
    return server_of(out, None)


def execute(database: Path, sql: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(database)) as connection, connection:
        return connection.execute(sql).fetchall()


def the_run(out: Path) -> mlflow.entities.Run:
    client = mlflow.MlflowClient(server(out).uri)
    (run,) = client.search_runs([client.get_experiment_by_name(EXPERIMENT).experiment_id])
    return run


def test_a_store_whose_making_was_killed_is_made_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """kill -9 in the middle of MLflow's migrations; then the same file under the store's own name, as it once was."""
    out = recorded(tmp_path / "out")
    database, partial = out / "mlflow.db", out / "mlflow.db.partial"
    code = "import sys; from pathlib import Path\n"
    code += "from training.tracking.mlflow_store import prepare_store, sqlite_server\n"
    code += "prepare_store(sqlite_server(Path(sys.argv[1])))"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(database)], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    until = time.monotonic() + 100
    while not (partial.exists() and partial.stat().st_size > 200_000):
        assert process.poll() is None and time.monotonic() < until, "the moment to kill it never came"
        time.sleep(0.002)
    process.kill()
    assert process.wait() == -signal.SIGKILL and not database.exists(), "nothing half made under its name"

    for part in out.glob("mlflow.db.partial*"):
        part.rename(str(part).replace(".partial", ""))
    assert execute(database, "SELECT count(*) FROM alembic_version") == [(1,)]
    publish(out, server(out))
    assert the_run(out).data.params == {"training.batch": "8"}
    assert "was left unfinished and holds no runs: made again" in caplog.text
    assert sorted(path.name for path in out.glob("mlflow*")) == [
        "mlflow.db", "mlflow.db.lock", "mlflow.db.unfinished", "mlflow.json",
    ]  # fmt: skip


def test_a_store_of_another_mlflow_that_holds_runs_is_never_touched(tmp_path: Path, empty_store: Path) -> None:
    out = recorded(tmp_path / "out", empty_store)
    publish(out, server(out))
    execute(out / "mlflow.db", "UPDATE alembic_version SET version_num = '451aebb31d03'")
    before = (out / "mlflow.db").read_bytes()
    with pytest.raises(TrackingError, match=r"holds 1 runs .*revision 451aebb31d03.*Copy the file, then: mlflow db up"):
        publish(out, server(out))
    assert (out / "mlflow.db").read_bytes() == before and not (out / "mlflow.db.unfinished").exists()


def test_a_file_that_is_no_store_is_named_at_once_and_left_alone(tmp_path: Path) -> None:
    out = recorded(tmp_path / "out")
    (out / "mlflow.db").write_bytes(b"precious" * 1000)
    began = time.monotonic()
    with pytest.raises(TrackingError, match=r"mlflow.db is no MLflow store \(file is not a database\)\. Move it away"):
        publish(out, server(out))
    assert time.monotonic() - began < 10 and (out / "mlflow.db").read_bytes() == b"precious" * 1000


def test_processes_that_want_one_new_store_make_it_once(
    tmp_path: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def make(engine: object) -> None:
        made.append(engine.url.database)  # type: ignore[attr-defined]
        time.sleep(0.2)
        shutil.copy(empty_store, made[-1])

    monkeypatch.setattr(mlflow_tables, "_initialize_tables", make)
    server = sqlite_server(tmp_path / "new" / "mlflow.db")
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: prepare_store(server), range(4)))
    assert made == [str(tmp_path / "new" / "mlflow.db.partial")]


def test_store_and_artifacts_lie_in_the_folder_whatever_it_is_called(tmp_path: Path, empty_store: Path) -> None:
    for name in (AWKWARD, "-lead"):
        out = recorded(tmp_path / "in" / name, empty_store)
        publish(out, server(out))
        publish(out, server_of(out, f"sqlite:///{out / 'mlflow.db'}"))
        run = the_run(out)
        assert run.info.run_name == name
        (stored,) = (out / "mlartifacts").rglob("curve.png")
        assert stored.read_bytes() == b"png"
        fetched = mlflow.MlflowClient(server(out).uri).download_artifacts(run.info.run_id, "figures/curve.png")
        assert Path(fetched).read_bytes() == b"png"
        shutil.rmtree(out)
    assert list((tmp_path / "in").iterdir()) == [], "nothing was made beside it"


@pytest.mark.parametrize(
    ("name", "character"),
    [
        ("x#h?q=1", "'?'"),
        ("half 50%", "'%'"),
        ("a%20b", "'%'"),
        ("b\udcffd", r"\udcff"),
        ("a\x1b[31m\nb", r"\x1b[31m\n"),
    ],
)
def test_a_folder_that_no_store_can_lie_in_is_refused_before_anything_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, character: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        guarded(lambda: full.main(["--recipe", "smoke", "--out", str(tmp_path / name)]))
    (line,) = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and line.startswith("error: ") and character in line
    assert list(tmp_path.iterdir()) == []


def test_a_server_elsewhere_has_nothing_to_say_about_the_folders_name() -> None:
    assert server_of(Path("/data/why?"), "http://127.0.0.1:5000").artifacts is None
    with pytest.raises(RecipeError, match=r"'\?' has another meaning in its URL"):
        server_of(Path("/data/x"), "sqlite:////data/mlflow.db?timeout=30")


def test_a_store_that_was_moved_or_copied_shows_the_artifacts_beside_it(tmp_path: Path, empty_store: Path) -> None:
    """Artifacts, the registered model and new artifacts too; those of the original are left alone."""
    out = recorded(tmp_path / "one #1", empty_store)
    publish(out, server(out))
    client = mlflow.MlflowClient(server(out).uri)
    model = client.create_logged_model(the_run(out).info.experiment_id, source_run_id=the_run(out).info.run_id)
    client.create_registered_model("legs")
    client.create_model_version("legs", f"models:/{model.model_id}", model_id=model.model_id)
    copied, moved = Path(shutil.copytree(out, tmp_path / "copy")), tmp_path / "moved é"
    before = tree_hash(out)
    (copied / "figures" / "new.png").write_bytes(b"of the copy")
    publish(copied, server(copied))
    assert tree_hash(out) == before, "the original is as it was"
    assert {path.name for path in (copied / "mlartifacts").rglob("*.png")} == {"curve.png", "new.png"}

    out.rename(moved)
    publish(moved, server(moved))
    assert not out.exists()
    for place in (copied, moved):
        with closing(sqlite3.connect(place / "mlflow.db")) as connection:
            assert "one%20%231" not in "\n".join(connection.iterdump()), "no table names the old place"
        assert the_run(place).info.artifact_uri.startswith(f"{(place / 'mlartifacts').as_uri()}/")
        client = mlflow.MlflowClient(server(place).uri)
        assert client.get_model_version("legs", "1").source == f"models:/{model.model_id}"
        assert client.get_model_version_download_uri("legs", "1").startswith(place.as_uri())


def test_artifacts_elsewhere_are_written_only_where_a_person_names_the_store(tmp_path: Path, empty_store: Path) -> None:
    """A stranger's folder may bring a store whose runs lie in somebody's home."""
    out = recorded(tmp_path / "out", empty_store)
    elsewhere = (tmp_path / "elsewhere" / "mlartifacts").as_uri()
    mlflow.MlflowClient(server(out).uri).create_experiment(EXPERIMENT, elsewhere)
    (out / "mlartifacts").mkdir()
    with pytest.raises(TrackingError, match="outside its folder"):
        publish(out, server(out))
    assert not (tmp_path / "elsewhere").exists()
    publish(out, server_of(out, server(out).uri))
    assert any((tmp_path / "elsewhere").rglob("curve.png"))


@pytest.mark.parametrize("place", ["file:///../..", "file:{out}/mlartifacts/../..", "/tmp", "s3://bucket/x"])
def test_a_run_of_a_store_that_came_with_its_folder_is_written_beside_it(
    tmp_path: Path, empty_store: Path, place: str
) -> None:
    out = recorded(tmp_path / "out", empty_store)
    publish(out, server(out))
    (out / "mlflow.json").unlink()
    (out / "figures" / "curve.png").write_bytes(b"another")
    execute(out / "mlflow.db", f"UPDATE runs SET artifact_uri = '{place.format(out=out)}'")
    before = tree_hash(out / "mlartifacts")
    with pytest.raises(TrackingError, match="outside its folder"):
        publish(out, server(out))
    assert tree_hash(out / "mlartifacts") == before and not (tmp_path / "figures").exists()


_ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n)"
CODE = {
    "a trigger": ["CREATE TRIGGER t AFTER INSERT ON runs BEGIN UPDATE runs SET artifact_uri='file:///victim'; END"],
    "a view": ["ALTER TABLE runs RENAME TO r", f"CREATE VIEW runs AS {_ENDLESS} SELECT i AS artifact_uri FROM n"],
    "a virtual table": ["CREATE VIRTUAL TABLE t USING fts5(x)"],
}


@pytest.mark.parametrize("statements", CODE.values(), ids=CODE)
def test_what_a_store_that_came_with_its_folder_would_execute_is_refused(
    tmp_path: Path, empty_store: Path, statements: list[str]
) -> None:
    """A trigger moves a run's artifacts after its places were looked at; a view may have rows without end."""
    database = tmp_path / "mlflow.db"
    shutil.copy(empty_store, database)
    with closing(sqlite3.connect(database, isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(statement)
    before = database.read_bytes()
    with pytest.raises(UnsafeFileError, match="that MLflow does not make and SQLite would execute"):
        prepare_store(sqlite_server(database, own=True))
    assert database.read_bytes() == before


def test_a_place_that_is_no_path_is_said_in_one_short_line(tmp_path: Path, empty_store: Path) -> None:
    """With what to do: of pages too, whose command has no --tracking-uri."""
    out = recorded(tmp_path / "o u t", empty_store)
    publish(out, server(out))
    database = out / "mlflow.db"
    for place in ("file://[", "file:///%00", "file:///" + "x" * 3_000_000, "mlflow-artifacts:/1/../2", "models:/m/1"):
        with closing(sqlite3.connect(database)) as connection, connection:
            connection.execute("UPDATE runs SET artifact_uri = ?", [place])
        with pytest.raises(UnsafeFileError, match="outside its folder") as raised:
            prepare_store(server(out))
        said = str(raised.value)
        assert len(said) < 1500 and "moved without its mlartifacts, move mlflow.db away and run again" in said
        uri = f"'sqlite:///{database}'"
        assert said.endswith(f"name the store: --tracking-uri {uri}; its pages: mlflow ui --backend-store-uri {uri}")


def test_models_come_from_a_store_that_nobody_named_only_where_it_lies_whole_in_its_folder(
    tmp_path: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = recorded(tmp_path / "runs" / "quickstart", empty_store)
    client = mlflow.MlflowClient(server(out).uri)
    client.create_registered_model("dsffnet")
    client.create_model_version("dsffnet", (tmp_path / "private").as_uri())
    monkeypatch.chdir(tmp_path)
    asked = Namespace(model="models:/dsffnet/1", tracking_uri=None, force=False)
    with pytest.raises(RegistryError, match=r"notes artifacts at .*private', outside its folder.*name the store"):
        transfer.weights_of(asked).__enter__()


def test_runs_of_others_in_the_store_of_a_folder_lie_in_it_too(tmp_path: Path, empty_store: Path) -> None:
    """MLflow's pages show them; what a person logs to the server of those pages is kept beside the store."""
    out = recorded(tmp_path / "out", empty_store)
    client = mlflow.MlflowClient(server(out).uri)
    client.create_run(client.create_experiment("mine", "mlflow-artifacts:/1"))
    publish(out, server(out))
    client.create_run(client.create_experiment("theirs", tmp_path.as_uri()))
    with pytest.raises(UnsafeFileError, match="outside its folder"):
        prepare_store(server(out))


def test_places_are_resolved_once_a_process(tmp_path: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = recorded(tmp_path / "out", empty_store)
    publish(out, server(out))
    prepare_store(server(out))
    monkeypatch.setattr(mlflow_store, "require_inside", lambda *_: pytest.fail("again"))
    prepare_store(server(out))


def test_a_store_that_is_locked_or_whose_lock_is_a_link_is_one_line(tmp_path: Path, empty_store: Path) -> None:
    out = recorded(tmp_path / "out", empty_store)
    with closing(sqlite3.connect(out / "mlflow.db")) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(mlflow_store, "_BUSY_SECONDS", 0.01)
            with pytest.raises(StorageError, match=r"cannot be used now \(database is locked\)\. Run again once"):
                prepare_store(server(out))
    (out / "mlflow.db").unlink()
    (out / "mlflow.db.lock").symlink_to(tmp_path / "victim")
    with pytest.raises(UnsafeFileError, match=r"'mlflow\.db\.lock', a link"):
        prepare_store(server(out))
    assert not (tmp_path / "victim").exists()


def test_a_run_that_was_put_elsewhere_meanwhile_is_not_written_to(
    tmp_path: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Places are looked at before anything is sent, and that of the run once it is known."""
    out = recorded(tmp_path / "out", empty_store)
    publish(out, server(out))
    (out / "figures" / "curve.png").write_bytes(b"another")
    execute(out / "mlflow.db", f"UPDATE runs SET artifact_uri = '{(tmp_path / 'victim').as_uri()}'")
    monkeypatch.setattr(mlflow_mirror, "prepare_store", lambda _: None)
    with pytest.raises(TrackingError, match="outside its folder") as raised:
        publish(out, server(out))
    assert not (tmp_path / "victim").exists()
    assert "dsffnet sync" not in str(raised.value), "a store that is named is not guarded"


def test_a_run_that_is_noted_but_of_another_experiment_is_not_ours(tmp_path: Path, empty_store: Path) -> None:
    out = recorded(tmp_path / "out", empty_store)
    client = mlflow.MlflowClient(server(out).uri)
    theirs = client.create_run(client.create_experiment("theirs", (out / "mlartifacts" / "9").as_uri())).info.run_id
    note_sent(out, server(out).uri, {"run": theirs, "offsets": {}, "artifacts": {}})
    publish(out, server(out))
    assert the_run(out).data.params == {"training.batch": "8"} and not client.get_run(theirs).data.params


def test_how_to_send_later_names_only_a_store_that_was_named(
    tmp_path: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = recorded(tmp_path / "out", empty_store)

    def broken(_: object) -> None:
        raise StorageError("no")

    monkeypatch.setattr(mlflow_mirror, "prepare_store", broken)
    for uri, says in ((None, f"dsffnet sync {out} sends"), (server(out).uri, f" --tracking-uri {server(out).uri} s")):
        with pytest.raises(TrackingError, match=re.escape(says)):
            publish(out, server_of(out, uri))


@pytest.mark.parametrize("folder", [WorkflowFolder, AvatarFolder, SweepFolder, ComparisonFolder, AblationFolder])
def test_work_that_makes_a_dataset_has_its_store_inside(folder: type[WorkflowFolder], tmp_path: Path) -> None:
    """So ``dsffnet sync`` sends to where the work itself did; a single training's store lies beside it."""
    begin_record(tmp_path / "out", name="whole", kind=folder.kind, parent=None, parameters={})
    begin_record(tmp_path / "run", name="train", kind="train", parent=None, parameters={})
    assert server_of_record(tmp_path / "out", None) == server_of(tmp_path / "out", None)
    assert server_of_record(tmp_path / "run", None) == server_of(tmp_path, None)


def test_a_link_to_a_folder_has_the_store_of_the_folder(
    tmp_path: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the command; of a single run the store beside it, not beside the link."""
    out, link = recorded(tmp_path / "out", empty_store), tmp_path / "links" / "out"
    link.parent.mkdir()
    link.symlink_to(out)
    run = out / "run"
    begin_record(run, name="train", kind="train", parent=None, parameters={})
    (tmp_path / "links" / "run").symlink_to(run)
    (out / "run" / "evaluation").mkdir()
    (out / "run" / "evaluation" / "tables.md").write_text("")
    assert server_of(link, None) == server_of_record(link, None) == server(out)
    assert server_of_record(tmp_path / "links" / "run", None) == server(out)
    assert "make ui OUT=" in full.closing_words(SingleRunFolder(link), server_of(link, None))
    servers: list[Server] = []
    monkeypatch.setattr(mlflow_mirror, "publish", lambda root, server: servers.append(server))
    for _ in ("a record", "none yet"):
        with runs._mirrored(tmp_path / "links" / "run", Namespace(tracking_uri=None)):
            pass
        (run / "record.json").unlink(missing_ok=True)
    assert len(servers) >= 2 and set(servers) == {server(out)}


@pytest.mark.parametrize("name", ["mlflow.db", "mlartifacts", "mlartifacts/1/x/artifacts/figures/curve.png"])
def test_links_of_a_store_are_not_written_through(tmp_path: Path, empty_store: Path, name: str) -> None:
    out, victim = recorded(tmp_path / "out"), tmp_path / "victim"
    shutil.copy(empty_store, victim)
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).symlink_to(victim)
    before = victim.read_bytes()
    with pytest.raises(TrackingError, match="link"):
        publish(out, server(out))
    assert victim.read_bytes() == before


def test_a_second_command_on_one_folder_says_so_at_once_and_changes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    with SingleRunFolder(out).alone():
        (out / "recipe.yaml").write_text("of the first")
        before = tree_hash(out)
        for more in ([], ["--fresh"]):
            began = time.monotonic()
            with pytest.raises(SystemExit) as ended:
                guarded(lambda: full.main(["--recipe", "smoke", "--out", str(out), *more]))  # noqa: B023
            (line,) = capsys.readouterr().err.splitlines()
            assert ended.value.code == 1 and time.monotonic() - began < 5
            assert line == f"error: another command is at work in {out}. Wait for it, or stop it, then run again"
        assert tree_hash(out) == before


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_ui_takes_what_the_closing_words_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Makefile of this repository beside a ``dsffnet`` that only says what it was asked for."""
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("constraints.txt", "pyproject.toml", "deploy/requirements.txt", ".venv/.ready"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    program = tmp_path / ".venv" / "bin" / "dsffnet"
    program.parent.mkdir()
    program.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    program.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    out = tmp_path / AWKWARD
    (out / "run" / "evaluation").mkdir(parents=True)
    (out / "run" / "evaluation" / "tables.md").write_text("")
    (out / "mlflow.db").touch()
    said = full.closing_words(SingleRunFolder(out), server(out)).splitlines()
    command = next(line for line in said if line.startswith("  make ui"))
    for name in ("MAKEFLAGS", "MAKELEVEL"):  # under ``make test`` the inner make would add lines of its own
        monkeypatch.delenv(name, raising=False)
    asked = subprocess.run(command, shell=True, capture_output=True, text=True, check=True).stdout.splitlines()
    assert asked[0] == "ui" and Path(asked[-1]).resolve() == out
