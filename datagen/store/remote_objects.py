"""The objects of a dataset on a remote store, which is asked again for a minute where it does not answer."""

import asyncio
import errno
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Any, TypeVar

from zarr.abc.store import ByteRequest, RangeByteRequest
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import FsspecStore

from datagen.common.errors import StorageError, UnsafeFileError, reason_of
from datagen.store.object_names import is_leftover, limit_of, require_member, require_short

log = logging.getLogger(__name__)

_T = TypeVar("_T")
PATIENCE = 60.0
"""Seconds for which a remote store that does not answer is asked again."""
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 8.0
_LISTED_FROM = 32  # so many sizes; a listing is a request for each thousand objects
_ASKED_AT_ONCE = 16  # where it does not list; a small web server takes a few connections at a time
S3_OPTIONS: dict[str, Any] = {
    "config_kwargs": {"connect_timeout": 10, "read_timeout": 30, "retries": {"max_attempts": 0}}
}
_CLOUDS = ("botocore", "aiobotocore", "aiohttp", "gcsfs", "google", "azure")
_HOPELESS = ("NoCredentialsError", "PartialCredentialsError", "DefaultCredentialsError", "ProfileNotFound")
_REFUSED = (401, 403, 405)  # of HTTP
_TRANSIENT = (errno.EBUSY, errno.EIO, errno.EREMOTEIO, errno.ETIMEDOUT)


class RemoteObjects(FsspecStore):
    """Objects on a store that fsspec knows, such as S3."""

    _warned = -PATIENCE

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
        limit = limit_of(key) if limit is None else limit
        asked = byte_range or RangeByteRequest(0, limit + 1)
        found = await self._patiently(partial(super().get, key, prototype, asked))
        if found is not None and len(found) > limit:
            raise UnsafeFileError(f"{self.url}/{key} is longer than the {limit:,} bytes that it can have")
        return found

    def sizes(self, paths: list[str]) -> dict[str, int]:
        """Size of each path that exists: listed where many are asked for, else asked for one by one."""
        for path in paths:
            require_member(path)
        listed: dict[str, int] = {}
        if len(paths) >= _LISTED_FROM:
            self.fs.invalidate_cache()
            listed = sync(self._patiently(self._listed_sizes))
        asked = asyncio.Semaphore(_ASKED_AT_ONCE)

        async def size(path: str) -> int | None:
            if path in listed:
                return listed[path]
            try:
                async with asked:
                    return await self.getsize(path)
            except FileNotFoundError:
                return None

        async def all_sizes() -> list[int | None]:
            return list(await asyncio.gather(*map(size, paths)))

        return {path: size for path, size in zip(paths, sync(all_sizes()), strict=True) if size is not None}

    async def _listed_sizes(self) -> dict[str, int]:
        """Size of every object, some thousand by a request; of none where the store does not list, or not sizes."""
        try:
            top = await self.fs._ls(self.path, detail=True)
            if any(about["type"] == "file" and about["size"] is None for about in top):
                return {}  # HTTP: a page for each folder, one after another, and no sizes
            found = await self.fs._find(self.path, detail=True)
        except Exception as error:
            if _of_the_store(error) and not _is_hopeless(error):
                raise
            return {}
        root = f"{self.path.strip('/')}/"
        sizes = ((path.lstrip("/").removeprefix(root), about.get("size")) for path, about in found.items())
        return {path: size for path, size in sizes if size is not None}

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
        require_short(key, value)
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
                if _is_hopeless(error) or time.monotonic() + pause > end:
                    raise self._unanswered(error) from error
                self._warn(error)
            await asyncio.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE)

    def _warn(self, error: Exception) -> None:
        """Say so once, however many requests are waiting."""
        if time.monotonic() - RemoteObjects._warned > PATIENCE:
            log.warning("%s: %s; trying again for %.0f s", self.url, reason_of(error), PATIENCE)
            RemoteObjects._warned = time.monotonic()

    def _unanswered(self, error: Exception) -> StorageError:
        if _is_refused(error):
            return StorageError(
                f"{self.url} refuses access ({reason_of(error)}). Check your credentials (for S3: AWS_ACCESS_KEY_ID, "
                "AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL); they need to list there, to read, and to write where "
                "anything is made (s3:ListBucket, s3:GetObject, s3:PutObject, s3:DeleteObject; without the first S3 "
                "also answers so where an object is missing). Then run the same command again: it resumes from what is "
                "there"
            )
        return StorageError(
            f"{self.url} cannot be reached ({reason_of(error)}). Check its address and your credentials (for S3: "
            "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL), then run the same command again: it resumes "
            "from what is there"
        )


def _is_hopeless(error: Exception) -> bool:
    """Whether it will be the same in a minute: no credentials, not the right ones, or not what is done there."""
    return _is_refused(error) or type(error).__name__ in _HOPELESS


def _is_refused(error: Exception) -> bool:
    return isinstance(error, PermissionError) or getattr(error, "status", None) in _REFUSED


def _of_the_store(error: Exception) -> bool:
    """Whether an exception is about the way to the store or its load, and not about the object asked for."""
    if (
        isinstance(error, (ConnectionError, TimeoutError, PermissionError))
        or type(error).__module__.split(".")[0] in _CLOUDS
    ):
        return True
    return isinstance(error, OSError) and error.errno in _TRANSIENT
