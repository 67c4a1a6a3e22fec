"""An object store that does not answer: asked again for a stated time, then one line; what passes leaves no trace."""

import errno
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from zarr.storage import FsspecStore

from datagen import generate as generation
from datagen.common.errors import DatasetError, StorageError, UnsafeFileError
from datagen.generate import generate, inline
from datagen.store import open_dataset, remote_objects
from datagen.store.objects import list_objects, read_bytes, stored_sizes, write_bytes
from datagen.store.schema import open_group
from datagen.store.verify import find_faults
from tests.support.damage.object_store import BUCKET, proxied, s3_server
from tests.support.recipes import tiny_dataset
from training.data.vertex_bank import open_bank
from workflows.cli.main import main
from workflows.pipeline import tasks

SHARD = "grid/training/0/vertices/c/1/0/0/0"


@pytest.fixture
def url(monkeypatch: pytest.MonkeyPatch) -> str:
    """A place in memory that is reached as S3 is, with little patience."""
    monkeypatch.setattr(remote_objects, "PATIENCE", 0.3)
    monkeypatch.setattr(remote_objects, "_FIRST_PAUSE", 0.01)
    return f"memory://{uuid4().hex}.zarr"


class EndpointConnectionError(Exception):
    """As botocore's."""


EndpointConnectionError.__module__ = "botocore.exceptions"
PASSING = [
    OSError(errno.EBUSY, "Please reduce your request rate."),
    OSError(errno.EREMOTEIO, "We encountered an internal error."),
    ConnectionResetError(errno.ECONNRESET, "Connection reset by peer"),
    TimeoutError(),
    EndpointConnectionError('Could not connect to the endpoint URL: "http://x"'),
]


def failing(monkeypatch: pytest.MonkeyPatch, errors: Iterator[Exception | None]) -> None:
    """Let requests fail with these errors, None for one that succeeds."""

    def wrapped(name: str) -> None:
        real = getattr(FsspecStore, name)

        async def ask(self: FsspecStore, *arguments: Any, **options: Any) -> Any:
            error = next(errors)
            if error:
                raise error
            return await real(self, *arguments, **options)

        monkeypatch.setattr(FsspecStore, name, ask)

    for name in ("get", "set", "delete", "exists", "getsize"):
        wrapped(name)


def bytes_at(url: str) -> dict[str, bytes | None]:
    group = open_group(url)
    return {path: read_bytes(group, path) for path in objects_at(url)}


def objects_at(url: str) -> list[str]:
    return list_objects(open_group(url))


def test_errors_that_pass_lead_to_the_same_bytes(url: str, dataset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_objects, "PATIENCE", 60.0)  # one of many requests at once may meet several in a row
    numbers = count()
    passing = (PASSING[n % len(PASSING)] if n % 3 == 0 else None for n in numbers)
    failing(monkeypatch, passing)
    made = generate(tiny_dataset(), url)
    assert np.array_equal(made.vertices(3), open_dataset(dataset).vertices(3)) and not list(find_faults(url))
    assert next(numbers) > 200
    monkeypatch.undo()
    assert bytes_at(url) == {path: (Path(dataset) / path).read_bytes() for path in objects_at(dataset)}


@pytest.mark.parametrize("error", PASSING, ids=repr)
def test_errors_that_stay_are_one_line_after_the_stated_time(
    url: str, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    generate(tiny_dataset(), url)
    opened = open_dataset(url)
    failing(monkeypatch, iter(lambda: error, None))
    reads = [lambda: opened.vertices(0), lambda: opened.vertices(0, 3), lambda: open_dataset(url)]
    for read in reads:
        began = time.monotonic()
        with pytest.raises(StorageError, match=r"memory://.* cannot be reached.*run the same command again") as caught:
            read()
        assert 0.1 < time.monotonic() - began < 3 and "\n" not in str(caught.value)


class NoCredentialsError(EndpointConnectionError):
    """As botocore's."""


NoCredentialsError.__module__ = "botocore.exceptions"


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (PermissionError(errno.EACCES, "Access Denied"), r"refuses access \(.*Access Denied\).*s3:ListBucket"),
        (NoCredentialsError("none"), "cannot be reached .*Check its address and your credentials"),
    ],
)
def test_what_no_time_mends_is_not_waited_for(
    url: str, monkeypatch: pytest.MonkeyPatch, error: Exception, says: str
) -> None:
    monkeypatch.setattr(remote_objects, "PATIENCE", 60.0)
    failing(monkeypatch, iter(lambda: error, None))
    with pytest.raises(StorageError, match=says):
        open_dataset(url)


def test_an_object_that_is_longer_than_it_can_be_is_not_read(url: str) -> None:
    generate(tiny_dataset(), url)
    opened = open_dataset(url)
    write_bytes(open_group(url, mode="r+"), SHARD, bytes(10**6))
    with pytest.raises(DatasetError, match=rf"{SHARD} cannot be read .*is longer than"):
        opened.vertices(1)
    with pytest.raises(UnsafeFileError, match="none of its objects"):
        read_bytes(opened.group, "../other.zarr/zarr.json")
    assert [fault.path for fault in find_faults(url)] == [SHARD]


def test_sizes_are_listed_where_many_are_asked_for(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    generate(tiny_dataset(), url)
    group = open_group(url)
    paths = [*list_objects(group), "grid/training/0/vertices/c/9/9/0/0"]
    found = []
    for least in (1, 10**9):
        monkeypatch.setattr(remote_objects, "_LISTED_FROM", least)
        found.append(stored_sizes(group, paths))
    assert found[0] == found[1] and list(found[0]) == paths[:-1]


@contextmanager
def web_server(folder: Path, listing: str) -> Iterator[str]:
    """Address of a web server of a folder, of which it shows a list of links, a page without any, or an error."""

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def list_directory(self, path: Any) -> Any:
            if listing == "links":
                return super().list_directory(path)
            asked.append(self.path)
            self.send_response(200 if listing == "none" else int(listing))
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            return None

    class Server(ThreadingHTTPServer):
        request_queue_size = 64

    asked: list[str] = []
    with Server(("127.0.0.1", 0), partial(Handler, directory=str(folder))) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
    assert len(asked) < 10, "folders are not gone through where none is listed"


@pytest.fixture(scope="module")
def many_shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 72 shards; one of them is lost."""
    place = tmp_path_factory.mktemp("served")
    recipe = tiny_dataset(
        identities={"training": 36, "evaluation": 0}, poses={"seen": 2, "unseen": 0}, store={"poses_per_shard": 1}
    )
    rows = generate(recipe, str(place / "legs.zarr")).committed.shards
    assert len(rows) == 72
    (place / "legs.zarr" / SHARD).unlink()
    return place


@pytest.mark.parametrize("listing", ["links", "none", "403", "404"])
def test_sizes_over_http_are_those_of_the_files_whatever_the_server_lists(
    many_shards: Path, monkeypatch: pytest.MonkeyPatch, listing: str
) -> None:
    monkeypatch.setattr(remote_objects, "PATIENCE", 2.0)
    files = many_shards / "legs.zarr"
    paths = [*objects_at(str(files)), SHARD]
    with web_server(many_shards, listing) as address:
        found = stored_sizes(open_group(f"{address}/legs.zarr"), paths)
        assert found == {path: (files / path).stat().st_size for path in paths[:-1]}
        with pytest.raises(DatasetError, match=rf"shard {SHARD} is missing. Repair"):
            open_dataset(f"{address}/legs.zarr")


def test_sizes_are_asked_for_where_listing_is_not_allowed(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a bucket whose objects may be read by those who may not list it."""
    generate(tiny_dataset(), url)
    paths, group = objects_at(url), open_group(url)
    expected = stored_sizes(group, paths)
    monkeypatch.setattr(remote_objects, "_LISTED_FROM", 1)

    async def denied(*_: Any, **__: Any) -> None:
        raise PermissionError(errno.EACCES, "Access Denied")

    monkeypatch.setattr(group.store.fs, "_find", denied)
    assert stored_sizes(group, paths) == expected and len(expected) == len(paths)


# A real S3 API from here on.


@pytest.fixture
def server() -> Iterator[subprocess.Popen[bytes]]:
    """An S3 server, to which the environment leads."""
    with s3_server() as process:
        yield process


@pytest.mark.cluster
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("server")
def test_overload_and_lost_connections_of_s3_lead_to_the_same_bytes(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_objects, "_FIRST_PAUSE", 0.02)
    place = f"{BUCKET}/leg.zarr"
    with proxied(tmp_path / "requests", busy_every=10, lost_every=7) as proxy:
        made = generate(tiny_dataset(), place)
        assert np.array_equal(made.vertices(4), open_dataset(dataset).vertices(4)) and not list(find_faults(place))
        assert bytes_at(place) == {path: (Path(dataset) / path).read_bytes() for path in objects_at(dataset)}
        assert len(proxy.requests()) > 200


@pytest.mark.cluster
@pytest.mark.timeout(300)
def test_s3_that_goes_away_in_the_middle(
    server: subprocess.Popen[bytes],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    """Of a training's reads, and of a generation: one line each, soon after the stated time."""
    monkeypatch.setattr(remote_objects, "PATIENCE", 3.0)
    trained_on = generate(tiny_dataset(), f"{BUCKET}/leg.zarr")
    bank = open_bank(trained_on, trained_on.identities("training"), cache="stream")

    def killing(task: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        for number, row in enumerate(inline(task, arguments)):
            if task is generation.ensure_shards and number == 2:
                server.kill()
                server.wait()
            yield row

    monkeypatch.setattr(tasks, "inline", killing)
    began = time.monotonic()
    with pytest.raises(SystemExit):
        main(["generate", "--recipe", "smoke", "--local", "--out", f"{BUCKET}/other.zarr"])
    written = capsys.readouterr().err
    errors = [line for line in written.splitlines() if line.startswith("error: ")]
    assert "Traceback" not in written and len(errors) == 1, written
    assert "cannot be reached" in errors[0] and "run the same command again" in errors[0]
    with pytest.raises(StorageError, match="run the same command again"):
        bank.batch(np.array([[0, 0, 1, 1]]))
    assert time.monotonic() - began < 60
