"""Reading files that somebody else named: inside their folder only, regular files only, of a bounded size only.

A dataset, a run or a mesh that was downloaded says which files belong to it. What it says is not to be trusted: a name
may lead out of its folder, a link may lead anywhere, and a device such as /dev/zero never ends.
"""

import os
import stat
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


def read_bounded(path: Path, *, limit: int) -> bytes:
    """Return the content of a regular file of at most ``limit`` bytes.

    Raises
    ------
    UnsafeFileError
        It is not a regular file (a device, a pipe, a folder), or it is longer than that.
    OSError
        It is not there, or cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer must not wait
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise UnsafeFileError(f"{path} is not a regular file")
        with open(descriptor, "rb", closefd=False) as file:
            content = file.read(limit + 1)
    finally:
        os.close(descriptor)
    if len(content) > limit:
        raise UnsafeFileError(f"{path} is longer than the {limit:,} bytes that it can have ({status.st_size:,})")
    return content
