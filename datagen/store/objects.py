"""The objects of a dataset, in a folder or on a remote store: the only way to each of them.

Zarr's reads and writes and our own go through these stores. A dataset that was downloaded says what it likes, so they
touch objects of the layout only, read no more of one than it can have, follow no link out of the folder, and read
regular files only.
"""

import json
import os
import stat
from collections.abc import AsyncIterator, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, cast

import zarr
from zarr.abc.store import ByteRequest, RangeByteRequest, Store, SuffixByteRequest
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import LocalStore

from datagen.common.errors import DatasetError, UnsafeFileError
from datagen.common.files import files_below, open_regular, read_bounded, resolve_within
from datagen.store.object_names import is_leftover, is_member, limit_of, require_member, require_short
from datagen.store.remote_objects import S3_OPTIONS, RemoteObjects

_SHARDS = "/vertices/c"
"""How the path of an array's folder of shards ends."""


class LocalObjects(LocalStore):
    """Objects in a folder."""

    async def _open(self, *, mode: Any = None) -> None:
        await Store._open(self)  # Zarr's own makes the folder, be it only to look into it

    def read(self, path: str, *, limit: int | None = None, byte_range: ByteRequest | None = None) -> bytes | None:
        """Bytes of an object, all or a range; None where there is none.

        Raises
        ------
        UnsafeFileError
            See :func:`require_member`; or a link leads out of the folder, it is no regular file, or too long.
        OSError
            It cannot be read.
        """
        require_member(path)
        limit = limit_of(path) if limit is None else limit
        try:
            file = resolve_within(self.root, path)
            return read_bounded(file, limit=limit) if byte_range is None else _read_range(file, byte_range, limit)
        except (FileNotFoundError, NotADirectoryError):
            return None

    def sizes(self, paths: list[str]) -> dict[str, int]:
        """Size of each path that is a regular file."""
        found = ((path, self._size(path)) for path in paths)
        return {path: size for path, size in found if size is not None}

    def _size(self, path: str) -> int | None:
        require_member(path)
        try:
            status = os.stat(f"{self.root}/{path}")
        except (FileNotFoundError, NotADirectoryError):
            return None
        return status.st_size if stat.S_ISREG(status.st_mode) else None

    def names(self) -> list[str]:
        """Names of what lies directly in the folder."""
        return sorted(os.listdir(self.root)) if self.root.is_dir() else []

    def has_lost_root(self) -> bool:
        """Whether the folder holds a dataset, and nothing else, whose zarr.json is missing or no JSON."""
        if not (self.root / "manifest").is_dir():
            return False
        if not all(path.startswith(".") or is_member(path) or is_leftover(path) for path in self.paths()):
            return False
        try:
            return not isinstance(json.loads(self.read("zarr.json") or b""), dict)
        except (ValueError, RecursionError):
            return True

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        for path in self.paths(prefix):  # Zarr's own way takes several times as long
            yield path

    def paths(self, prefix: str = "", *, but: str | None = None) -> Iterator[str]:
        """Paths of all files below a folder; folders whose path ends in ``but`` are not looked into."""
        for file in files_below(self.root / prefix.rstrip("/"), but=but):
            yield file.path.removeprefix(f"{self.root}/")

    def _place(self, path: str) -> Path:
        """Where an object is to be written or removed; a link there is replaced or removed itself, never followed.

        An empty folder in its place is removed; of one that holds something we do not know whose it is.
        """
        parent, _, name = path.rpartition("/")
        place = (resolve_within(self.root, parent) if parent else self.root) / name
        if place.is_dir() and not place.is_symlink():
            try:
                place.rmdir()
            except OSError as error:
                raise DatasetError(
                    f"{self.root}: a folder that holds something is in the place of {path}. Look whose it is, move it "
                    "away, and run the same command again"
                ) from error
        return place

    def get_sync(
        self, key: str, *, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        content = self.read(key, byte_range=byte_range)
        return None if content is None else (prototype or default_buffer_prototype()).buffer.from_bytes(content)

    async def get(
        self, key: str, prototype: BufferPrototype | None = None, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        return self.get_sync(key, prototype=prototype, byte_range=byte_range)

    def set_sync(self, key: str, value: Buffer) -> None:
        self._make_ready(key, value)
        super().set_sync(key, value)

    async def _set(self, key: str, value: Buffer, exclusive: bool = False) -> None:
        self._make_ready(key, value)
        await super()._set(key, value, exclusive)

    def _make_ready(self, key: str, value: Buffer) -> None:
        """Refuse what must not be written, and free its place."""
        require_member(key)
        require_short(key, value)
        self._place(key)

    def delete_sync(self, key: str) -> None:
        self._check_writable()
        if not is_leftover(key):
            require_member(key)
        self._place(key).unlink(missing_ok=True)

    async def delete(self, key: str) -> None:
        self.delete_sync(key)


def _read_range(file: Path, byte_range: ByteRequest, limit: int) -> bytes:
    with open_regular(file) as opened:
        size = os.fstat(opened.fileno()).st_size
        start, end = _bounds(byte_range, size)
        if end - start > limit:
            raise UnsafeFileError(f"{end - start:,} bytes of {file} are asked for, which has no more than {limit:,}")
        opened.seek(start)
        return opened.read(end - start)


def _bounds(byte_range: ByteRequest, size: int) -> tuple[int, int]:
    """First byte of a range and the one after its last, within an object of ``size`` bytes."""
    if isinstance(byte_range, SuffixByteRequest):
        return max(0, size - byte_range.suffix), size
    if isinstance(byte_range, RangeByteRequest):
        return min(byte_range.start, size), min(byte_range.end, size)
    return min(byte_range.offset, size), size


Objects = LocalObjects | RemoteObjects


def plain(url: str) -> str:
    """A store URL without ``file://``: such a dataset is a folder like any other."""
    return url.removeprefix("file://")


def is_local(url: str) -> bool:
    """Whether a store URL is a folder of a file system."""
    return "://" not in plain(url)


def open_objects(url: str, *, read_only: bool) -> Objects:
    """The objects of the dataset at a folder or URL, which need not exist.

    Raises
    ------
    ImportError
        The URL needs a package that is not installed.
    ValueError
        No such kind of URL.
    """
    if is_local(url):
        return LocalObjects(os.path.realpath(plain(url)), read_only=read_only)
    on_s3 = url.startswith(("s3://", "s3a://"))
    remote = RemoteObjects.from_url(url, storage_options=S3_OPTIONS if on_s3 else None, read_only=read_only)
    assert isinstance(remote, RemoteObjects)
    if on_s3:
        remote.fs.retries = 1  # those of _patiently are the only ones, so that their time is known
    return remote


def read_bytes(
    group: zarr.Group, path: str, *, limit: int | None = None, byte_range: ByteRequest | None = None
) -> bytes | None:
    """Bytes of one object of the dataset's store, all or a range of them; None where there is none.

    Raises
    ------
    UnsafeFileError
        No object of a dataset is called so, or what is there is not a regular file of at most ``limit`` bytes inside.
    OSError
        It cannot be read.
    StorageError
        A remote store does not answer.
    """
    return cast(Objects, group.store).read(path, limit=limit, byte_range=byte_range)


def write_bytes(group: zarr.Group, path: str, content: bytes) -> None:
    """Write one object of the dataset's store whole, in the place of any that is there."""
    buffer = default_buffer_prototype().buffer.from_bytes(content)
    if isinstance(group.store, LocalObjects):
        group.store.set_sync(path, buffer)  # an event loop and a thread take longer than a small shard
    else:
        sync(group.store.set(path, buffer))


def put_bytes(group: zarr.Group, path: str, content: bytes) -> None:
    """Write one object unless it is there with these bytes already."""
    try:
        present = read_bytes(group, path)
    except (OSError, UnsafeFileError):
        present = None
    if present != content:
        write_bytes(group, path, content)


def delete_object(group: zarr.Group, path: str) -> None:
    """Remove one object of the dataset's store, if it is there."""
    sync(group.store.delete(path))


def list_objects(group: zarr.Group) -> list[str]:
    """Paths of all objects of the dataset's store, and of what killed writers left of some, sorted."""
    return sorted(path for path in _paths(group) if is_member(path) or is_leftover(path))


def list_leftovers(group: zarr.Group, shards: Iterable[str]) -> list[str]:
    """Paths of what killed writers left, beside these shards and beside all that is no shard."""
    if isinstance(store := group.store, LocalObjects):
        beside = (store.paths(path.rpartition("/")[0]) for path in shards)
        return [path for path in chain(store.paths(but=_SHARDS), chain.from_iterable(beside)) if is_leftover(path)]
    return [path for path in _paths(group) if is_leftover(path)]


def list_small_objects(group: zarr.Group) -> list[str]:
    """Paths of all objects but shards, sorted; folders of shards, of which there may be many, are not looked into."""
    return sorted(path for path in _paths(group, but=_SHARDS) if is_member(path) and f"{_SHARDS}/" not in path)


def _paths(group: zarr.Group, *, but: str | None = None) -> Iterable[str]:
    async def listed() -> list[str]:
        return [key async for key in group.store.list_prefix("")]

    return group.store.paths(but=but) if isinstance(group.store, LocalObjects) else sync(listed())


def stored_sizes(group: zarr.Group, paths: list[str]) -> dict[str, int]:
    """Size in bytes of each path that exists and is a file."""
    return cast(Objects, group.store).sizes(paths)
