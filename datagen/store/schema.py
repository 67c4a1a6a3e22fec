"""Names, shapes and attributes of a dataset: the contract between datagen and training.

NAME.zarr                        status building|complete, recipe, splits, provenance, statistics (attributes)
  grid/topology                  (identity,) int32, the topology of each identity
  grid/SPLIT/T/vertices          (identity, pose, vertex, 3) float32, metres, Y up; chunk = one mesh, shard = a block
  grid/SPLIT/T/identity, pose    (identity,), (pose,) int32, the numbers along the two axes; -1: no mesh there
  grid/SPLIT/T/parameters        (identity, parameter) float64, what the body model needs to make each again
  topology/vertex_count          (topology,) int32, vertices of a mesh of each topology
  topology/T/faces               (face, 3) int32
  topology/T/part                (vertex,) int32, of dressed people: 0 skin, from 1 on the parts of the outfit
  pose/parameters                (pose, joint, 3) float64, axis-angle in radians
  rig/number                     (identity,) int32, the rig of each identity, -1: none; no group where there is no rig
  rig/R/weights                  (kind, vertex, part) float32, skinning weights
  rig/R/kind, joints             (identity of R,) int32, the weights of each; (identity of R, part, 3) float32, at rest
  rig/R/corrections              (part, 3, 3) float64, from the body's rest to that of the poses
  evaluation/seen, /unseen       (triple, 4) int32: source identity, source pose, target identity, target pose
  manifest/place, rows, bytes, blake3, extent, object_sha256; committed last
"""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray
from pydantic import ValidationError
from zarr.errors import ContainsGroupError

from datagen.common.errors import DatasetError, DsffnetError, NoDataset, reason_of
from datagen.grid import Grid, GridArray, GridArrays, Shard
from datagen.mesh.rig import Rigs
from datagen.recipe import DatasetRecipe
from datagen.store.arrays import ArrayDamage, read_array
from datagen.store.codec import LARGEST_CHUNK, ShardCodec
from datagen.store.objects import LocalObjects, Objects, open_objects

FORMAT_VERSION = 4
OLDEST_RECIPE = 2
"""The format whose recipes are still understood, so that its datasets can be made anew."""
_MOST_IDENTITIES = 1_000_000
_MOST_POSES = 1_000_000
MOST_SHARDS = 1_000_000
_MOST_TRIPLES = 10_000_000
_MOST_STEPS = 1000


def codec_of(recipe: DatasetRecipe, of: GridArray | Shard) -> ShardCodec:
    """How the shards of an array of vertices are laid out."""
    return ShardCodec(*of.room, of.vertices, recipe.store.codec, recipe.store.compression_level)


def stored_arrays(group: zarr.Group, grid: Grid) -> GridArrays:
    """The arrays of vertices that a dataset has for a grid.

    Raises
    ------
    ArrayDamage
        What says so is missing or damaged.
    """
    vertices = read_array(group, "topology/vertex_count", "int32", (None,))
    if vertices.size and not (vertices.min() >= 1 and 12 * int(vertices.max()) <= LARGEST_CHUNK):
        raise ArrayDamage("topology/vertex_count/c/0", f"meshes of {vertices.min():,} to {vertices.max():,} vertices")
    if len(vertices) > grid.identity_count:
        raise ArrayDamage("topology/vertex_count/zarr.json", f"{len(vertices):,} topologies")
    topologies = read_array(group, "grid/topology", "int32", (grid.identity_count,))
    if not ((topologies >= 0) & (topologies < len(vertices))).all():
        raise ArrayDamage("grid/topology/c/0", "a topology that is not there")
    arrays = GridArrays(grid, topologies, vertices.tolist())
    if arrays.shard_count > MOST_SHARDS:
        raise ArrayDamage("topology/vertex_count/c/0", f"{arrays.shard_count:,} shards")
    return arrays


def stored_rig_numbers(group: zarr.Group, arrays: GridArrays, count: int) -> NDArray[np.int32]:
    """Number [identity] of each identity's rig among ``count``; -1 where it has none.

    Raises
    ------
    ArrayDamage
        They are missing or damaged, or identities of one rig differ in their vertices.
    """
    identities = arrays.grid.identity_count
    if not count:
        return np.full(identities, -1, np.int32)
    numbers = read_array(group, "rig/number", "int32", (identities,))
    if not ((numbers >= -1) & (numbers < count)).all():
        raise ArrayDamage("rig/number/c/0", "a rig that is not there")
    vertices = np.array(arrays.vertices, np.int64)[arrays.topologies]
    least, most = np.full(count + 1, np.iinfo(np.int64).max), np.zeros(count + 1, np.int64)  # the last: of no rig
    np.minimum.at(least, numbers, vertices)
    np.maximum.at(most, numbers, vertices)
    if wrong := np.flatnonzero(least[:count] != most[:count]).tolist():
        raise ArrayDamage("rig/number/c/0", f"not the identities of rig {wrong[0]}")
    return numbers


def stored_rigs(group: zarr.Group, number: int, parts: Mapping[str, Any], *, identities: int, vertices: int) -> Rigs:
    """The rigs of a number, of so many identities and vertices.

    Parameters
    ----------
    parts
        Their entry in the root's attribute ``rigs``: names, parents and drivers of the parts.

    Raises
    ------
    ArrayDamage
        They are missing or damaged.
    """
    home, count = f"rig/{number}", len(parts["names"])
    weights = read_array(group, f"{home}/weights", "float32", (None, vertices, count))
    kinds = read_array(group, f"{home}/kind", "int32", (identities,))
    if not ((kinds >= 0) & (kinds < len(weights))).all():
        raise ArrayDamage(f"{home}/kind/c/0", "a kind of weights that is not there")
    return Rigs(
        names=tuple(parts["names"]),
        parents=tuple(parts["parents"]),
        drivers=tuple(parts["drivers"]),
        corrections=read_array(group, f"{home}/corrections", "float64", (count, 3, 3)),
        weights=weights,
        kinds=kinds,
        joints=read_array(group, f"{home}/joints", "float32", (identities, count, 3)),
    )


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
        Too many identities, poses, shards, triples or steps.
    """
    grid, steps = Grid(recipe), len(recipe.growth) + 1
    if steps > _MOST_STEPS:
        raise DatasetError(f"{url}: its recipe has grown in {steps:,} steps; a dataset can grow in {_MOST_STEPS:,}")
    identities, poses, triples = grid.identity_count, grid.pose_count, recipe.triples.count * steps
    if identities > _MOST_IDENTITIES or poses > _MOST_POSES or triples > _MOST_TRIPLES:
        raise _too_large(url, recipe, grid.shard_count)
    check_shards(url, recipe, grid.shard_count)


def check_shards(url: str, recipe: DatasetRecipe, shards: int) -> None:
    """Refuse more shards than a dataset of this format can hold (DatasetError)."""
    if shards > MOST_SHARDS:
        raise _too_large(url, recipe, shards)


def _too_large(url: str, recipe: DatasetRecipe, shards: int) -> DatasetError:
    grid, triples = Grid(recipe), recipe.triples.count * (len(recipe.growth) + 1)
    return DatasetError(
        f"{url}: its recipe has {grid.identity_count:,} identities, {grid.pose_count:,} poses, {shards:,} shards and "
        f"{triples:,} triples. A dataset holds up to {_MOST_IDENTITIES:,} identities, {_MOST_POSES:,} poses, "
        f"{MOST_SHARDS:,} shards and {_MOST_TRIPLES:,} triples; make shards larger (data.store.poses_per_shard), or "
        "several datasets"
    )


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
        return _group_of(store, mode)
    except DsffnetError:
        raise
    except FileNotFoundError as error:
        if store.sizes(["zarr.json"]):  # neither a group nor an array; or another process has just begun a dataset
            try:
                return _group_of(store, mode)
            except Exception as again:
                raise _unreadable(url, again) from again
        raise NoDataset(_what_is_there(url, store)) from error
    except ImportError as error:
        raise DatasetError(f"{url} needs a package that is not installed ({error}). Install it with pip") from error
    except Exception as error:  # whatever Zarr comes to on metadata that is none
        raise _unreadable(url, error) from error


def _group_of(store: Objects, mode: Literal["r", "r+"]) -> zarr.Group:
    group = zarr.open_group(store, mode=mode, zarr_format=3, use_consolidated=False)
    attributes_of(group)
    return group


def _what_is_there(url: str, store: Objects) -> str:
    """Why there is no dataset in a place without a zarr.json, and what to do."""
    make = "dsffnet generate --recipe quickstart --out"
    if not isinstance(store, LocalObjects):
        return f"no dataset at {url}. Make one: {make} {url}"
    if store.root.exists() and not store.root.is_dir():
        return f"no dataset at {url}, which is a file. Name a dataset's folder, or make one: {make} NEW.zarr"
    if store.has_lost_root():
        return lost_root(url)
    if names := [name for name in store.names() if not name.startswith(".")]:
        return f"no dataset at {url}, which holds {names[0]!r}. Name a dataset's folder, or make one: {make} NEW.zarr"
    return f"no dataset at {url}. Make one: {make} {url}"


def lost_root(url: str) -> str:
    """What is wrong with a dataset without a zarr.json that can be read, and what to do."""
    return (
        f"{url} has lost its zarr.json, which is missing or cannot be read while the rest of a dataset is there. Make "
        f"it again: dsffnet generate --recipe RECIPE --out {url} --fresh"
    )


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


def check_ours(url: str, group: zarr.Group) -> None:
    """Refuse a Zarr group that is not a dataset of this project."""
    if "format_version" not in group.attrs:
        raise DatasetError(f"{url} is a Zarr group but not a dataset of this project (no format_version attribute)")


def check_version(url: str, group: zarr.Group, *, oldest: int = FORMAT_VERSION) -> None:
    """Refuse what this version cannot read, in both directions, saying what to do."""
    check_ours(url, group)
    found = attributes_of(group)["format_version"]
    if isinstance(found, int) and oldest <= found <= FORMAT_VERSION:
        return
    newer = isinstance(found, int) and found > FORMAT_VERSION
    advice = "update the project" if newer else f"make it anew: dsffnet generate --recipe {url} --out NEW.zarr"
    raise DatasetError(f"{url} has format version {found!r:.20}, this program reads {FORMAT_VERSION}; {advice}")
