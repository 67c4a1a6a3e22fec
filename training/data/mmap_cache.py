"""A file of normalised vertices that all processes of a machine map, kept from one run to the next.

Layout, little-endian: one page that holds a JSON object (format, key, sizes) padded with blanks; float32 vertices
[vertex, 3], mesh after mesh; the crc32c of each chunk, uint32. The key stands for the dataset's content and the
identities; it is in the file's name, too, so that another dataset's file is another file.
"""

import errno
import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import google_crc32c
import numpy as np
import torch
from filelock import FileLock, Timeout
from torch import Tensor

from datagen.common.errors import storage_errors
from datagen.common.resources import bytes_text
from training.data.vertex_layout import Floats, Layout, decode

FORMAT = 1
"""Of the file (with its chunks, :meth:`Layout.chunks`) and of how vertices are normalised: another is another file."""
_HEAD = 4096
_PATIENCE = 10.0  # seconds until a person is told what takes so long

Log = Callable[[str], None]


def mapped_path(layout: Layout, folder: Path) -> Path:
    """The file of a layout in a folder of such files."""
    return folder / f"{_key(layout)[:32]}.vertices"


def _key(layout: Layout) -> str:
    dataset = layout.dataset
    about = [FORMAT, dataset.uuid, dataset.attributes["manifest_sha256"], layout.identities]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()


def _head(layout: Layout) -> bytes:
    about = {"what": "dsffnet vertices", "format": FORMAT, "key": _key(layout), "vertices": layout.vertices}
    return json.dumps(about).encode().ljust(_HEAD)


def map_vertices(layout: Layout, folder: Path, *, log: Log) -> Tensor:
    """The normalised vertices [vertex, 3] of a layout, mapped from its file, which is made if there is no sound one.

    One process makes it while the others wait; it appears under its name when it is whole. It is read once from end to
    end and its checksums compared, so that what is damaged is made again and the pages are in memory.

    Raises
    ------
    StorageError
        The file cannot be written: full disk, no permission.
    DatasetError
        A shard of the dataset is missing or damaged.
    """
    path = mapped_path(layout, folder)
    sound = False
    while not sound:
        looks, fault = _looks(path), _fault(path, layout, log=log)
        sound = fault is None or _made(path, layout, looks, fault, log=log)
    mapped = np.memmap(path, "<f4", mode="c", offset=_HEAD, shape=(layout.vertices, 3))
    return torch.from_numpy(mapped)


def _made(path: Path, layout: Layout, looks: tuple[int, ...] | None, fault: str, *, log: Log) -> bool:
    """Write a file in the place of a faulty one; False if another process has done so since that ``looks`` were taken.

    What another has written is to be checked after the lock is released, so that many processes can at once.
    """
    with _locked(path, log=log):
        if _looks(path) != looks:
            return False
        if looks:
            log(f"{path} is not what was written ({fault}): made again from {layout.dataset.url}")
        _write(path, layout)
    return True


def _looks(path: Path) -> tuple[int, ...] | None:
    """What differs between two files that had the same name; None where there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


@contextmanager
def _locked(path: Path, *, log: Log) -> Iterator[None]:
    """Hold the file's lock, which the operating system drops if this process dies."""
    lock = FileLock(f"{path}.lock")
    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=_PATIENCE)
        except Timeout:  # an OSError, too
            log(f"waiting for another process that makes {path}")
            lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _fault(path: Path, layout: Layout, *, log: Log) -> str | None:
    """What is wrong with a file; None if it is the layout's and every bit is as it was written."""
    sizes = [12 * int(layout.counts[meshes].sum()) for meshes in layout.chunks()]
    try:
        with open(path, "rb") as file:
            found_size, right = os.fstat(file.fileno()).st_size, _HEAD + layout.bytes + 4 * len(sizes)
            if found_size != right:
                return f"{found_size} bytes instead of {right}"
            if file.read(_HEAD) != _head(layout):
                return "its first page is another's"
            found = [google_crc32c.value(file.read(size)) for size in _telling(sizes, path, log)]
            stated = np.frombuffer(file.read(), "<u4").tolist()
    except OSError as error:
        return error.strerror or str(error)
    return None if found == stated else "a checksum does not fit"


def _telling(sizes: list[int], path: Path, log: Log) -> Iterator[int]:
    """The same sizes; a person is told once if going through them takes long."""
    began, told = time.monotonic(), False
    for size in sizes:
        if not told and time.monotonic() - began > _PATIENCE:
            log(f"checking {path} ({bytes_text(sum(sizes))}) against its checksums before it is used")
            told = True
        yield size


def _write(path: Path, layout: Layout) -> None:
    """Write the file beside its place, then move it there. What a killed process left half-written is overwritten."""
    partial = path.with_suffix(".partial")
    try:
        with _writing(path, needed=layout.bytes), open(partial, "wb") as file:
            _reserve(file.fileno(), _HEAD + layout.bytes)
            file.write(_head(layout))
            file.flush()
            checksums = _write_vertices(file.fileno(), layout)
            file.seek(_HEAD + layout.bytes)
            file.write(np.array(checksums, "<u4").tobytes())
            file.flush()
            os.fsync(file.fileno())
        with _writing(path):
            os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _write_vertices(descriptor: int, layout: Layout) -> list[int]:
    """Write every chunk at its place; the checksum of each, in their order."""
    checksums: dict[int, int] = {}
    guard = threading.Lock()

    def put(start: int, vertices: Floats) -> None:
        content = np.ascontiguousarray(vertices, "<f4").tobytes()
        _write_all(descriptor, content, _HEAD + 12 * start)
        with guard:
            checksums[start] = google_crc32c.value(content)

    decode(layout, put)
    return [checksums[start] for start in sorted(checksums)]


def _write_all(descriptor: int, content: bytes, place: int) -> None:
    view = memoryview(content)
    while view:
        written = os.pwrite(descriptor, view, place)
        view, place = view[written:], place + written


def _reserve(descriptor: int, size: int) -> None:
    """Take the room on the disk at once, so that a full one is known before anything is decoded."""
    if not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # a file system that cannot do it
            raise


def _writing(path: Path, *, needed: int = 0) -> AbstractContextManager[None]:
    size = f" ({bytes_text(needed)})" if needed else ""
    return storage_errors(
        f"the cache {path}{size}",
        advice="Free some room (old .vertices files there may go), choose another folder: --set "
        "training.cache_folder=..., or --set training.cache=stream",
    )
