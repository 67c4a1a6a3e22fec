"""Reading an .npz of somebody else's: what may go wrong, and arrays whose size is known before memory is taken."""

import io
import lzma
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import UnsafeFileError
from datagen.common.files import open_regular

FAULTS = (
    OSError, EOFError, ValueError, TypeError, LookupError, OverflowError, SyntaxError, RuntimeError, MemoryError,
    struct.error, lzma.LZMAError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What zipfile and NumPy raise on archives that are damaged, encrypted, packed in unknown ways, or too large."""


Header = tuple[tuple[int, ...], "np.dtype[Any]"]
"""Shape and type of an array."""
LARGEST = 2**30
"""Bytes at most of an archive, and of all arrays that are read of it; SMPL-X's arrays have a third of it."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # NumPy's; others unpack without a limit
_DIRECTORY = 2**20
"""Bytes at most of an archive's directory, which is read whole; archives of poses and models have some thousand."""
HEADER = 2**14
"""Bytes in which the header of an .npy file ends: NumPy takes none of more than 10,000 letters."""


@contextmanager
def opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive for reading.

    Raises
    ------
    ValueError
        It is no regular file, or it or its directory is longer than any.
    """
    try:
        file = open_regular(path)
    except UnsafeFileError as error:
        raise ValueError("it is no regular file") from error
    with file:
        if os.fstat(file.fileno()).st_size > LARGEST:
            raise ValueError(f"it has more than {LARGEST:,} bytes")
        _require_short_directory(file)
        with zipfile.ZipFile(file) as archive:
            yield archive


def _require_short_directory(file: IO[bytes]) -> None:
    """Ask what ZipFile itself goes by, ZIP64 included: it reads so many bytes, and makes an object of each entry."""
    end = zipfile._EndRecData(file)  # type: ignore[attr-defined]
    size = end[zipfile._ECD_SIZE] if end else 0  # type: ignore[attr-defined]
    if size > _DIRECTORY:
        raise ValueError(f"its directory has {size:,} bytes, at most {_DIRECTORY:,} are read")


def read_arrays(
    path: Path, names: tuple[str, ...], *, pickled: Callable[[str, BinaryIO], NDArray[Any]] | None = None
) -> dict[str, NDArray[Any]]:
    """Those of the named arrays that an .npz holds. Its other arrays are not looked at.

    Parameters
    ----------
    path, names
        The archive, and the arrays that are wanted.
    pickled
        Reads an array of Python objects, given its name and the file at the first byte of its pickle. Without it
        such arrays are refused: NumPy's own reading runs what they say.

    Raises
    ------
    one of FAULTS
        It is no sound .npz, or its arrays would take more than :data:`LARGEST`.
    """
    found: dict[str, NDArray[Any]] = {}
    with opened(path) as archive:
        there = set(archive.namelist())
        for name in names:
            if f"{name}.npy" in there:
                left = LARGEST - sum(array.nbytes for array in found.values())
                _, kind = member_header(archive, f"{name}.npy")
                content = io.BytesIO(_member_bytes(archive, f"{name}.npy", left))
                if pickled and kind.hasobject:
                    array_header(content)  # the pickle comes after it
                    found[name] = pickled(name, content)
                else:
                    found[name] = np.lib.format.read_array(content, allow_pickle=False)
    return found


def _member_bytes(archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """Unpack a member, of whatever bytes it has no more than it declares."""
    member = _bounded(archive, name, limit)
    with archive.open(member) as content:
        return content.read(member.file_size)


def _bounded(archive: zipfile.ZipFile, name: str, limit: int) -> zipfile.ZipInfo:
    """A member of which no more is unpacked than it declares; it declares no more than ``limit``."""
    member = archive.getinfo(name)
    if member.file_size > limit:
        raise ValueError(f"{name} would take {member.file_size:,} bytes, at most {limit:,} are read")
    if member.compress_type not in _METHODS:
        raise ValueError(f"{name} is packed by method {member.compress_type}, which NumPy does not use")
    return member


def member_header(archive: zipfile.ZipFile, name: str) -> Header:
    """Shape and type of the array that a member holds; no more than its beginning is unpacked.

    Raises
    ------
    ValueError
        It holds none, or would take more than :data:`LARGEST`, or is packed in another way than NumPy's, or is
        shorter than its shape: NumPy would take the memory first.
    """
    member = _bounded(archive, name, LARGEST)
    with archive.open(member) as content:
        shape, kind = array_header(io.BytesIO(content.read(HEADER)))
    if math.prod(shape) * max(kind.itemsize, 1) > member.file_size and not kind.hasobject:
        raise ValueError(f"{name} is shorter than its shape {shape}")
    return shape, kind


def array_header(content: IO[bytes]) -> Header:
    """Shape and type of the array of an .npy file that is open at its first byte; reads no further than its header.

    Raises
    ------
    ValueError
        It is no such file, or of a version that is not known.
    """
    version = np.lib.format.read_magic(content)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"its format version {version} is not known")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(content)
    return shape, kind
