"""The objects of a dataset, in a folder or on a remote store: which there can be, and the only way to each of them.

Zarr's reads and writes and our own go through these stores. A dataset that was downloaded says what it likes, so they
touch objects of the layout only, read no more of one than it can have, follow no link out of the folder, and read
regular files only. A remote store that does not answer is asked again for a minute.
"""

import asyncio
import errno
import logging
import os
import re
import stat
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from zarr.abc.store import ByteRequest, RangeByteRequest, Store, SuffixByteRequest
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import FsspecStore, LocalStore

from datagen.errors import DatasetError, StorageError, UnsafeFileError, reason_of
from datagen.files import open_regular, read_bounded, resolve_within
from datagen.store.codec import LARGEST_CHUNK

log = logging.getLogger(__name__)

_T = TypeVar("_T")
_NUMBER = "[0-9]{1,9}"
_MEMBER = re.compile(
    rf"""(?:(?:topology|identity|pose|evaluation|manifest)/)?zarr\.json
    |topology/{_NUMBER}/(?:faces/)?zarr\.json|topology/{_NUMBER}/faces/c/0/0
    |identity/{_NUMBER}/(?:(?:vertices|pose|parameters)/)?zarr\.json
    |identity/{_NUMBER}/(?:vertices/c/{_NUMBER}/0/0|(?:pose|parameters)/c/0)
    |pose/parameters/(?:zarr\.json|c/0/0/0)
    |evaluation/(?:seen|unseen)/(?:zarr\.json|c/0/0)""",
    re.VERBOSE,
)
_LEFTOVER = re.compile(r"(?:[a-z0-9]+/)*[a-z0-9]+\.[0-9a-f]+\.partial")
"""What a killed writer leaves of an object."""
LONGEST_LIST = 2**27
"""Bytes of zarr.json and manifest/zarr.json, which grow with the dataset."""
_LONGEST_METADATA = 2**20
_LONGEST_ARRAY = LARGEST_CHUNK + 2**24

PATIENCE = 60.0
"""Seconds for which a remote store that does not answer is asked again."""
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 8.0
_S3: dict[str, Any] = {"config_kwargs": {"connect_timeout": 10, "read_timeout": 30, "retries": {"max_attempts": 0}}}
_CLOUDS = ("botocore", "aiobotocore", "aiohttp", "gcsfs", "google", "azure")
_HOPELESS = ("NoCredentialsError", "PartialCredentialsError", "DefaultCredentialsError", "ProfileNotFound")
_TRANSIENT = (errno.EBUSY, errno.EIO, errno.EREMOTEIO, errno.ETIMEDOUT)


def is_member(path: str) -> bool:
    """Whether a path is one that an object of a dataset can have."""
    return _MEMBER.fullmatch(path) is not None


def require_member(path: str) -> None:
    """Refuse a path that no object of a dataset has.

    Raises
    ------
    UnsafeFileError
        It is not of the layout: absolute, with "..", or just something else.
    """
    if not is_member(path):
        raise UnsafeFileError(f"the dataset names {path[:200]!r}, none of its objects. Do not trust what it holds")


def is_leftover(path: str) -> bool:
    """Whether a path is that of a file that a killed writer left behind."""
    return _LEFTOVER.fullmatch(path) is not None


def _limit_of(path: str) -> int:
    """The most bytes that an object can have, where nothing more is known of it."""
    if path in ("zarr.json", "manifest/zarr.json"):
        return LONGEST_LIST
    return _LONGEST_METADATA if path.endswith("zarr.json") else _LONGEST_ARRAY


def _require_short(path: str, content: Buffer) -> None:
    if path.endswith("zarr.json") and len(content) > _limit_of(path):
        raise DatasetError(
            f"{path} would have {len(content):,} bytes, more than the {_limit_of(path):,} that readers take. Make "
            "fewer and larger shards: data.store.poses_per_shard"
        )


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
        limit = _limit_of(path) if limit is None else limit
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

    def _place(self, path: str) -> Path:
        """Where an object is to be written or removed; a link there is replaced or removed itself, never followed.

        An empty folder in its place is removed; of one that holds something we do not know whose it is.
        """
        parent, _, name = path.rpartition("/")
        place = (resolve_within(self.root, parent) if parent else self.root) / name
        if place.is_dir() and not place.is_symlink():
            place.rmdir()
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
        _require_short(key, value)
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


class RemoteObjects(FsspecStore):
    """Objects on a store that fsspec knows, such as S3."""

    def read(self, path: str, *, limit: int | None = None, byte_range: ByteRequest | None = None) -> bytes | None:
        """Bytes of an object, all or a range; None where there is none.

        Raises
        ------
        UnsafeFileError
            See :func:`require_member`; or it is too long.
        StorageError
            The store does not answer.
        """
        found = sync(self._get(path, default_buffer_prototype(), byte_range, limit))
        return None if found is None else found.to_bytes()

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        return await self._get(key, prototype, byte_range, None)

    async def _get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None, limit: int | None
    ) -> Buffer | None:
        require_member(key)
        limit = _limit_of(key) if limit is None else limit
        asked = byte_range or RangeByteRequest(0, limit + 1)
        found = await self._patiently(partial(super().get, key, prototype, asked))
        if found is not None and len(found) > limit:
            raise UnsafeFileError(f"{self.url}/{key} is longer than the {limit:,} bytes that it can have")
        return found

    def sizes(self, paths: list[str]) -> dict[str, int]:
        """Size of each path that exists, asked for concurrently."""

        async def size(path: str) -> tuple[str, int] | None:
            try:
                return path, await self.getsize(path)
            except FileNotFoundError:
                return None

        async def all_sizes() -> list[tuple[str, int] | None]:
            return list(await asyncio.gather(*(size(path) for path in paths)))

        return dict(found for found in sync(all_sizes()) if found is not None)

    def names(self) -> list[str]:
        """Names of what lies directly at the store's place."""

        async def listed() -> list[str]:
            return [key async for key in FsspecStore.list_dir(self, "")]

        self.fs.invalidate_cache()
        return sorted(name.rstrip("/").rsplit("/", 1)[-1] for name in sync(self._patiently(listed)))

    @property
    def url(self) -> str:
        """Where it is, as a person would name it."""
        return str(self.fs.unstrip_protocol(self.path))

    async def getsize(self, key: str) -> int:
        require_member(key)
        return await self._patiently(partial(super().getsize, key))

    async def exists(self, key: str) -> bool:
        require_member(key)
        return await self._patiently(partial(super().exists, key))

    async def set(self, key: str, value: Buffer, byte_range: tuple[int, int] | None = None) -> None:
        require_member(key)
        _require_short(key, value)
        await self._patiently(partial(super().set, key, value, byte_range))

    async def delete(self, key: str) -> None:
        if not is_leftover(key):
            require_member(key)
        await self._patiently(partial(super().delete, key))

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        async def listed() -> list[str]:
            return [key async for key in FsspecStore.list_prefix(self, prefix)]

        self.fs.invalidate_cache()
        for key in await self._patiently(listed):
            yield key

    async def _patiently(self, ask: Callable[[], Awaitable[_T]]) -> _T:
        """Ask, and where the store does not answer ask again, ever more rarely, until patience ends."""
        end, pause = time.monotonic() + PATIENCE, _FIRST_PAUSE
        while True:
            try:
                return await ask()
            except Exception as error:
                if not _of_the_store(error):
                    raise
                if type(error).__name__ in _HOPELESS or time.monotonic() + pause > end:
                    raise self._unanswered(error) from error
                if pause == _FIRST_PAUSE:
                    log.warning("%s: %s; trying again for %.0f s", self.url, reason_of(error), PATIENCE)
            await asyncio.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE)

    def _unanswered(self, error: Exception) -> StorageError:
        return StorageError(
            f"{self.url} cannot be reached ({reason_of(error)}). Check its address and your credentials (for S3: "
            "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL), then run the same command again: it goes on "
            "from what is there"
        )


def _of_the_store(error: Exception) -> bool:
    """Whether an exception is about the way to the store or its load, and not about the object asked for."""
    if isinstance(error, (ConnectionError, TimeoutError)) or type(error).__module__.split(".")[0] in _CLOUDS:
        return True
    return isinstance(error, OSError) and error.errno in _TRANSIENT


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
    remote = RemoteObjects.from_url(url, storage_options=_S3 if on_s3 else None, read_only=read_only)
    assert isinstance(remote, RemoteObjects)
    if on_s3:
        remote.fs.retries = 1  # those of _patiently are the only ones, so that their time is known
    return remote
