"""Hostile content of the binary files that hold arrays: .npz archives, pickles, checkpoints of torch, Zarr's shards."""

import io
import pickle
import random
import struct
import zipfile
from typing import Any

import google_crc32c
import numpy as np

_HEADERS = (
    "{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000, 66), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3.5), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': [('a', '<f8', (1000000000,))], 'fortran_order': False, 'shape': (3,), }",
    "{'descr': '<U1000000000', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<M8[s]', 'fortran_order': True, 'shape': (2,), }",
    "{'descr': '|V0', 'fortran_order': False, 'shape': (4294967296, 4294967296), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (" + "1," * 80 + "), }",
    "{'shape': " + "(" * 3000 + ")" * 3000 + "}",
    "__import__('os').system('touch /tmp/made')",
)


class _Runs:
    """Pickles as a call of the system's shell."""

    def __init__(self, canary: str) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        import os

        return os.system, (f"touch {self.canary}/made",)


def hostile_pickle(rng: random.Random, canary: str) -> bytes:
    """A pickle that runs something, or takes all memory, or is nested without end."""
    payloads = (
        lambda: pickle.dumps(_Runs(canary), rng.choice((0, 2, 4))),
        lambda: pickle.dumps({"v_template": _Runs(canary)}, 2),
        lambda: b"\x80\x02" + b"]" * 1 + b"(" * 100_000 + b".",
        lambda: b"\x80\x04\x96" + struct.pack("<Q", 2**40) + b".",
        lambda: b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"x.",
        lambda: b"\x80\x02" + b"}" + b"q\x00" + b"(" + b"h\x00" * 10 + b"u.",
        lambda: b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".",
        lambda: b"cbuiltins\neval\n(V1+1\ntR.",
        lambda: b"cnumpy\nload\n(V" + canary.encode() + b"/secret.txt\ntR.",
        lambda: b"\x80\x02r\xff\xff\xff\x7f.",
        lambda: b"\x80\x02Nr\xff\xff\xff\x7f.",
        lambda: b"I" + b"9" * 100_000 + b"\n.",
        lambda: b"",
    )
    return rng.choice(payloads)()


def in_pickle(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """A pickle replaced by a hostile one, or with one hostile thing before its end."""
    payload = hostile_pickle(rng, canary)
    if rng.random() < 0.5:
        place = rng.randrange(2, len(content))
        return content[:place] + payload.removesuffix(b".") + content[place:], f"hostile opcodes at {place}"
    return payload, f"is a hostile pickle of {len(payload)} bytes"


def in_npz(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """One member of an archive replaced, removed, renamed, or the archive filled up."""
    members = _members(content)
    name = rng.choice(list(members))
    change = rng.choice((_lying_header, _other_values, _other_values, _other_type, _objects, _removed, _renamed, _bomb))
    what = change(members, name, rng, canary)
    return _packed(members, compressed=change is _bomb or rng.random() < 0.2), f"{name}: {what}"


def _lying_header(members: dict[str, bytes], name: str, rng: random.Random, canary: str) -> str:
    text = rng.choice(_HEADERS).encode()
    header = text.ljust(max(117, len(text))) + b"\n"
    version = 1 if len(header) < 2**16 else 2
    length = struct.pack("<H" if version == 1 else "<I", len(header))
    members[name] = b"\x93NUMPY" + bytes([version, 0]) + length + header + bytes(800)
    return f"header {text[:60]!r}"


def _other_values(members: dict[str, bytes], name: str, rng: random.Random, canary: str) -> str:
    array = np.load(io.BytesIO(members[name]), allow_pickle=False).copy()
    if array.dtype.kind not in "iuf" or not array.size:
        return _other_type(members, name, rng, canary)
    value = rng.choice((0, 1, -1, 2**31 - 1, 10**9, 1e300, np.nan, np.inf, -np.inf))
    with np.errstate(all="ignore"):
        place = rng.randrange(array.size)
        array.reshape(-1)[place : place + rng.choice((1, 1, array.size))] = np.asarray(value).astype(array.dtype)
    members[name] = _saved(array)
    return f"holds {value}"


def _other_type(members: dict[str, bytes], name: str, rng: random.Random, canary: str) -> str:
    array = np.load(io.BytesIO(members[name]), allow_pickle=False)
    others = (
        lambda: array.astype("U8"), lambda: array[None], lambda: array[:0], array.ravel, lambda: array[:1],
        lambda: np.array(3.0), lambda: np.array("x" * 5000), lambda: array.T, lambda: np.zeros((0, 3)),
        lambda: np.zeros(3, "M8[s]"), lambda: np.zeros(3, [("a", "f8"), ("b", "U3")]), lambda: array.astype(bool),
        lambda: array.astype(complex), lambda: np.array(["\x1b[2J", "a\nb"]), lambda: np.zeros((2, 0, 3)),
    )  # fmt: skip
    try:
        other = np.atleast_1d(rng.choice(others)())
    except (ValueError, TypeError, IndexError):
        other = np.zeros(0)
    members[name] = _saved(other)
    return f"is {other.dtype} {list(other.shape)}"


def _objects(members: dict[str, bytes], name: str, rng: random.Random, canary: str) -> str:
    out = io.BytesIO()
    np.lib.format.write_array(out, np.array([None], object), allow_pickle=True)
    start = out.getvalue()
    members[name] = start[: start.index(b"\n") + 1] + hostile_pickle(rng, canary)
    return "is an array of objects"


def _removed(members: dict[str, bytes], name: str, rng: random.Random, canary: str) -> str:
    del members[name]
    return "is removed"


def _renamed(members: dict[str, bytes], name: str, rng: random.Random, canary: str) -> str:
    other = rng.choice(("../../canary/made.npy", f"{canary}/made.npy", "x" * 5000 + ".npy", "\x1b[2J.npy", "", "poses"))
    members[other] = members.pop(name)
    return f"is renamed {other[:40]!r}"


def _bomb(members: dict[str, bytes], name: str, rng: random.Random, canary: str) -> str:
    """200 MB of zeros in 1 MB."""
    rows = 200 * 2**20 // 24
    members[name] = _saved(np.zeros((1, 3)))[:128].replace(b"(1, 3), }       ", b"(%d, 3), }" % rows) + bytes(rows * 24)
    return "is 200 MB of zeros"


def _members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _packed(members: dict[str, bytes], *, compressed: bool = False) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(
        out, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED, compresslevel=1
    ) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name or "."), content, archive.compression)
    return out.getvalue()


def _saved(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, array, allow_pickle=False)
    return out.getvalue()


def in_torch(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """A file of torch.save with a hostile pickle in it, another value, or without a part."""
    if rng.random() < 0.5:
        members = _members(content)
        name = next(name for name in members if name.endswith("data.pkl"))
        members[name], what = in_pickle(members[name], rng, canary)
        return _packed(members), what
    import torch

    from tests.fuzz.structures import changed

    state = torch.load(io.BytesIO(content), weights_only=True)
    state, what = changed(state, rng, canary)
    out = io.BytesIO()
    torch.save(state, out)
    return out.getvalue(), what


def in_shard(content: bytes, rng: random.Random, canary: str) -> tuple[bytes, str]:
    """A number of a shard's index changed, or bytes of a mesh, each with the checksum that fits."""
    rows = 4  # as the tiny dataset has in a shard
    index = np.frombuffer(content[-16 * rows - 4 : -4], "<u8").copy()
    if rng.random() < 0.5:
        place = rng.randrange(len(index))
        index[place] = rng.choice((0, 1, 4, 5, 2**32, 2**63, 2**64 - 2, int(index[place]) + 1, len(content)))
        return content[: -16 * rows - 4] + _sealed(index.tobytes()), f"index {place} becomes {index[place]}"
    offset, size = map(int, index[:2])
    chunk = bytearray(content[offset : offset + size - 4])
    for _ in range(rng.choice((1, 3))):
        place = rng.randrange(16) if rng.random() < 0.7 else rng.randrange(len(chunk))
        chunk[place] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    return content[:offset] + _sealed(bytes(chunk)) + content[offset + size :], "bytes of a compressed mesh"


def _sealed(content: bytes) -> bytes:
    return content + struct.pack("<I", google_crc32c.value(content))
