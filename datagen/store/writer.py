"""Writing a dataset: begin (metadata, idempotent), one whole shard at a time, finish (manifest and status last).

Every step can be repeated after any interruption and leaves the same bytes: arrays are created only where they are
missing, a shard is written once and whole by one task, and ``status: complete`` is the very last write.
"""

import contextlib
import hashlib
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec
from zarr.errors import ContainsArrayError

from datagen.bodies import BodyModel
from datagen.common.errors import DatasetError, NoDataset, ShardDamage, UnsafeFileError, storage_errors
from datagen.common.seeding import Stream, generator
from datagen.grid import Grid, Shard
from datagen.importers import evaluation_lists
from datagen.mesh.geometry import bounds
from datagen.poses import draw_poses
from datagen.recipe import DatasetRecipe
from datagen.store.arrays import ArrayDamage, read_array, read_vertex_count, read_vertices_shape
from datagen.store.attributes import assets_of, check_same_assets, check_same_recipe, provenance, stated
from datagen.store.codec import ShardCodec
from datagen.store.manifest import Manifest, commit, read_manifest
from datagen.store.schema import (
    ManifestRow,
    attributes_of,
    check_extent,
    codec_of,
    create_group,
    create_vertices_array,
    delete_object,
    identity_name,
    list_objects,
    open_group,
    read_bytes,
    require_group,
    shard_path,
    stored_sizes,
    vertices_path,
    write_bytes,
)

_GROUPS = ("topology", "identity", "pose", "evaluation", "manifest")


def identity_parameters(recipe: DatasetRecipe, body: BodyModel, identity: int) -> NDArray[np.float64]:
    """Parameters [parameter] of identity number ``identity``, a function of (seed, identity) alone."""
    return body.draw_identity(generator(recipe.identities.seed, Stream.IDENTITY, identity), identity)


def begin(url: str, recipe: DatasetRecipe, body: BodyModel) -> None:
    """Create the dataset, or whatever an interrupted ``begin`` left out of it.

    Raises
    ------
    DatasetError
        A dataset of another recipe, other assets or another version is there already, or something else is.
    """
    with _writing(url):
        check_extent(url, recipe)
        wanted = stated(recipe, body)
        try:
            group = open_group(url, mode="r+")
        except NoDataset:
            group = create_group(url, {**wanted, "status": "building", "provenance": provenance(None)})
        check_same_recipe(url, group, recipe)
        check_same_assets(url, group, assets_of(recipe, body))
        _restate(group, wanted)
        _create_arrays(group, recipe, body)


def grow(url: str, recipe: DatasetRecipe, body: BodyModel) -> None:
    """Give a complete dataset a recipe that has grown by one step: from here on it is a dataset in the making.

    Raises
    ------
    DatasetError
        The dataset is not the one that the recipe grew from.
    """
    with _writing(url):
        group = open_group(url, mode="r+")
        check_same_recipe(url, group, recipe.model_copy(update={"growth": recipe.growth[:-1]}))
        check_same_assets(url, group, assets_of(recipe, body))
        made_by = provenance(attributes_of(group).get("provenance"))
        group.update_attributes({**stated(recipe, body), "status": "building", "provenance": made_by})


def restate(url: str, recipe: DatasetRecipe, body: BodyModel, objects: Sequence[str]) -> None:
    """Write the root's attributes anew and remove other objects that were lost or changed: ``begin`` makes them."""
    with _writing(url):
        group = open_group(url, mode="r+")
        check_same_recipe(url, group, recipe)
        made_by = provenance(attributes_of(group).get("provenance"))
        group.update_attributes({**stated(recipe, body), "status": "building", "provenance": made_by})
        for path in objects:
            delete_object(group, path)


def _restate(group: zarr.Group, wanted: dict[str, Any]) -> None:
    present = attributes_of(group)
    if {key: present.get(key) for key in wanted} != wanted:
        group.update_attributes(wanted)


def require_driven(url: str, recipe: DatasetRecipe) -> zarr.Group:
    """The dataset's group, if it is still the one that a task was sent to make.

    Raises
    ------
    DatasetError
        It has been removed, or begun anew by another recipe.
    """
    group = open_group(url, mode="r+")
    if attributes_of(group).get("recipe_sha256") != recipe.sha256():
        raise DatasetError(f"{url} is being made by another recipe now; this task leaves it alone. Run one at a time")
    return group


def write_shard(
    url: str, recipe: DatasetRecipe, shard: Shard, vertices: NDArray[np.float32], *, committed: str | None = None
) -> ManifestRow:
    """Write one whole shard, vertices [rows, vertex, 3], and return its manifest row.

    Raises
    ------
    DatasetError
        The bytes are not those that the dataset's manifest has (``committed``, their sha256), or not of its array's
        shape; nothing is written then.
    """
    path, group, grid = shard_path(shard), require_driven(url, recipe), Grid(recipe)
    count = stored_vertex_count(group, grid, shard.identity)
    if count is None or vertices.shape != (shard.rows, count, 3):
        expected = [shard.rows, count, 3]
        raise DatasetError(f"{url}: shard {path} came out of shape {list(vertices.shape)} instead of {expected}")
    codec = codec_of(recipe, grid.split(shard.identity), vertices=count)
    content = codec.encode(vertices)
    row = _row(shard, content, vertices)
    if committed not in (None, row.sha256):
        raise DatasetError(
            f"{url}: shard {path} was made again, but not the same: other package versions made it "
            f"(dsffnet inspect {url} names them). Install those, or make the dataset anew with --fresh"
        )
    with _writing(url):
        write_bytes(group, path, content)
        if stored_sizes(group, [path]) != {path: len(content)}:
            raise DatasetError(f"{url}: shard {path} is not there as it was written; is the storage sound?")
    return row


def existing_shard(group: zarr.Group, grid: Grid, shard: Shard) -> ManifestRow | None:
    """The manifest row of a shard that is there, whole and sound; None where it is missing, damaged or unreadable."""
    count = stored_vertex_count(group, grid, shard.identity)
    if count is None:
        return None
    codec = codec_of(grid.recipe, grid.split(shard.identity), vertices=count)
    try:
        content = read_bytes(group, shard_path(shard), limit=codec.most_bytes)
        return None if content is None else _row(shard, content, codec.decode(content, shard.rows))
    except (ShardDamage, OSError, UnsafeFileError):
        return None


def stored_vertex_count(group: zarr.Group, grid: Grid, identity: int) -> int | None:
    """Vertices of an identity's meshes; None where its array has no metadata that makes sense."""
    size = grid.rows_per_shard(grid.split(identity))
    try:
        return read_vertex_count(group, identity, rows=None, rows_per_shard=size)
    except ArrayDamage:
        return None


def _row(shard: Shard, content: bytes, vertices: NDArray[np.float32]) -> ManifestRow:
    low, high = bounds(vertices)
    return ManifestRow(
        path=shard_path(shard),
        rows=shard.rows,
        sha256=hashlib.sha256(content).hexdigest(),
        bytes=len(content),
        minimum=_triple(low.min(axis=0)),
        maximum=_triple(high.max(axis=0)),
    )


def _triple(values: NDArray[np.floating]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def finish(url: str, recipe: DatasetRecipe, rows: Sequence[ManifestRow]) -> None:
    """Commit the manifest, the statistics and ``status: complete``; remove what killed writers left of their files.

    Raises
    ------
    DatasetError
        Meanwhile the dataset was begun anew by another recipe, or a shard is not what its task wrote.
    """
    statistics = {
        "meshes": sum(row.rows for row in rows),
        "bytes": sum(row.bytes for row in rows),
        "minimum": np.min([row.minimum for row in rows], axis=0).tolist(),
        "maximum": np.max([row.maximum for row in rows], axis=0).tolist(),
    }
    with _writing(url):
        group = require_driven(url, recipe)
        sizes = stored_sizes(group, [row.path for row in rows])
        for row in rows:
            if sizes.get(row.path) != row.bytes:
                raise DatasetError(f"{url}: shard {row.path} was changed by somebody else. Run the same command again")
        for path in list_objects(group):
            if path.endswith(".partial"):
                delete_object(group, path)
        commit(group, rows, {"statistics": statistics, "status": "complete"})


def committed_hashes(url: str) -> dict[str, str]:
    """The sha256 of each shard that a dataset's manifest has, by path; empty where there is none."""
    try:
        manifest = read_manifest(open_group(url)) or Manifest()
    except NoDataset:
        return {}
    return {row.path: row.sha256 for row in manifest.shards}


def _create_arrays(group: zarr.Group, recipe: DatasetRecipe, body: BodyModel) -> None:
    grid = Grid(recipe)
    for name in _GROUPS:
        require_group(group, name)
    poses = draw_poses(recipe.poses, range(grid.pose_count)).rotations
    _put(group, "pose/parameters", poses, ("pose", "joint", "axis"))
    for pose_type, triples in evaluation_lists(grid).items():
        _put(group, f"evaluation/{pose_type}", triples, ("triple", "column"))
    topologies: dict[bytes, str] = {}
    for identity in range(grid.identity_count):
        parameters = identity_parameters(recipe, body, identity)
        faces = body.faces(parameters)
        topology = topologies.setdefault(faces.tobytes(), str(len(topologies)))
        require_group(group, f"topology/{topology}")
        _put(group, f"topology/{topology}/faces", faces, ("face", "corner"))
        one_pose = draw_poses(recipe.poses, grid.poses_of(identity)[:1])
        vertices = body.vertices(parameters, one_pose).shape[1]  # not faces.max() + 1: some vertices may be in no face
        _create_identity(group, grid, identity, parameters, vertices, topology)


def _create_identity(
    group: zarr.Group, grid: Grid, identity: int, parameters: NDArray[np.float64], vertices: int, topology: str
) -> None:
    home, rows, path = f"identity/{identity_name(identity)}", grid.rows_of(identity), vertices_path(identity)
    _put(group, f"{home}/parameters", parameters, ("parameter",))
    _put(group, f"{home}/pose", rows.astype(np.int32), ("row",))
    codec = codec_of(grid.recipe, grid.split(identity), vertices=vertices)
    if _vertices_shape(group, identity, codec) != (len(rows), vertices, 3):
        delete_object(group, f"{path}/zarr.json")  # of an array that has grown, or a damaged one: no shard is touched
        with contextlib.suppress(ContainsArrayError):  # on a store without a lock, somebody else was first
            create_vertices_array(group, path, rows=len(rows), codec=codec)
    require_group(group, home).update_attributes({"topology": topology, "split": grid.split(identity)})


def _vertices_shape(group: zarr.Group, identity: int, codec: ShardCodec) -> tuple[int, ...] | None:
    try:
        return read_vertices_shape(group, identity, rows_per_shard=codec.rows)
    except ArrayDamage:
        return None


def _put(group: zarr.Group, path: str, values: NDArray[Any], dimensions: tuple[str, ...]) -> None:
    """Store a small array in one chunk with a checksum, unless it is there and holds these values already."""
    if _holds(group, path, values):
        return
    for name in ("zarr.json", "/".join(["c", *"0" * values.ndim])):
        delete_object(group, f"{path}/{name}")
    with contextlib.suppress(ContainsArrayError):  # on a store without a lock, somebody else was first
        group.create_array(
            path,
            shape=values.shape,
            dtype=values.dtype,
            chunks=tuple(max(1, size) for size in values.shape),
            compressors=ZstdCodec(level=3, checksum=True),
            dimension_names=dimensions,
        )
    cast(zarr.Array[Any], group[path])[...] = values


def _holds(group: zarr.Group, path: str, values: NDArray[Any]) -> bool:
    try:
        return np.array_equal(read_array(group, path, values.dtype.name, values.shape), values)
    except ArrayDamage:
        return False


def _writing(url: str) -> contextlib.AbstractContextManager[None]:
    advice = "What was complete is untouched; make room or choose another --out, then run the same command again"
    return storage_errors(f"to {url}", advice=advice)
