"""MLflow's SQLite store beside a workflow: its URL, made whole or not at all, and valid where its folder was moved to.

MLflow makes its tables in some dozens of migrations of which none can be taken back, and cannot finish what a kill cut
short. So a store is made under another name and renamed. It also notes absolute places of artifacts; those are changed
where the folder lies elsewhere by now. What MLflow's pages show of this project first is said here, too.
"""

import json
import logging
import os
import re
import shlex
import sqlite3
import unicodedata
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from datagen.common.errors import RecipeError, StorageError, UnsafeFileError
from datagen.common.files import lock_within, resolve_within
from training.tracking.record import EXPERIMENT, MODEL, Server

log = logging.getLogger(__name__)
_SCHEME = "sqlite:///"
_SECONDS = 120.0  # to wait for another process that makes the same store
_BUSY_SECONDS = 20.0  # to wait for another process that writes to it; MLflow waits as long
_PLACES = {
    "experiments": "artifact_location",
    "runs": "artifact_uri",
    "logged_models": "artifact_location",
    "model_versions": "storage_location",
}
"""Table -> its column of absolute places."""

_VIEW = "dsffnet"
_COLUMNS = ("metrics.`pmd_unseen`", "metrics.`pmd_seen`", "metrics.`millimetres_unseen`", "attributes.`Models`")
_STATE = {"selectedColumns": _COLUMNS, "columnOrder": [], "columnWidths": {}, "runsExpanded": {}}
_SAVED_VIEW = {"name": "PMD", "createdAt": 0, "updatedAt": 0, "state": json.dumps(_STATE)}

EXPERIMENT_TAGS = {
    "mlflow.experimentKind": "custom_model_development",  # training, where MLflow would take it for GenAI
    f"mlflow.sharedViewState.{_VIEW}": json.dumps(_SAVED_VIEW),  # columns of the list, for the address below
}
"""Tags by which MLflow's pages show the experiment as trainings, with columns of PMD."""


def sqlite_server(database: Path, *, own: bool = False) -> Server:
    """Return the server of a SQLite file, with its artifacts beside it.

    Raises
    ------
    RecipeError
        The path holds a character that cannot stand in the URL of such a store.
    """
    for character in str(database):
        if character in "?%" or unicodedata.category(character) == "Cs":
            raise RecipeError(
                f"MLflow's store cannot lie at {str(database)!a}: {character!a} has another meaning in its "
                "URL. Choose another folder, or name an MLflow server: --tracking-uri http://HOST:PORT"
            )
    return Server(f"{_SCHEME}{database}", artifacts=database.parent / "mlartifacts", own=own)


def sqlite_file(uri: str) -> Path | None:
    """Return the file of a SQLite store's URL; None for other servers."""
    return Path(uri.removeprefix(_SCHEME)) if uri.startswith(_SCHEME) else None


def prepare_store(server: Server) -> None:
    """Make a SQLite store that is missing, replace one that was left unfinished, correct one that was moved.

    Raises
    ------
    StorageError
        The file is no database, holds runs in tables that this MLflow does not use, or cannot be used now.
    UnsafeFileError
        The store is the folder's own, and it or its artifacts lead out of the folder, or it holds what is executed.
    """
    database = sqlite_file(server.uri)
    if database is None:
        return
    if server.own:
        _refuse_links(database)
        if database.exists():
            _refuse_code(database)
    if not _is_whole(database):
        database.parent.mkdir(parents=True, exist_ok=True)
        with lock_within(database.parent, f"{database.name}.lock").acquire(timeout=_SECONDS):
            if not _is_whole(database):
                _set_aside(database)
                _make(database)
    if server.artifacts:
        _correct_places(database, server.artifacts)
    if server.own and server.artifacts:
        _refuse_places_elsewhere(database, server)


def experiment_in(database: Path) -> str | None:
    """The number of this project's experiment in a SQLite store, by which MLflow's pages are addressed."""
    with _opened(database) as connection:
        found = connection.execute("SELECT experiment_id FROM experiments WHERE name = ?", [EXPERIMENT]).fetchone()
    return str(found[0]) if found else None


def mark_experiment(client: Any, experiment: Any) -> None:
    """Give an experiment those of its tags that it lacks; what people set stays."""
    for key, value in EXPERIMENT_TAGS.items():
        if key not in experiment.tags:
            client.set_experiment_tag(experiment.experiment_id, key, value)


def page_addresses(server: str, experiment: str) -> dict[str, str]:
    """Return the addresses of the runs' and the model's pages of a server ``http://HOST:PORT``."""
    return {
        "runs": f"{server}/#/experiments/{experiment}/runs?workflowType=machine_learning&viewStateShareKey={_VIEW}",
        "model": f"{server}/#/models/{MODEL}",
    }


def require_inside(place: object, server: Server) -> None:
    """Refuse a place of artifacts, as MLflow notes it, that is not in the folder of a store that is the folder's own.

    Raises
    ------
    UnsafeFileError
        It is elsewhere: MLflow would read and write there.
    """
    if server.own and server.artifacts and not _is_inside(place, server.artifacts):
        database = Path(server.uri.removeprefix(_SCHEME))
        raise UnsafeFileError(
            f"{database} notes artifacts at {str(place)[:200]!r}, outside its folder. If the folder was moved without "
            f"its mlartifacts, move {database.name} away and run again: a new store gets all that the folder still "
            f"holds. If you put them there, {_name_it(database)}"
        )


def _is_inside(place: object, artifacts: Path) -> bool:
    from mlflow.utils.file_utils import local_file_uri_to_path

    if not isinstance(place, str) or not place.startswith("file:///"):  # of others MLflow's reading is not one path
        return isinstance(place, str) and _SERVED.fullmatch(place) is not None
    try:
        local = os.path.realpath(local_file_uri_to_path(place))
    except ValueError:  # a NUL in it
        return False
    return Path(local).is_relative_to(os.path.realpath(artifacts))


_SERVED = re.compile(r"mlflow-artifacts:(/[\w-]+)+")
"""What a person logs to the server of ``dsffnet ui``, which keeps it beside the store."""


def _name_it(database: Path) -> str:
    uri = shlex.quote(f"{_SCHEME}{database}")
    return f"name the store: --tracking-uri {uri}; its pages: mlflow ui --backend-store-uri {uri}"


def _is_whole(database: Path) -> bool:
    """Whether MLflow's tables are all there.

    Raises
    ------
    StorageError
        The file is no database.
    """
    if not database.exists():
        return False
    with _opened(database) as connection:
        return _revision(connection) == _newest_revision()


def _set_aside(database: Path) -> None:
    """Rename a store that is not whole and holds nothing.

    Raises
    ------
    StorageError
        It does hold something.
    """
    if not database.exists():
        return
    with _opened(database) as connection:
        revision, count = _revision(connection), _count(connection, "runs") + _count(connection, "registered_models")
    if count:
        raise StorageError(
            f"{database} holds {count} runs and models in tables of another MLflow (revision {revision or 'none'}, "
            f"this one's is {_newest_revision()}). Copy the file, then: mlflow db upgrade {_SCHEME}{database}"
        )
    os.replace(database, f"{database}.unfinished")
    log.warning("MLflow's store %s was left unfinished and holds no runs: made again", database)


def _make(database: Path) -> None:
    """Make the tables under another name, then rename."""
    from mlflow.store.db.utils import _initialize_tables, create_sqlalchemy_engine

    partial = database.with_name(f"{database.name}.partial")
    for rest in (partial, partial.with_name(f"{partial.name}-journal")):
        rest.unlink(missing_ok=True)
    engine = create_sqlalchemy_engine(f"{_SCHEME}{partial}")
    try:
        _initialize_tables(engine)
    finally:
        engine.dispose()
    os.replace(partial, database)


def _correct_places(database: Path, artifacts: Path) -> None:
    """Note where the artifacts are by now, if they lie beside the store and were noted elsewhere: it was moved."""
    with _opened(database) as connection:
        found = connection.execute("SELECT artifact_location FROM experiments WHERE name = ?", [EXPERIMENT]).fetchone()
        there, here = found[0] if found else "", artifacts.as_uri()
        if not there or there == here or not _holds_artifacts(connection, there, artifacts):
            return
        with connection:
            for table, column in _PLACES.items():
                connection.execute(
                    f"UPDATE {table} SET {column} = :here || substr({column}, length(:there) + 1) "
                    f"WHERE {column} = :there OR substr({column}, 1, length(:there) + 1) = :there || '/'",
                    {"here": here, "there": there},
                )
    log.warning("MLflow's store %s was moved or copied: its artifacts are taken from %s", database, artifacts)


@cache
def _refuse_links(database: Path) -> None:
    """Refuse, once a process, a store whose file or artifacts are links: MLflow would write through them."""
    resolve_within(database.parent, database.name)
    artifacts = resolve_within(database.parent, "mlartifacts")
    for folder, folders, files in os.walk(artifacts):
        link = next((name for name in (*folders, *files) if os.path.islink(os.path.join(folder, name))), None)
        if link is not None:
            raise UnsafeFileError(
                f"{folder} holds a link, {link!r}, through which MLflow would write. If it is yours, "
                f"{_name_it(database)}"
            )


_HARMLESS = re.compile(r"CREATE (TABLE|INDEX|UNIQUE INDEX|TRIGGER \w+\s+BEFORE UPDATE ON secrets)\s")
"""The statements that MLflow's own schema is made of. Views, virtual tables and triggers of others would be executed
with what is asked and written."""


def _refuse_code(database: Path) -> None:
    """Refuse a store with a schema that does more than to hold what is written to it."""
    with _opened(database) as connection:
        for kind, name, statement in connection.execute("SELECT type, name, sql FROM sqlite_master"):
            if statement is not None and not _HARMLESS.match(str(statement)):
                raise UnsafeFileError(
                    f"{database} holds a {str(kind)[:20]}, {str(name)[:80]!r}, that MLflow does not make and SQLite "
                    "would execute. Do not trust it; move it away, and a new one is made"
                )


def _refuse_places_elsewhere(database: Path, server: Server) -> None:
    """Refuse a store that notes artifacts outside its folder."""
    accepted = _accepted(database)
    with _opened(database) as connection:
        for (place,) in connection.execute(_USED_PLACES, {"name": EXPERIMENT}):
            if place not in accepted:
                require_inside(place, server)
                accepted.add(place)


@cache
def _accepted(database: Path) -> set[str]:
    """Places of a store that were found to be inside: of many runs each is resolved once a process."""
    return set()


_USED_PLACES = """
SELECT artifact_location FROM experiments WHERE name = :name
UNION SELECT artifact_uri FROM runs
UNION SELECT artifact_location FROM logged_models
UNION SELECT coalesce(storage_location, source) FROM model_versions
"""
"""Wherever the project's experiment is written to, and all that is read by MLflow's registry and pages: of other
experiments not their own places, as MLflow's "Default" is noted in the folder that a command was started in."""


def _holds_artifacts(connection: sqlite3.Connection, there: str, artifacts: Path) -> bool:
    """Whether the artifacts of a run that are noted as being ``there`` lie in the folder ``artifacts``."""
    begins = "SELECT run_uuid FROM runs WHERE substr(artifact_uri, 1, length(:there) + 1) = :there || '/'"
    noted = connection.execute(begins, {"there": there})
    return any((artifacts / run).is_dir() for (run,) in noted)


@contextmanager
def _opened(database: Path) -> Iterator[sqlite3.Connection]:
    uri = f"file:{quote(str(database.absolute()))}?mode=rw"
    try:
        with closing(sqlite3.connect(uri, uri=True, timeout=_BUSY_SECONDS)) as connection:
            yield connection
    except sqlite3.OperationalError as error:  # locked, read-only, a broken disk: nothing is wrong with the file
        raise StorageError(
            f"{database} cannot be used now ({error}). Run again once it is free and writable"
        ) from error
    except sqlite3.DatabaseError as error:
        raise StorageError(f"{database} is no MLflow store ({error}). Move it away, and a new one is made") from error


def _revision(connection: sqlite3.Connection) -> str | None:
    if not _count(connection, "alembic_version"):
        return None
    return str(connection.execute("SELECT version_num FROM alembic_version").fetchone()[0])


def _count(connection: sqlite3.Connection, table: str) -> int:
    """Rows of a table; none where there is no such table."""
    known = connection.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", [table]).fetchone()
    return int(connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0]) if known else 0


@cache
def _newest_revision() -> str:
    from mlflow.store.db.utils import _get_latest_schema_revision

    return str(_get_latest_schema_revision())
