"""Reading files that somebody else named: inside their folder only, regular files only, of a bounded size only.

A dataset, a run or a mesh that was downloaded says which files belong to it. What it says is not to be trusted: a name
may lead out of its folder, a link may lead anywhere, and a device such as /dev/zero never ends.
"""

import os
import stat
from io import BufferedReader
from pathlib import Path, PurePosixPath

from datagen.errors import UnsafeFileError


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
    if not path.is_relative_to(root):
        raise UnsafeFileError(f"{folder} names {name!r}, a link that leads out of it. Do not trust what it holds")
    return path


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading, without waiting for anything.

    Raises
    ------
    UnsafeFileError
        It is not a regular file (a device, a pipe, a folder).
    OSError
        It is not there, or cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer must not wait
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return open(descriptor, "rb")
    os.close(descriptor)
    raise UnsafeFileError(f"{path} is not a regular file")


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
        content = file.read(min(limit, size) + 1)
    if len(content) > limit:
        raise UnsafeFileError(f"{path} is longer than the {limit:,} bytes that it can have ({size:,})")
    return content
