"""One shard file, encoded and decoded whole or mesh by mesh: Zarr v3's sharding codec for our one kind of array.

Layout (Zarr v3, `sharding_indexed`): one chunk a mesh, each Blosc-compressed with byte shuffle and followed by its
crc32c; then the index, (offset, bytes) as little-endian uint64 for every row the shard has room for, all ones where a
row holds nothing; then the index' crc32c. Rows are the cells (identity, pose) of the shard in C order, and so are the
chunks: the meshes of an identity are one run of bytes. Zarr reads these files, and of a single identity it writes the
same bytes (tested; of several it orders chunks along a Morton curve). It takes about a quarter of a millisecond a mesh,
this a few microseconds.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import google_crc32c
import numcodecs.blosc
import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import ShardDamage, ShardMismatch

# Blosc's threads write their blocks in the order in which they finish; one thread makes the bytes reproducible.
numcodecs.blosc.use_threads = False

_NOTHING = 2**64 - 1
_CHECKSUM = struct.Struct("<I")
_BLOSC_HEADER = struct.Struct("<4B3I")  # two versions, flags, typesize; decoded, block and encoded bytes
LARGEST_CHUNK = 2**31 - 17
"""Bytes that Blosc can encode as one chunk; no other array is larger either."""
_COMPRESSES, _SLACK = 1000, 2**24


@dataclass(frozen=True)
class ShardCodec:
    """How the shards of one array are laid out: room for ``identities`` x ``poses`` meshes of ``vertices`` vertices."""

    identities: int
    poses: int
    vertices: int
    compressor: Literal["lz4", "zstd"]
    level: int

    @property
    def rows(self) -> int:
        """How many meshes a shard has room for."""
        return self.identities * self.poses

    @property
    def index_bytes(self) -> int:
        """Size of the index at the end of the file, its checksum included."""
        return 16 * self.rows + _CHECKSUM.size

    @property
    def mesh_bytes(self) -> int:
        """Size of a decoded mesh."""
        return 12 * self.vertices

    @property
    def most_chunk_bytes(self) -> int:
        """The largest possible size of one encoded mesh: stored as it is, with Blosc's header and a checksum."""
        return self.mesh_bytes + _BLOSC_HEADER.size + _CHECKSUM.size

    @property
    def most_bytes(self) -> int:
        """The largest possible size of a file."""
        return self.rows * self.most_chunk_bytes + self.index_bytes

    def rows_of(self, identities: int, poses: int) -> NDArray[np.int64]:
        """Rows of the cells of the first ``identities`` and ``poses``, identity by identity."""
        return np.add.outer(np.arange(identities) * self.poses, np.arange(poses)).ravel()

    def encode(self, meshes: Iterable[NDArray[np.float32]], identities: int, poses: int) -> bytes:
        """The file that holds the meshes of some identities in some poses; the cells after them are left empty.

        Parameters
        ----------
        meshes
            Vertices [mesh, vertex, 3], identity by identity, some meshes at a time.
        identities, poses
            How many of each these are.

        Raises
        ------
        ShardMismatch
            The meshes have other vertices, are more or fewer, or more than a shard has room for.
        """
        compress = partial(numcodecs.blosc.compress, cname=self.compressor.encode(), clevel=self.level)
        chunks = [compress(mesh) for some in meshes for mesh in self._checked(some)]
        if len(chunks) != identities * poses or identities > self.identities or poses > self.poses:
            room = f"with room for {self.identities} x {self.poses}"
            raise ShardMismatch(f"{len(chunks)} meshes instead of {identities} x {poses}, {room}")
        sizes = np.array([len(chunk) + _CHECKSUM.size for chunk in chunks], np.uint64)
        index = np.full((self.rows, 2), _NOTHING, "<u8")
        index[self.rows_of(identities, poses)] = np.stack([np.cumsum(sizes) - sizes, sizes], axis=1)
        return b"".join(part for chunk in (*chunks, index.tobytes()) for part in (chunk, _checksum(chunk)))

    def _checked(self, meshes: NDArray[np.float32]) -> NDArray[np.float32]:
        if meshes.shape[1:] != (self.vertices, 3):
            raise ShardMismatch(f"meshes of shape {meshes.shape[1:]} instead of {(self.vertices, 3)}")
        return np.ascontiguousarray(meshes, "<f4")

    def decode(self, file: bytes, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """The meshes [row, vertex, 3] of some rows of a file.

        Raises
        ------
        ShardDamage
            Cut short, a checksum that does not fit, or a mesh that is not there.
        """
        return self.decode_rows(file, self.decode_index(file[-self.index_bytes :]), rows)

    def decode_rows(
        self, part: bytes, index: NDArray[np.uint64], rows: NDArray[np.int64], *, start: int = 0
    ) -> NDArray[np.float32]:
        """The meshes [row, vertex, 3] of some rows, from the part of a file that begins at byte ``start``."""
        require_plausible(len(rows) * self.mesh_bytes, stored=len(part))
        meshes, view = np.empty((len(rows), self.vertices, 3), np.float32), memoryview(part)
        for mesh, (offset, size) in zip(meshes, self.places(index, rows), strict=True):
            begin = max(0, offset - start)
            self.decode_mesh(view[begin : begin + size], mesh)
        return meshes

    def decode_index(self, tail: bytes) -> NDArray[np.uint64]:
        """(offset, bytes) of every row [row, 2], from the last ``index_bytes`` of a file."""
        if len(tail) != self.index_bytes:
            raise ShardDamage(f"its index has {len(tail)} bytes instead of {self.index_bytes}")
        return np.frombuffer(_unsealed(tail, "its index"), "<u8").reshape(self.rows, 2)

    def places(self, index: NDArray[np.uint64], rows: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
        """Offset and size of the chunk of each of these rows."""
        for row, (offset, size) in zip(rows.tolist(), index[rows].tolist(), strict=True):
            if offset == _NOTHING:
                raise ShardDamage(f"its row {row} is empty")
            if size > self.most_chunk_bytes or offset > self.most_bytes:
                raise ShardDamage(f"its row {row} lies at an impossible place")
            yield offset, size

    def decode_mesh(self, chunk: bytes | memoryview, out: NDArray[np.float32]) -> None:
        """Decode one chunk into ``out`` [vertex, 3]."""
        content = _unsealed(chunk, "a mesh")
        if len(content) < _BLOSC_HEADER.size:
            raise ShardDamage("a mesh has no header")
        *_, decoded, _, encoded = _BLOSC_HEADER.unpack_from(content)
        if (decoded, encoded) != (out.nbytes, len(content)):  # Blosc believes its header
            raise ShardDamage(f"a mesh of {decoded} bytes instead of {out.nbytes}")
        try:
            numcodecs.blosc.decompress(content, out)
        except (RuntimeError, ValueError) as error:
            raise ShardDamage(f"a mesh cannot be decompressed ({error})") from error


def require_plausible(decoded: int, *, stored: int) -> None:
    """Refuse an array that is far larger than its stored bytes can mean, before memory is taken for it.

    Raises
    ------
    ShardDamage
        It is a thousand times as large (meshes compress to a half, at best to some hundredth).
    """
    if decoded > _COMPRESSES * stored + _SLACK:
        raise ShardDamage(f"its {decoded:,} bytes cannot be stored in {stored:,}")


def _checksum(content: bytes) -> bytes:
    return _CHECKSUM.pack(google_crc32c.value(content))


def _unsealed(content: bytes | memoryview, what: str) -> bytes:
    body = bytes(content[: -_CHECKSUM.size])
    if len(content) <= _CHECKSUM.size or _CHECKSUM.unpack(content[-_CHECKSUM.size :])[0] != google_crc32c.value(body):
        raise ShardDamage(f"the crc32c of {what} does not fit")
    return body
