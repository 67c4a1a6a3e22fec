"""Arrays of a dataset, read with the format in mind: another shape, type or codec is damage, and takes no memory."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import zarr
from numcodecs import Zstd
from numpy.typing import NDArray

from datagen.common.errors import UnsafeFileError, reason_of
from datagen.store.codec import LARGEST_CHUNK, require_plausible
from datagen.store.schema import identity_name, parse_json, read_bytes, vertices_path

_NUMBER = re.compile("[0-9]{1,9}")
Shape = tuple[int | None, ...]
"""Of an array, as far as it is known; None where any size will do."""


class ArrayDamage(ValueError):
    """An array, or a group's attributes, is not as the format has it; ``path`` is the object to make again."""

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path, self.reason = path, reason


def read_array(group: zarr.Group, path: str, dtype: str, shape: Shape, *, objects: Iterable[str] = ()) -> NDArray[Any]:
    """A small array: one chunk, little-endian, zstd.

    Parameters
    ----------
    dtype
        As Zarr names it: int32, float64.
    objects
        Paths that the dataset's manifest names. A chunk that is not there is all zeros, unless the manifest has it.

    Raises
    ------
    ArrayDamage
        It is missing, of another shape, type or codec, or cannot be read or decoded.
    """
    found = _shape_of(group, path, dtype, shape, codecs=[("bytes", "little"), ("zstd", None)])
    size, chunk = math.prod(found) * np.dtype(dtype).itemsize, f"{path}/c/" + "/".join("0" * len(found))
    content = _read(group, chunk, limit=size + size // 128 + 2**10) if size else None
    if content is None and size and chunk in objects:
        raise ArrayDamage(chunk, "missing")
    try:
        require_plausible(size, stored=len(content or b""))
        values = np.zeros(found, dtype)
        if content:
            _decompress(content, values)
    except (RuntimeError, ValueError, IndexError) as error:
        raise ArrayDamage(chunk, f"cannot be decoded ({error})") from error
    return values


def _read(group: zarr.Group, path: str, *, limit: int | None = None) -> bytes | None:
    try:
        return read_bytes(group, path, limit=limit)
    except (OSError, UnsafeFileError) as error:
        raise ArrayDamage(path, f"cannot be read: {reason_of(error)}") from error


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


def read_vertex_count(group: zarr.Group, identity: int, *, rows: int | None, rows_per_shard: int) -> int:
    """Vertices of an identity's meshes, from the metadata of their array.

    Raises
    ------
    ArrayDamage
        The metadata is missing, or not what the format says, for so many ``rows`` and rows of a shard.
    """
    return read_vertices_shape(group, identity, rows=rows, rows_per_shard=rows_per_shard)[1]


def read_vertices_shape(
    group: zarr.Group, identity: int, *, rows: int | None = None, rows_per_shard: int
) -> tuple[int, ...]:
    """Shape (row, vertex, 3) of the array of an identity's meshes, see :func:`read_vertex_count`."""
    inner = [("bytes", "little"), ("blosc", None), ("crc32c", None)]
    codecs = [("sharding_indexed", (inner, [inner[0], inner[2]], "end"))]
    path = vertices_path(identity)
    found = _shape_of(group, path, "float32", (rows, None, 3), codecs=codecs, chunk=rows_per_shard)
    if not 0 < 12 * found[1] <= LARGEST_CHUNK:
        raise ArrayDamage(f"{path}/zarr.json", f"meshes of {found[1]:,} vertices")
    return found


def read_topology(group: zarr.Group, identity: int) -> str:
    """Name of the topology that an identity has.

    Raises
    ------
    ArrayDamage
        The identity's attributes are missing, or name none.
    """
    path = f"identity/{identity_name(identity)}/zarr.json"
    attributes = _document(group, path).get("attributes")
    name = attributes.get("topology") if isinstance(attributes, dict) else None
    if not (isinstance(name, str) and _NUMBER.fullmatch(name)):
        raise ArrayDamage(path, f"its topology is {name!r:.60}, not a number")
    return name


def _shape_of(
    group: zarr.Group, path: str, dtype: str, shape: Shape, *, codecs: list[Any], chunk: int | None = None
) -> tuple[int, ...]:
    """The shape in an array's metadata, which must be of these codecs; a chunk has ``chunk`` rows, or all."""
    where = f"{path}/zarr.json"
    document = _document(group, where)
    found: Any = document.get("shape")
    if not _fits(found, shape) or math.prod(found) * np.dtype(dtype).itemsize > _most(chunk):
        raise ArrayDamage(where, f"shape {_brief(found)} instead of {_brief(shape)}")
    wanted = {
        "node_type": "array",
        "data_type": dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": _chunk_shape(found, chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": codecs,
    }
    stated = {**document, "codecs": _codecs(document.get("codecs"), found)}
    for name, value in wanted.items():
        if stated.get(name) != value:
            raise ArrayDamage(where, f"another {name.replace('_', ' ')} than the format has")
    return tuple(found)


def _most(chunk: int | None) -> float:
    """The most bytes of an array; one in many shards has no limit as a whole."""
    return LARGEST_CHUNK if chunk is None else math.inf


def _fits(found: Any, shape: Shape) -> bool:
    return (
        isinstance(found, list)
        and len(found) == len(shape)
        and all(type(size) is int and size >= 0 for size in found)
        and all(wanted in (None, size) for size, wanted in zip(found, shape, strict=True))
    )


def _chunk_shape(shape: Sequence[int], rows: int | None) -> list[int]:
    whole = [max(1, size) for size in shape]
    return whole if rows is None else [rows, *whole[1:]]


def _codecs(stated: Any, shape: Sequence[int]) -> list[Any] | None:
    """Names of codecs and what of their configuration decides how bytes are read; None where they make no sense."""
    try:
        return [_codec(codec["name"], codec.get("configuration", {}), shape) for codec in stated]
    except (TypeError, KeyError, AttributeError, RecursionError):
        return None


def _codec(name: Any, configuration: Mapping[str, Any], shape: Sequence[int]) -> tuple[Any, Any]:
    if name == "bytes":
        return name, configuration["endian"]
    if name != "sharding_indexed":
        return name, None
    if configuration["chunk_shape"] != [1, *shape[1:]]:
        raise KeyError("chunk_shape")
    inner, index = (_codecs(configuration[key], shape[:0]) for key in ("codecs", "index_codecs"))
    return name, (inner, index, configuration["index_location"])


def _document(group: zarr.Group, path: str) -> dict[str, Any]:
    content = _read(group, path)
    if content is None:
        raise ArrayDamage(path, "missing")
    try:
        document = parse_json(content)
    except ValueError as error:
        raise ArrayDamage(path, f"no JSON ({error})") from error
    if not isinstance(document, dict):
        raise ArrayDamage(path, "no metadata")
    return document


def _brief(shape: Any) -> str:
    """A shape for a message: ``(12, any, 3)``."""
    if not isinstance(shape, (list, tuple)) or len(shape) > 4:
        return "of something else"
    return "(" + ", ".join("any" if size is None else str(size)[:24] for size in shape) + ")"
