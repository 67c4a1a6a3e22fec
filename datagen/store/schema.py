"""Names, shapes, codecs and attributes of a dataset: the contract between datagen and training.

NAME.zarr                     status building|complete, recipe, splits, provenance, statistics (attributes)
  topology/T/faces            (face, 3) int32
  identity/I/vertices         (row, vertex, 3) float32, metres, Y up; chunk = one mesh, shard = many rows
  identity/I/pose             (row,) int32, the pose number of each row; -1: the row holds no mesh
  identity/I/parameters       (parameter,) float64, what the body model needs to make this identity again
  pose/parameters             (pose, joint, 3) float64, axis-angle in radians
  evaluation/seen, /unseen    (triple, 4) int32: source identity, source pose, target identity, target pose
  manifest                    one row a shard: path, rows, sha256 (attributes); committed last
"""

import json
from dataclasses import asdict, dataclass
from typing import Any, Literal, cast

import numpy as np
import zarr
from pydantic import ValidationError
from zarr.abc.store import ByteRequest
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, ShardingCodec
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync
from zarr.errors import ContainsGroupError

from datagen.common.errors import DatasetError, DsffnetError, NoDataset, reason_of
from datagen.grid import Grid, Shard, Split
from datagen.recipe import DatasetRecipe
from datagen.store.codec import ShardCodec
from datagen.store.object_names import LONGEST_LIST, is_leftover, is_member
from datagen.store.objects import Objects, open_objects

FORMAT_VERSION = 2
_MOST_POSES = 1_000_000
"""They are one array, which is read and written whole."""
_MOST_TRIPLES = 10_000_000
_MOST_STEPS = 1000
_BYTES_OF_IDENTITY, _BYTES_OF_SHARD = 700, 500
"""Of the manifest, no less than it takes."""


@dataclass(frozen=True, order=True)
class ManifestRow:
    """One shard file: where it lies, how many meshes it holds, the hash of its bytes, and the extent of its meshes."""

    path: str
    rows: int
    sha256: str
    bytes: int
    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def identity_name(identity: int) -> str:
    """Group name of identity number ``identity``."""
    return f"{identity:04d}"


def vertices_path(identity: int) -> str:
    """Path of the vertices array of an identity within the dataset."""
    return f"identity/{identity_name(identity)}/vertices"


def shard_path(shard: Shard) -> str:
    """Path of a shard's file within the dataset."""
    return f"{vertices_path(shard.identity)}/c/{shard.number}/0/0"


def create_vertices_array(group: zarr.Group, path: str, *, rows: int, codec: ShardCodec) -> None:
    """An empty array (row, vertex, 3): NaN fill, one mesh a chunk, Blosc with shuffle, crc32c inside each shard."""
    blosc = BloscCodec(cname=codec.compressor, clevel=codec.level, shuffle="shuffle", typesize=4)
    group.create_array(
        path,
        shape=(rows, codec.vertices, 3),
        dtype="float32",
        chunks=(codec.rows, codec.vertices, 3),
        serializer=ShardingCodec(
            chunk_shape=(1, codec.vertices, 3),
            codecs=[BytesCodec(), blosc, Crc32cCodec()],
            index_codecs=[BytesCodec(), Crc32cCodec()],
        ),
        compressors=None,
        filters=None,
        fill_value=np.nan,
        dimension_names=("row", "vertex", "coordinate"),
    )


def codec_of(recipe: DatasetRecipe, split: Split, *, vertices: int) -> ShardCodec:
    """How an identity's shards are laid out."""
    store = recipe.store
    return ShardCodec(Grid(recipe).rows_per_shard(split), vertices, store.codec, store.compression_level)


def attributes_of(group: zarr.Group) -> dict[str, Any]:
    """Attributes of a group as a plain dictionary."""
    return dict(group.attrs.asdict())


def stored_recipe(url: str, group: zarr.Group) -> DatasetRecipe:
    """The recipe in a dataset's attributes.

    Raises
    ------
    DatasetError
        There is none, or this program does not understand it.
    """
    stored = attributes_of(group).get("recipe")
    if stored is None:
        raise DatasetError(f"{url} holds no recipe. Make it anew: dsffnet generate --recipe RECIPE --out {url} --fresh")
    try:
        recipe = DatasetRecipe.model_validate(stored)
    except ValidationError as error:
        raise DatasetError(
            f"{url} holds a recipe that this program does not understand ({error.error_count()} faults). "
            "Read it with the version that made it, or make it anew with --fresh"
        ) from error
    check_extent(url, recipe)
    return recipe


def check_extent(url: str, recipe: DatasetRecipe) -> None:
    """Refuse a recipe whose counts no dataset of this format can hold, before anything is listed.

    Raises
    ------
    DatasetError
        More identities and shards than a manifest can name, or too many poses, triples or steps.
    """
    grid, steps = Grid(recipe), len(recipe.growth) + 1
    if steps > _MOST_STEPS:
        raise DatasetError(f"{url}: its recipe has grown in {steps:,} steps; a dataset can grow in {_MOST_STEPS:,}")
    manifest = _BYTES_OF_IDENTITY * grid.identity_count + _BYTES_OF_SHARD * grid.shard_count
    triples = recipe.triples.count * steps
    if manifest > LONGEST_LIST or grid.pose_count > _MOST_POSES or triples > _MOST_TRIPLES:
        raise DatasetError(
            f"{url}: its recipe has {grid.identity_count:,} identities, {grid.pose_count:,} poses, "
            f"{grid.shard_count:,} shards and {triples:,} triples. A dataset holds up to {_MOST_POSES:,} poses, "
            f"{LONGEST_LIST // _BYTES_OF_SHARD:,} shards and {_MOST_TRIPLES:,} triples; make shards larger "
            "(data.store.poses_per_shard), or several datasets"
        )


def objects_of(group: zarr.Group) -> Objects:
    """The store of a group that :func:`open_group` or :func:`create_group` gave."""
    return cast(Objects, group.store)


def read_bytes(
    group: zarr.Group, path: str, *, limit: int | None = None, byte_range: ByteRequest | None = None
) -> bytes | None:
    """Bytes of one object of the dataset's store, all or a range of them; None where there is none.

    Raises
    ------
    UnsafeFileError
        No object of a dataset is called so, or what is there is not a regular file of at most ``limit`` bytes inside.
    OSError
        It cannot be read.
    StorageError
        A remote store does not answer.
    """
    return objects_of(group).read(path, limit=limit, byte_range=byte_range)


def write_bytes(group: zarr.Group, path: str, content: bytes) -> None:
    """Write one object of the dataset's store whole, in the place of any that is there."""
    sync(group.store.set(path, default_buffer_prototype().buffer.from_bytes(content)))


def delete_object(group: zarr.Group, path: str) -> None:
    """Remove one object of the dataset's store, if it is there."""
    sync(group.store.delete(path))


def list_objects(group: zarr.Group) -> list[str]:
    """Paths of all objects of the dataset's store, and of what killed writers left of some, sorted."""

    async def listed() -> list[str]:
        return [key async for key in group.store.list_prefix("")]

    return sorted(path for path in sync(listed()) if is_member(path) or is_leftover(path))


def stored_sizes(group: zarr.Group, paths: list[str]) -> dict[str, int]:
    """Size in bytes of each path that exists and is a file."""
    return objects_of(group).sizes(paths)


def parse_json(content: bytes) -> Any:
    """Plain data from JSON (ValueError where it is none, or nested too deeply)."""
    try:
        return json.loads(content)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def open_group(url: str, *, mode: Literal["r", "r+"] = "r") -> zarr.Group:
    """The root group of a dataset.

    Raises
    ------
    NoDataset
        There is nothing at ``url``.
    DatasetError
        What is there cannot be read as a dataset.
    StorageError
        The store cannot be reached.
    """
    try:
        store = open_objects(url, read_only=mode == "r")
        group = zarr.open_group(store, mode=mode, zarr_format=3, use_consolidated=False)
        attributes_of(group)
        return group
    except DsffnetError:
        raise
    except FileNotFoundError as error:
        if store.sizes(["zarr.json"]):  # what is there is neither group nor array
            raise _unreadable(url, error) from error
        raise NoDataset(f"no dataset at {url}. Make one: dsffnet generate --recipe quickstart --out {url}") from error
    except ImportError as error:
        raise DatasetError(f"{url} needs a package that is not installed ({error}). Install it with pip") from error
    except Exception as error:  # whatever Zarr comes to on metadata that is none
        raise _unreadable(url, error) from error


def _unreadable(url: str, error: Exception) -> DatasetError:
    return DatasetError(
        f"{url} is not a readable dataset: its zarr.json cannot be read ({reason_of(error)}). If it was one, make it "
        f"again: dsffnet generate --recipe RECIPE --out {url} --fresh"
    )


def create_group(url: str, attributes: dict[str, Any]) -> zarr.Group:
    """The root group of a new dataset, with its attributes in one write.

    Raises
    ------
    DatasetError
        There is something else at ``url``.
    """
    store = open_objects(url, read_only=False)
    strangers = [name for name in store.names() if not name.startswith(".")]
    if strangers and "zarr.json" not in strangers:
        raise DatasetError(f"{url} holds what is not a dataset ({strangers[0]}). Choose another --out")
    try:
        return zarr.create_group(store, attributes=attributes, zarr_format=3)
    except ContainsGroupError:  # on a store without a lock, somebody else was first
        return open_group(url, mode="r+")


def require_group(group: zarr.Group, path: str) -> zarr.Group:
    """The group at a path, made if it is not there; on a store without a lock somebody else may be making it too."""
    try:
        return group.require_group(path)
    except ContainsGroupError:  # made between Zarr's look and its making
        return cast(zarr.Group, group[path])
    except (ValueError, TypeError, KeyError, AttributeError, RuntimeError):  # what is there is no group
        delete_object(group, f"{path}/zarr.json")
        return group.create_group(path)


def check_ours(url: str, group: zarr.Group) -> None:
    """Refuse a Zarr group that is not a dataset of this project."""
    if "format_version" not in group.attrs:
        raise DatasetError(f"{url} is a Zarr group but not a dataset of this project (no format_version attribute)")


def check_version(url: str, group: zarr.Group) -> None:
    """Refuse what this version cannot read, in both directions, saying what to do."""
    check_ours(url, group)
    found = attributes_of(group)["format_version"]
    if found == FORMAT_VERSION:
        return
    newer = isinstance(found, int) and found > FORMAT_VERSION
    advice = "update the project" if newer else "make it again: dsffnet generate --recipe RECIPE --out NEW.zarr"
    raise DatasetError(f"{url} has format version {found!r:.20}, this program reads {FORMAT_VERSION}; {advice}")
