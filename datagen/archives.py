"""What may go wrong when an .npz of somebody else's is read, in one place for all who read some."""

import lzma
import struct
import zipfile
import zlib
from typing import IO, Any

import numpy as np

FAULTS = (
    OSError, EOFError, ValueError, TypeError, LookupError, OverflowError, SyntaxError, RuntimeError, MemoryError,
    struct.error, lzma.LZMAError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What zipfile and NumPy raise on archives that are damaged, encrypted, packed in unknown ways, or too large."""


def reason(error: BaseException) -> str:
    """What an error says of itself; its kind where it says nothing."""
    return str(error) or type(error).__name__


def array_header(content: IO[bytes]) -> tuple[tuple[int, ...], "np.dtype[Any]"]:
    """Shape and type of the array of an .npy file that is open at its first byte; reads no further than its header.

    Raises
    ------
    ValueError
        It is no such file, or of a version that is not known.
    """
    version = np.lib.format.read_magic(content)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(content)
    return shape, kind
