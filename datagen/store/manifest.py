"""What a complete dataset consists of: a row for each shard, a hash for every other object, one digest over all.

The manifest is committed last, and the root's attributes carry its digest and one of their own, so that nothing in
a dataset can change unnoticed. While a dataset is made, one object beside it says which shards there are so far.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import zarr
from blake3 import blake3
from numpy.typing import NDArray

from datagen.common.errors import UnsafeFileError, reason_of
from datagen.grid import SPLITS, GridArrays, Place, Shard, shard_path
from datagen.mesh.geometry import Bounds
from datagen.store.arrays import put_array, put_group, read_array, read_json
from datagen.store.object_names import require_member
from datagen.store.objects import list_small_objects, read_bytes, write_bytes
from datagen.store.schema import MOST_SHARDS, attributes_of

SEAL = "attributes_sha256"
_DIMENSIONS = {
    "place": ("shard", "axis"),
    "rows": ("shard",),
    "bytes": ("shard",),
    "blake3": ("shard", "byte"),
    "extent": ("shard", "bound", "coordinate"),
}
"""Of the arrays that have a row for each shard."""
SHARD = np.dtype(
    [("place", "<i4", 4), ("rows", "<i4"), ("bytes", "<i8"), ("blake3", "u1", 32), ("extent", "<f4", (2, 3))]
)
"""A shard in a table: what a :class:`ManifestRow` says of it, without an object of its own."""
ShardTable = NDArray[np.void]
"""Of ``SHARD`` [shard]."""
_MOST = 10**9
"""Of a number in a path."""
_OBJECTS = "manifest/object_sha256"
SO_FAR = "manifest/so_far"
"""The object that lists the shards of a dataset in the making; the manifest has it all."""
_SO_FAR_ROW = np.dtype([("sound", "u1"), *((name, SHARD[name]) for name in _DIMENSIONS)])


@dataclass(frozen=True)
class ManifestRow:
    """One shard: where it lies, how many meshes it holds, its bytes and their hash, and the extent of its meshes."""

    place: Place
    rows: int
    bytes: int
    blake3: str
    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]

    @property
    def path(self) -> str:
        """Path of its object within the dataset."""
        return shard_path(self.place)


def row_of(shard: Shard, content: bytes, bounds: Bounds) -> ManifestRow:
    """The row of a shard that holds meshes of some bounds as these bytes."""
    low, high = bounds
    return ManifestRow(
        place=shard.place,
        rows=shard.rows,
        bytes=len(content),
        blake3=shard_hash(content),
        minimum=_triple(low.min(axis=0)),
        maximum=_triple(high.max(axis=0)),
    )


def shard_hash(content: bytes) -> str:
    """The hash of a shard's bytes: as strong as sha256, and in several times less time."""
    return blake3(content).hexdigest()


def _triple(values: NDArray[np.floating]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


@dataclass(frozen=True)
class Manifest:
    """What a dataset was when it was committed.

    Attributes
    ----------
    columns
        Of its shards, ordered by place: an array [shard, ...] for each field of ``SHARD``.
    objects
        The sha256 of every other object by its path.
    """

    columns: Mapping[str, NDArray[Any]]
    objects: Mapping[str, str]

    @cached_property
    def table(self) -> ShardTable:
        """All shards."""
        return _table_of(self.columns)

    @property
    def shards(self) -> list[ManifestRow]:
        """One row a shard."""
        return [
            ManifestRow(tuple(place), rows, size, bytes(digest).hex(), tuple(low), tuple(high))
            for place, rows, size, digest, (low, high) in zip(
                *(self.columns[name].tolist() for name in _DIMENSIONS), strict=True
            )
        ]

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Bytes of each shard by its path."""
        return dict(zip(paths_of(self.table), self.table["bytes"].tolist(), strict=True))

    @property
    def object_hashes(self) -> NDArray[np.uint8]:
        """The sha256 of the objects [object, 32]."""
        return _hashes(self.objects.values())

    def digest(self) -> str:
        """The sha256 over all of it."""
        found = hashlib.sha256(json.dumps(list(self.objects)).encode())
        for values in (*self.columns.values(), self.object_hashes):
            found.update(values.tobytes())
        return found.hexdigest()


def manifest_of(table: ShardTable, objects: Mapping[str, str]) -> Manifest:
    """The manifest of these shards, in any order, and objects."""
    ordered = table[_order(table)]
    return Manifest({name: np.ascontiguousarray(ordered[name]) for name in _DIMENSIONS}, objects)


def _order(table: ShardTable) -> NDArray[np.intp]:
    """By place."""
    return np.lexsort(table["place"].T[::-1])


def table_of(rows: Sequence[ManifestRow]) -> ShardTable:
    """Shards as a table, in their order."""
    columns: dict[str, Any] = {
        "place": [row.place for row in rows],
        "rows": [row.rows for row in rows],
        "bytes": [row.bytes for row in rows],
        "blake3": _hashes(row.blake3 for row in rows),
        "extent": [(row.minimum, row.maximum) for row in rows],
    }
    return _table_of({name: np.reshape(values, (-1, *SHARD[name].shape)) for name, values in columns.items()})


def _table_of(columns: Mapping[str, Any]) -> ShardTable:
    table = np.empty(len(columns["rows"]), SHARD)
    for name in _DIMENSIONS:
        table[name] = columns[name]
    return table


def paths_of(table: ShardTable) -> list[str]:
    """The path of each shard's object."""
    return [shard_path(place) for place in table["place"].tolist()]


def _hashes(digests: Iterable[str]) -> NDArray[np.uint8]:
    return np.frombuffer(bytes.fromhex("".join(digests)), np.uint8).reshape(-1, 32)


@dataclass(frozen=True, eq=False)
class SoFar:
    """The shards of a dataset that is being made.

    Attributes
    ----------
    sound
        Those that are there.
    doubted
        Those that have been written before and are to be made again, as the same bytes.
    """

    sound: ShardTable = field(default_factory=lambda: np.empty(0, SHARD))
    doubted: ShardTable = field(default_factory=lambda: np.empty(0, SHARD))

    @property
    def written(self) -> ShardTable:
        """All of them."""
        return np.concatenate([self.sound, self.doubted])

    def with_made(self, rows: Sequence[ManifestRow]) -> "SoFar":
        """The same once some shards were made, doubted ones among them."""
        made = {row.place for row in rows}
        again = np.array([tuple(place) in made for place in self.doubted["place"].tolist()], bool)
        return SoFar(np.concatenate([self.sound, table_of(rows)]), self.doubted[~again])


def put_so_far(group: zarr.Group, so_far: SoFar) -> None:
    """Keep it as one object, whole or not at all, while the manifest stays what was committed."""
    written = so_far.written
    table = np.empty(len(written), _SO_FAR_ROW)
    table["sound"] = np.arange(len(written)) < len(so_far.sound)
    for name in _DIMENSIONS:
        table[name] = written[name]
    content = table[_order(written)].tobytes()
    write_bytes(group, SO_FAR, hashlib.sha256(content).digest() + content)


def read_so_far(group: zarr.Group) -> SoFar | None:
    """What :func:`put_so_far` kept; None where there is nothing.

    Raises
    ------
    ValueError
        It is damaged.
    """
    try:
        content = read_bytes(group, SO_FAR)
    except (OSError, UnsafeFileError) as error:
        raise ValueError(SO_FAR) from error
    if content is None:
        return None
    if hashlib.sha256(content[32:]).digest() != content[:32]:
        raise ValueError(SO_FAR)
    table = np.frombuffer(content[32:], _SO_FAR_ROW)
    _require_places(table["place"])
    if len(np.unique(table["place"], axis=0)) < len(table):
        raise ValueError(SO_FAR)
    shards, sound = _table_of({name: table[name] for name in _DIMENSIONS}), table["sound"] > 0
    return SoFar(shards[sound], shards[~sound])


def commit(
    group: zarr.Group,
    table: ShardTable,
    attributes: dict[str, Any],
    *,
    objects: Mapping[str, str] | None = None,
) -> None:
    """Write the manifest, then the root's last attributes with the digests of both.

    ``objects`` are those of the manifest before, where none but shards has been written since.
    """
    hashes = objects or {path: _sha256(read_bytes(group, path) or b"") for path in _hashed_objects(group)}
    manifest = manifest_of(table, hashes)
    put_group(group, "manifest", {"objects": list(hashes)})
    put_array(group, _OBJECTS, manifest.object_hashes, ("object", "byte"))
    for name, values in manifest.columns.items():
        put_array(group, f"manifest/{name}", values, _DIMENSIONS[name])
    others = {name: value for name, value in attributes_of(group).items() if name not in ("manifest_sha256", SEAL)}
    stated = {**others, **attributes, "manifest_sha256": manifest.digest()}
    group.attrs.put({**stated, SEAL: _digest(stated)})  # these two last, whenever they were written first


def read_manifest(group: zarr.Group) -> Manifest | None:
    """The manifest that the root's attributes name, None where there is none or another.

    Raises
    ------
    UnsafeFileError
        It names what is no object of a dataset.
    """
    try:
        manifest = stored_manifest(group)
    except (ValueError, TypeError, KeyError):
        return None
    if attributes_of(group).get("manifest_sha256") != manifest.digest():
        return None
    for path in manifest.objects:
        require_member(path)
    return manifest


def stored_manifest(group: zarr.Group) -> Manifest:
    """The manifest that is stored, whether or not it is the one that was committed.

    Raises
    ------
    ValueError, TypeError, KeyError
        It is damaged.
    """
    paths = read_json(group, "manifest/zarr.json")["attributes"]["objects"]
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise TypeError("objects")
    hashes = read_array(group, _OBJECTS, "uint8", (len(paths), 32))
    count = len(read_array(group, "manifest/rows", "int32", (None,)))
    if count > MOST_SHARDS:
        raise ValueError(f"{count:,} shards")
    columns = {
        name: read_array(group, f"manifest/{name}", SHARD[name].base.name, (count, *SHARD[name].shape))
        for name in _DIMENSIONS
    }
    _require_places(columns["place"])
    return Manifest(columns, {path: sha256.tobytes().hex() for path, sha256 in zip(paths, hashes, strict=True)})


def _require_places(places: NDArray[Any]) -> None:
    if ((places < 0) | (places >= [len(SPLITS), *3 * [_MOST]])).any():
        raise ValueError("place")


def covers(manifest: Manifest, arrays: GridArrays) -> bool:
    """Whether a manifest lists the shards of a grid and no others; none are listed where their number differs."""
    if len(manifest.columns["rows"]) != arrays.shard_count:
        return False
    places, rows = arrays.places()
    return np.array_equal(places, manifest.columns["place"]) and np.array_equal(rows, manifest.columns["rows"])


def is_sealed(group: zarr.Group) -> bool:
    """Whether the root's attributes are as :func:`commit` left them."""
    attributes = attributes_of(group)
    seal = attributes.pop(SEAL, None)
    return seal == _digest(attributes)


def changed_objects(group: zarr.Group, manifest: Manifest) -> Iterator[tuple[str, str]]:
    """Objects beside the shards that are not as they were written: path, and what is wrong."""
    for path, digest in manifest.objects.items():
        try:
            content = read_bytes(group, path)
        except (OSError, UnsafeFileError) as error:
            yield path, f"cannot be read ({reason_of(error)})"
            continue
        if content is None:
            yield path, "missing"
        elif _sha256(content) != digest:
            yield path, "its hash is not the manifest's"


def _hashed_objects(group: zarr.Group) -> list[str]:
    return [path for path in list_small_objects(group) if path != "zarr.json" and not path.startswith("manifest/")]


def _digest(content: Any) -> str:
    return _sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
