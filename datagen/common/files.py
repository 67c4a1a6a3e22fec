"""Reading files that somebody else named: inside their folder only, regular files only, of a bounded size only.

A dataset, a run or a mesh that was downloaded says which files belong to it. What it says is not to be trusted: a name
may lead out of its folder, a link may lead anywhere, and a device such as /dev/zero never ends.

The small JSON files of a run are checked, too: a power failure, a full disk or a stranger may leave anything in their
place. What can be made again is taken as missing and made again; the unreadable file stays beside it as
NAME.unreadable.
"""

import errno
import hashlib
import logging
import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import IO, TypeVar

from filelock import FileLock
from pydantic import TypeAdapter, ValidationError

from datagen.common.errors import DamagedFileError, UnsafeFileError, storage_errors

log = logging.getLogger(__name__)
Value = TypeVar("Value")
SET_ASIDE = ".unreadable"
_LEFTOVER = re.compile(r"\..+\.[0-9a-f]{16}\.partial")

TEXT_LIMIT = 16 * 2**20
"""Bytes of a text or JSON file of ours; the longest that are written have some hundred thousand."""
LONGEST = 8 * 2**30
"""Bytes of a file that is hashed; weights of the widest network of the papers have 0.04 of it."""


def resolve_within(folder: Path, name: str) -> Path:
    """Return the path of ``name`` below ``folder``, symbolic links resolved; it need not exist.

    Raises
    ------
    UnsafeFileError
        The name is empty or absolute, holds "..", a NUL or a backslash, or a link leads out of the folder.
    """
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name or "\\" in name:
        raise UnsafeFileError(f"{folder} names {name!r}, which is not a path inside it. Do not trust what it holds")
    root = Path(os.path.realpath(folder))
    path = Path(os.path.realpath(root / name))
    if not path.is_relative_to(root) or path.is_symlink():  # what is a link still leads to itself
        raise UnsafeFileError(
            f"{folder} names {name!r}, a link that leads out of it. If it is yours, link the whole folder {root} "
            "instead (docs/tracking.md); else remove it, and do not trust what the folder holds"
        )
    return path


def files_below(folder: Path | str, *, but: str | None = None) -> Iterator["os.DirEntry[str]"]:
    """Every file below a folder, links to files among them, in no order; no link to a folder is followed.

    What is not there, or may not be looked into, holds none; folders whose path ends in ``but`` are not looked into.
    """
    with suppress(FileNotFoundError, NotADirectoryError, PermissionError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                if but is None or not entry.path.endswith(but):
                    yield from files_below(entry.path, but=but)
            elif entry.is_file(follow_symlinks=False) or (entry.is_symlink() and os.path.isfile(entry.path)):
                yield entry


def refuse_links_out(folder: Path, *, but: tuple[str, ...] = ()) -> None:
    """Raise if something directly in a folder, which need not exist, is a link that leads out of it.

    ``but`` are names that may be such links.

    Raises
    ------
    UnsafeFileError
        With the first such link.
    """
    if folder.is_dir():
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            if entry.is_symlink() and entry.name not in but:
                resolve_within(folder, entry.name)


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading, without waiting for anything.

    Raises
    ------
    UnsafeFileError
        It is not a regular file (a device, a pipe, a socket, a folder).
    OSError
        It is not there, or cannot be read.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer must not wait
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise UnsafeFileError(f"{path} is not a regular file") from error
        raise
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return open(descriptor, "rb")
    os.close(descriptor)
    raise UnsafeFileError(f"{path} is not a regular file")


def sha256_of(path: Path, *, limit: int = LONGEST) -> str:
    """Return the sha256 of a regular file of at most ``limit`` bytes, read in pieces.

    Raises
    ------
    UnsafeFileError
        It is not a regular file, or longer than that: a file of holes takes no room, but hours to hash.
    OSError
        It is not there, or cannot be read.
    """
    with open_regular(path) as file:
        _require_length(path, os.fstat(file.fileno()).st_size, limit)
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_bounded(path: Path, *, limit: int) -> bytes:
    """Return the content of a regular file of at most ``limit`` bytes.

    Raises
    ------
    UnsafeFileError
        It is not a regular file (a device, a pipe, a folder), or it is longer than that.
    OSError
        It is not there, or cannot be read.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        _require_length(path, size, limit)
        content = file.read(size + 1)  # some files, as those of /proc, have no size
    _require_length(path, len(content), limit)
    return content


def _require_length(path: Path, size: int, limit: int) -> None:
    if size > limit:
        raise UnsafeFileError(f"{path} is longer than the {limit:,} bytes that it can have ({size:,})")


def read_within(folder: Path, name: str, *, limit: int = TEXT_LIMIT) -> bytes:
    """Return the content of a regular file of at most ``limit`` bytes inside a folder.

    Raises
    ------
    UnsafeFileError
        It leads out of the folder, is not a regular file, or is longer than that.
    OSError
        It is not there, or cannot be read.
    """
    return read_bounded(resolve_within(folder, name), limit=limit)


def read_text_within(folder: Path, name: str, *, limit: int = TEXT_LIMIT) -> str:
    """Return the text of a UTF-8 file inside a folder; see :func:`read_within`.

    Raises
    ------
    DamagedFileError
        It is not UTF-8.
    UnsafeFileError, OSError
        As :func:`read_within` does.
    """
    try:
        return read_within(folder, name, limit=limit).decode()
    except UnicodeDecodeError as error:
        raise DamagedFileError(f"{folder / name} is not a text in UTF-8 ({error.reason})") from error


def lock_within(folder: Path, name: str) -> FileLock:
    """Return the lock that a file in a folder is; the file is made when the lock is taken.

    Raises
    ------
    UnsafeFileError
        It is a link that leads out of the folder, where another file would be made or opened, or no regular file.
    """
    path = resolve_within(folder, name)
    if path.exists() and not path.is_file():
        raise UnsafeFileError(f"{path} is not a regular file. Remove it, then run again")
    return FileLock(path)


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the names of a folder's files, where its file system can say so."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some network file systems know no such thing
            raise
    finally:
        os.close(descriptor)


@contextmanager
def atomic_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing that appears at ``path`` whole when the block ends, or not at all; creates its folder.

    Raises
    ------
    StorageError
        The disk is full, or the place cannot be written to.
    """
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.parent / f".{path.name}.{secrets.token_hex(8)}.partial"
        try:
            with open(temporary, "xb") as file:  # not mkstemp, whose files nobody but the owner may read
                yield file
                file.flush()
                os.fsync(file.fileno())  # renamed before its content is on the disk, a power failure leaves it empty
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left of files of :func:`atomic_file` in a folder, at any depth."""
    for file in files_below(folder):
        if _LEFTOVER.fullmatch(file.name):
            os.unlink(file)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file that appears whole or not at all, creating its folder.

    Raises
    ------
    StorageError
        The disk is full, or the place cannot be written to.
    """
    with atomic_file(path) as file:
        file.write(content)


def read_json(folder: Path, name: str, kind: TypeAdapter[Value]) -> Value:
    """Return what a JSON file in a folder holds.

    Raises
    ------
    DamagedFileError
        It is no JSON in UTF-8, nested too deep, or of another form than ``kind``.
    UnsafeFileError
        It leads out of the folder, is not a regular file, or is far too long.
    FileNotFoundError, OSError
        It is not there, or cannot be read.
    """
    content = read_within(folder, name)
    try:
        return kind.validate_json(content)
    except ValidationError as error:
        raise DamagedFileError(f"{folder / name} is unreadable ({fault_in(error)})") from error


def read_json_if_whole(folder: Path, name: str, kind: TypeAdapter[Value]) -> Value | None:
    """Return what a JSON file in a folder holds; None where there is none or, with a warning, an unreadable one."""
    try:
        return read_json(folder, name, kind)
    except FileNotFoundError:
        return None
    except (DamagedFileError, UnsafeFileError) as error:
        warn_once(f"{error}. It is taken as missing and made again")
        return None


def set_aside(path: Path) -> None:
    """Rename an unreadable file, if it is there, to NAME.unreadable, so that another can be written in its place."""
    with suppress(FileNotFoundError):
        os.replace(path, path.with_name(f"{path.name}{SET_ASIDE}"))


def fault_in(error: ValidationError) -> str:
    """Return the first fault of values that pydantic refused, in a line: where, and what."""
    fault = error.errors(include_url=False, include_input=False)[0]
    return ": ".join(filter(None, (".".join(map(str, fault["loc"]))[:200], fault["msg"])))


@lru_cache(maxsize=4096)
def warn_once(line: str) -> None:
    """Warn, unless this process has given the same warning before: a mirror looks every few seconds."""
    log.warning("%s", line)
