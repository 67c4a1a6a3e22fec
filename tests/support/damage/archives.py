"""Damage to .npz files, as broken downloads, other programs and malice make it."""

import io
import struct
import zipfile
from collections.abc import Callable

Damage = Callable[[bytes], bytes]


def _overwritten(content: bytes) -> bytes:
    """Compressed bytes that are none: zlib's own error."""
    start = content.index(b".npy") + 60
    return content[:start] + b"\xff" * 40 + content[start + 40 :]


def _flipped(content: bytes) -> bytes:
    """One bit, which a checksum tells at the latest."""
    changed = bytearray(content)
    changed[content.index(b".npy") + 60] ^= 1
    return bytes(changed)


def _in_directory(offset: int, value: int) -> Damage:
    """A 16-bit field of every member, in the archive's directory and at the members themselves."""

    def change(content: bytes) -> bytes:
        changed = bytearray(content)
        for mark, at in ((b"PK\x01\x02", offset + 2), (b"PK\x03\x04", offset)):
            place = content.find(mark)
            while place >= 0:
                struct.pack_into("<H", changed, place + at, value)
                place = content.find(mark, place + 1)
        return bytes(changed)

    return change


def _lying_header(content: bytes) -> bytes:
    """Arrays whose headers promise 1e13 rows."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(out, "w") as target:
        for name in source.namelist():
            text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000, 66), }"
            header = text.ljust(117) + b"\n"
            target.writestr(name, b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(800))
    return out.getvalue()


DAMAGES: dict[str, Damage] = {
    "overwritten": _overwritten,
    "a bit flipped": _flipped,
    "cut off": lambda content: content[:-100],
    "half of it": lambda content: content[: len(content) // 2],
    "empty": lambda _: b"",
    "text": lambda _: b"no archive",
    "an end without a beginning": lambda _: b"PK\x05\x06",
    "encrypted": _in_directory(6, 1),
    "packed in an unknown way": _in_directory(8, 97),
    "a header of 1e13 rows": _lying_header,
}
