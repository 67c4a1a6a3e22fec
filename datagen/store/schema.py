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

import asyncio
import contextlib
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, cast

import numpy as np
import zarr
from pydantic import ValidationError
from zarr.abc.store import ByteRequest
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, ShardingCodec
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync
from zarr.errors import ContainsGroupError

from datagen.errors import DatasetError, StorageError
from datagen.grid import Grid, Shard, Split
from datagen.recipe import DatasetRecipe
from datagen.store.codec import ShardCodec

FORMAT_VERSION = 2


class NoDataset(DatasetError):
    """There is nothing at that place."""


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

    @classmethod
    def from_json(cls, row: dict[str, Any]) -> "ManifestRow":
        return cls(**{**row, "minimum": tuple(row["minimum"]), "maximum": tuple(row["maximum"])})


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


def array_at(group: zarr.Group, path: str) -> zarr.Array[Any]:
    """The array at ``path``; KeyError where there is none."""
    found = group[path]
    if not isinstance(found, zarr.Array):
        raise KeyError(path)
    return found


def stored_vertex_count(group: zarr.Group, identity: int) -> int | None:
    """Vertices of an identity's meshes; None where its array has no metadata that can be read."""
    try:
        return int(array_at(group, vertices_path(identity)).shape[1])
    except (KeyError, RuntimeError, ValueError, TypeError, OSError):
        return None


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
        return DatasetRecipe.model_validate(stored)
    except ValidationError as error:
        raise DatasetError(
            f"{url} holds a recipe that this program does not understand ({error.error_count()} faults). "
            "Read it with the version that made it, or make it anew with --fresh"
        ) from error


def read_bytes(group: zarr.Group, path: str, *, byte_range: ByteRequest | None = None) -> bytes | None:
    """Bytes of one object of the dataset's store, all or a range of them; None where there is none."""
    found = sync(group.store.get(_key(group, path), default_buffer_prototype(), byte_range))
    return None if found is None else found.to_bytes()


def write_bytes(group: zarr.Group, path: str, content: bytes) -> None:
    """Write one object of the dataset's store whole, in the place of any that is there."""
    sync(group.store.set(_key(group, path), default_buffer_prototype().buffer.from_bytes(content)))


def delete_object(group: zarr.Group, path: str) -> None:
    """Remove one object of the dataset's store, if it is there."""
    sync(group.store.delete(_key(group, path)))


def list_objects(group: zarr.Group) -> list[str]:
    """Paths of all objects of the dataset's store, sorted."""
    prefix = f"{group.path}/" if group.path else ""

    async def listed() -> list[str]:
        return [key async for key in group.store.list_prefix(prefix)]

    return sorted(key.removeprefix(prefix) for key in sync(listed()))


def _key(group: zarr.Group, path: str) -> str:
    return f"{group.path}/{path}" if group.path else path


def stored_sizes(group: zarr.Group, paths: list[str]) -> dict[str, int]:
    """Size in bytes of each path that exists, asked for concurrently."""

    async def size(path: str) -> tuple[str, int] | None:
        try:
            return path, await group.store.getsize(_key(group, path))
        except FileNotFoundError:
            return None

    async def sizes() -> list[tuple[str, int] | None]:
        return list(await asyncio.gather(*(size(path) for path in paths)))

    return dict(found for found in sync(sizes()) if found is not None)


def plain(url: str) -> str:
    """A store URL without ``file://``: such a dataset is a folder like any other."""
    return url.removeprefix("file://")


def open_group(url: str, *, mode: str = "r") -> zarr.Group:
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
        with storage_errors(url):
            return zarr.open_group(plain(url), mode=mode, zarr_format=3)  # type: ignore[arg-type]
    except FileNotFoundError as error:
        raise NoDataset(f"no dataset at {url}. Make one: dsffnet generate --recipe quickstart --out {url}") from error
    except ImportError as error:
        raise DatasetError(f"{url} needs a package that is not installed ({error}). Install it with pip") from error
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise DatasetError(
            f"{url} is not a readable dataset: its zarr.json cannot be read ({error}). If it was one, make it again: "
            f"dsffnet generate --recipe RECIPE --out {url} --fresh"
        ) from error


def create_group(url: str, attributes: dict[str, Any]) -> zarr.Group:
    """The root group of a new dataset, with its attributes in one write.

    Raises
    ------
    DatasetError
        There is something else at ``url``.
    """
    strangers = [name for name in _names_at(url) if not name.startswith(".")]
    if strangers and "zarr.json" not in strangers:
        raise DatasetError(f"{url} holds what is not a dataset ({strangers[0]}). Choose another --out")
    try:
        with storage_errors(url):
            return zarr.create_group(plain(url), attributes=attributes, zarr_format=3)
    except ContainsGroupError:  # on a store without a lock, somebody else was first
        return open_group(url, mode="r+")


def require_group(group: zarr.Group, path: str) -> zarr.Group:
    """The group at a path, made if it is not there; on a store without a lock somebody else may be making it too."""
    try:
        return group.require_group(path)
    except ContainsGroupError:  # made between Zarr's look and its making
        return cast(zarr.Group, group[path])


def _names_at(url: str) -> list[str]:
    """Names of what lies directly at a place."""
    if "://" not in plain(url):
        return sorted(os.listdir(plain(url))) if os.path.isdir(plain(url)) else []
    from fsspec.core import url_to_fs

    with storage_errors(url):
        system, path = url_to_fs(url)
        system.invalidate_cache()
        try:
            return sorted(str(entry).rstrip("/").rsplit("/", 1)[-1] for entry in system.ls(path, detail=False))
        except FileNotFoundError:
            return []


@contextlib.contextmanager
def storage_errors(url: str) -> Iterator[None]:
    """Turn what cloud clients raise (no credentials, no such address) into one error a person can act on."""
    try:
        yield
    except Exception as error:
        if type(error).__module__.split(".")[0] not in ("botocore", "aiobotocore", "gcsfs", "google", "azure"):
            raise
        raise StorageError(
            f"{url} cannot be reached ({error}). Check its address and your credentials; for S3: AWS_ACCESS_KEY_ID, "
            "AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL"
        ) from error


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
    raise DatasetError(f"{url} has format version {found!r}, this program reads {FORMAT_VERSION}; {advice}")
