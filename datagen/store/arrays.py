"""Arrays of a dataset, written and read with the format in mind: anything else is damage, and takes no memory.

Metadata are written by this module to the byte, so that a reader compares them as a whole. Zarr reads them (tested).
"""

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import zarr
from numcodecs import Zstd
from numpy.typing import NDArray

from datagen.common.errors import DatasetError, ShardDamage, UnsafeFileError, reason_of
from datagen.grid import GridArray
from datagen.store.codec import LARGEST_CHUNK, ShardCodec, require_plausible
from datagen.store.objects import put_bytes, read_bytes

Shape = tuple[int | None, ...]
"""Of an array, as far as it is known; None where any size will do."""
_LEVEL = 3
_LITTLE = {"name": "bytes", "configuration": {"endian": "little"}}
_CRC = {"name": "crc32c"}


class ArrayDamage(ValueError):
    """An array, or a group's attributes, is not as the format has it; ``path`` is the object to make again."""

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path, self.reason = path, reason


def put_array(group: zarr.Group, path: str, values: NDArray[Any], dimensions: Sequence[str]) -> None:
    """Store a small array in one chunk: little-endian, zstd with its checksum. What is there already is left alone.

    Raises
    ------
    DatasetError
        It has more bytes than :func:`read_array` takes.
    """
    if values.nbytes > LARGEST_CHUNK:
        raise DatasetError(
            f"{path} would have {values.nbytes:,} bytes, one array holds {LARGEST_CHUNK:,}. Make several datasets of "
            "fewer identities or poses"
        )
    put_json(group, f"{path}/zarr.json", _small_metadata(values.dtype, values.shape, dimensions))
    if values.size:
        put_bytes(
            group, _chunk_path(path, values.shape), Zstd(_LEVEL, checksum=True).encode(np.ascontiguousarray(values))
        )


def put_json(group: zarr.Group, path: str, document: dict[str, Any]) -> None:
    """Store metadata, unless it is there already."""
    put_bytes(group, path, json.dumps(document, indent=2).encode())


def put_group(group: zarr.Group, path: str, attributes: dict[str, Any] | None = None) -> None:
    """Store the metadata of a group below the root."""
    put_json(group, f"{path}/zarr.json", {"attributes": attributes or {}, "zarr_format": 3, "node_type": "group"})


def read_array(group: zarr.Group, path: str, dtype: str, shape: Shape) -> NDArray[Any]:
    """Return a small array.

    Parameters
    ----------
    dtype
        As Zarr names it: int32, float64.

    Raises
    ------
    ArrayDamage
        It is missing, of another shape, type or codec, or cannot be read or decoded.
    """
    found = _checked_shape(group, path, np.dtype(dtype), shape)
    size, chunk = math.prod(found) * np.dtype(dtype).itemsize, _chunk_path(path, found)
    if not size:
        return np.empty(found, dtype)
    content = _read(group, chunk, limit=size + size // 128 + 2**10)
    try:
        require_plausible(size, stored=len(content))
        values = np.empty(found, dtype)
        _decompress(content, values)
    except (RuntimeError, ValueError, IndexError) as error:
        raise ArrayDamage(chunk, f"cannot be decoded ({error})") from error
    return values


def check_vertices(group: zarr.Group, array: GridArray, codec: ShardCodec, *, stored: int) -> None:
    """Refuse an array of vertices whose metadata are not as the format has them.

    Parameters
    ----------
    stored
        Bytes of its first shard, which must not be a thousandth of what its meshes take.

    Raises
    ------
    ArrayDamage
        The metadata are missing or others, or name meshes that cannot be.
    """
    path = f"{array.path}/vertices/zarr.json"
    _compare(path, read_json(group, path), vertices_metadata(array, codec))
    first = next(array.shards())
    try:
        require_plausible(first.rows * codec.mesh_bytes, stored=stored)
    except ShardDamage as error:
        raise ArrayDamage(path, f"meshes of {array.vertices} vertices: {error}") from error


def read_json(group: zarr.Group, path: str) -> dict[str, Any]:
    """Return the metadata of an array or a group.

    Raises
    ------
    ArrayDamage
        They are missing, cannot be read, or are no JSON object.
    """
    try:
        document = json.loads(_read(group, path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, ArrayDamage):
            raise
        raise ArrayDamage(path, f"no JSON ({reason_of(error)})") from error
    if not isinstance(document, dict):
        raise ArrayDamage(path, "no metadata")
    return document


def vertices_metadata(array: GridArray, codec: ShardCodec) -> dict[str, Any]:
    """The metadata of an array of vertices: NaN fill, one mesh a chunk, Blosc with shuffle, crc32c."""
    blosc = {"typesize": 4, "cname": codec.compressor, "clevel": codec.level, "shuffle": "shuffle", "blocksize": 0}
    mesh = [codec.vertices, 3]
    sharding = {
        "chunk_shape": [1, 1, *mesh],
        "codecs": [_LITTLE, {"name": "blosc", "configuration": blosc}, _CRC],
        "index_codecs": [_LITTLE, _CRC],
        "index_location": "end",
    }
    return _metadata(
        np.dtype(np.float32),
        array.shape,
        ("identity", "pose", "vertex", "coordinate"),
        chunk=(codec.identities, codec.poses, *mesh),
        codecs=[{"name": "sharding_indexed", "configuration": sharding}],
        fill="NaN",
    )


def _small_metadata(dtype: np.dtype[Any], shape: Sequence[int], dimensions: Sequence[str]) -> dict[str, Any]:
    zstd = {"name": "zstd", "configuration": {"level": _LEVEL, "checksum": True}}
    order = {"name": "bytes"} if dtype.itemsize == 1 else _LITTLE
    fill = 0.0 if dtype.kind == "f" else 0
    return _metadata(dtype, shape, dimensions, chunk=[max(1, size) for size in shape], codecs=[order, zstd], fill=fill)


def _metadata(
    dtype: np.dtype[Any],
    shape: Sequence[int],
    dimensions: Sequence[str],
    *,
    chunk: Sequence[int],
    codecs: Any,
    fill: Any,
) -> dict[str, Any]:
    """Metadata of an array as Zarr v3 has them."""
    return {
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill,
        "codecs": codecs,
        "attributes": {},
        "dimension_names": list(dimensions),
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def _checked_shape(group: zarr.Group, path: str, dtype: np.dtype[Any], shape: Shape) -> tuple[int, ...]:
    """The shape in a small array's metadata, which must be as this module writes them."""
    where = f"{path}/zarr.json"
    document = read_json(group, where)
    found: Any = document.get("shape")
    if not _fits(found, shape) or math.prod(found) * dtype.itemsize > LARGEST_CHUNK:
        raise ArrayDamage(where, f"shape {_brief(found)} instead of {_brief(shape)}")
    expected = _small_metadata(dtype, found, ())
    _compare(where, document, {name: value for name, value in expected.items() if name != "dimension_names"})
    return tuple(found)


def _compare(path: str, document: dict[str, Any], expected: dict[str, Any]) -> None:
    if document.get("shape") != expected["shape"]:
        raise ArrayDamage(path, f"shape {_brief(document.get('shape'))} instead of {_brief(expected['shape'])}")
    for name, value in expected.items():
        if document.get(name) != value:
            raise ArrayDamage(path, f"another {name.replace('_', ' ')} than the format has")


def _fits(found: Any, shape: Shape) -> bool:
    return (
        isinstance(found, list)
        and len(found) == len(shape)
        and all(type(size) is int and size >= 0 for size in found)
        and all(wanted in (None, size) for size, wanted in zip(found, shape, strict=True))
    )


def _chunk_path(path: str, shape: Sequence[int]) -> str:
    return "/".join([path, "c", *"0" * len(shape)])


def _read(group: zarr.Group, path: str, *, limit: int | None = None) -> bytes:
    try:
        content = read_bytes(group, path, limit=limit)
    except (OSError, UnsafeFileError) as error:
        raise ArrayDamage(path, f"cannot be read: {reason_of(error)}") from error
    if content is None:
        raise ArrayDamage(path, "missing")
    return content


def _decompress(content: bytes, out: NDArray[Any]) -> None:
    stated = _content_size(content)
    if stated != out.nbytes:
        raise ValueError(f"{stated} bytes instead of {out.nbytes}")
    Zstd().decode(content, out.reshape(-1).view(np.uint8))


def _content_size(frame: bytes) -> int | None:
    """The decoded size that a Zstandard frame states (RFC 8878, 3.1.1.1); None where it states none."""
    flags, single = frame[4] >> 6, frame[4] >> 5 & 1
    width = (single, 2, 4, 8)[flags]
    start = 5 + (1 - single) + (0, 1, 2, 4)[frame[4] & 3]
    size = int.from_bytes(frame[start : start + width], "little")
    return size + 256 * (flags == 1) if width else None


def _brief(shape: Any) -> str:
    """A shape for a message: ``(12, any, 3)``."""
    if not isinstance(shape, (list, tuple)) or len(shape) > 4:
        return "of something else"
    return "(" + ", ".join("any" if size is None else str(size)[:24] for size in shape) + ")"
