"""Writing a dataset: begin (metadata, idempotent), one whole shard at a time, finish (manifest and status last).

Every step can be repeated after any interruption and leaves the same bytes: arrays are created only where they are
missing, a shard is written once and whole by one task, and ``status: complete`` is the very last write.
"""

import contextlib
import hashlib
import importlib.metadata
import subprocess
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec
from zarr.errors import ContainsArrayError

from datagen.bodies import BodyModel
from datagen.errors import DatasetError, StorageError
from datagen.grid import POSE_TYPES, Grid, Shard
from datagen.importers import evaluation_lists
from datagen.mesh import bounds
from datagen.poses import draw_poses, load_poses
from datagen.random import Stream, generator
from datagen.recipe import DatasetRecipe
from datagen.store.codec import ShardDamage
from datagen.store.manifest import commit
from datagen.store.schema import (
    FORMAT_VERSION,
    ManifestRow,
    array_at,
    attributes_of,
    check_version,
    codec_of,
    create_vertices_array,
    delete_object,
    identity_name,
    list_objects,
    open_group,
    read_bytes,
    shard_path,
    stored_recipe,
    stored_sizes,
    vertices_path,
    write_bytes,
)

_NAMESPACE = uuid.UUID("6f5a4b1e-52f7-5f0b-9a35-2f2a3a7d6c11")
_PACKAGES = ("anny", "smplx", "numpy", "scipy", "zarr", "numcodecs")


def identity_parameters(recipe: DatasetRecipe, body: BodyModel, identity: int) -> NDArray[np.float64]:
    """Parameters [parameter] of identity number ``identity``, a function of (seed, identity) alone."""
    return body.draw_identity(generator(recipe.identities.seed, Stream.IDENTITY, identity), identity)


def begin(url: str, recipe: DatasetRecipe, body: BodyModel) -> None:
    """Create the dataset, or whatever an interrupted ``begin`` left out of it.

    Raises
    ------
    DatasetError
        A dataset of another recipe, other assets or another version is there already.
    """
    with _writing(url):
        group = open_group(url, mode="a")
        if "format_version" in group.attrs:
            check_same_recipe(url, group, recipe)
            _check_same_assets(url, group, _assets(recipe, body))
        else:
            group.update_attributes(_attributes(recipe, body))
        _create_arrays(group, recipe, body)


def grow(url: str, recipe: DatasetRecipe, body: BodyModel) -> None:
    """Give a complete dataset a recipe that has grown: from here on it is a dataset in the making."""
    with _writing(url):
        group = open_group(url, mode="r+")
        _check_same_assets(url, group, _assets(recipe, body))
        group.update_attributes(_attributes(recipe, body, attributes_of(group)["provenance"]))


def write_shard(url: str, recipe: DatasetRecipe, shard: Shard, vertices: NDArray[np.float32]) -> ManifestRow:
    """Write one whole shard, vertices [rows, vertex, 3], and return its manifest row."""
    codec = codec_of(recipe, Grid(recipe).split(shard.identity), vertices=vertices.shape[1])
    content, path = codec.encode(vertices), shard_path(shard)
    with _writing(url):
        group = open_group(url, mode="r+")
        write_bytes(group, path, content)
        if stored_sizes(group, [path]) != {path: len(content)}:
            raise DatasetError(f"{url}: shard {path} is not there as it was written; is the storage sound?")
    return _row(shard, content, vertices)


def existing_shard(url: str, recipe: DatasetRecipe, shard: Shard) -> ManifestRow | None:
    """The manifest row of a shard that is there, whole and sound; None where it is missing or damaged."""
    group = open_group(url)
    content = read_bytes(group, shard_path(shard))
    if content is None:
        return None
    count = array_at(group, vertices_path(shard.identity)).shape[1]
    try:
        codec = codec_of(recipe, Grid(recipe).split(shard.identity), vertices=count)
        return _row(shard, content, codec.decode(content, shard.rows))
    except ShardDamage:
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


def finish(url: str, rows: Sequence[ManifestRow]) -> None:
    """Commit the manifest, the statistics and ``status: complete``; remove what killed writers left of their files."""
    statistics = {
        "meshes": sum(row.rows for row in rows),
        "bytes": sum(row.bytes for row in rows),
        "minimum": np.min([row.minimum for row in rows], axis=0).tolist(),
        "maximum": np.max([row.maximum for row in rows], axis=0).tolist(),
    }
    with _writing(url):
        group = open_group(url, mode="r+")
        for path in list_objects(group):
            if path.endswith(".partial"):
                delete_object(group, path)
        commit(group, rows, {"statistics": statistics, "status": "complete"})


def restate(url: str, recipe: DatasetRecipe, body: BodyModel, objects: Sequence[str]) -> None:
    """Write the root's attributes and these other objects anew: they were lost or changed."""
    with _writing(url):
        group = open_group(url, mode="r+")
        check_same_recipe(url, group, recipe)
        group.update_attributes(_attributes(recipe, body, attributes_of(group).get("provenance")))
        for path in objects:
            delete_object(group, path)


def _attributes(recipe: DatasetRecipe, body: BodyModel, provenance: Any = None) -> dict[str, Any]:
    grid, digest = Grid(recipe), recipe.sha256()
    assets, poses = _assets(recipe, body), load_poses(recipe.poses)
    return {
        "format_version": FORMAT_VERSION,
        "uuid": str(uuid.uuid5(_NAMESPACE, f"{FORMAT_VERSION} {digest} {assets}")),
        "status": "building",
        "recipe": recipe.model_dump(mode="json"),
        "recipe_sha256": digest,
        "body": {"family": recipe.body.family, "assets": assets, "parameters": list(body.parameter_names)},
        "provenance": _provenance(provenance),
        "units": "metres",
        "frame": "Y up, facing +Z, +X to the body's left",
        "joints": list(poses.joints),
        "joint_parents": list(poses.parents),
        "splits": {
            "identities": {identity_name(i): grid.split(i) for i in range(grid.identity_count)},
            "poses": {kind: _spans(grid.poses(kind)) for kind in POSE_TYPES},
        },
    }


def _assets(recipe: DatasetRecipe, body: BodyModel) -> list[dict[str, str]]:
    """What the bytes depend on beside the recipe: the body's files and packages, and the poses'."""
    return [vars(asset) for asset in dict.fromkeys([*body.assets, *load_poses(recipe.poses).assets])]


def _spans(numbers: NDArray[np.int64]) -> list[list[int]]:
    """Numbers as a few ranges [first, end)."""
    breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
    return [[int(run[0]), int(run[-1]) + 1] for run in np.split(numbers, breaks) if len(run)]


def _create_arrays(group: zarr.Group, recipe: DatasetRecipe, body: BodyModel) -> None:
    grid = Grid(recipe)
    for name in ("topology", "identity", "pose", "evaluation", "manifest"):
        group.require_group(name)
    poses = draw_poses(recipe.poses, range(grid.pose_count)).rotations
    _put(group, "pose/parameters", poses, ("pose", "joint", "axis"))
    for pose_type, triples in evaluation_lists(grid).items():
        _put(group, f"evaluation/{pose_type}", triples, ("triple", "column"))
    topologies: dict[bytes, str] = {}
    for identity in range(grid.identity_count):
        parameters = identity_parameters(recipe, body, identity)
        faces = body.faces(parameters)
        topology = topologies.setdefault(faces.tobytes(), str(len(topologies)))
        group.require_group(f"topology/{topology}")
        _put(group, f"topology/{topology}/faces", faces, ("face", "corner"))
        _create_identity(group, grid, identity, parameters, int(faces.max()) + 1, topology)


def _create_identity(
    group: zarr.Group, grid: Grid, identity: int, parameters: NDArray[np.float64], vertices: int, topology: str
) -> None:
    home, rows, path = f"identity/{identity_name(identity)}", grid.rows_of(identity), vertices_path(identity)
    _put(group, f"{home}/parameters", parameters, ("parameter",))
    _put(group, f"{home}/pose", rows.astype(np.int32), ("row",))
    if path not in group:
        codec = codec_of(grid.recipe, grid.split(identity), vertices=vertices)
        with contextlib.suppress(ContainsArrayError):  # on a store without a lock, somebody else was first
            create_vertices_array(group, path, rows=len(rows), codec=codec)
    elif array_at(group, path).shape[0] != len(rows):
        array_at(group, path).resize((len(rows), vertices, 3))
    group.require_group(home).update_attributes({"topology": topology, "split": grid.split(identity)})


def _put(group: zarr.Group, path: str, values: NDArray[Any], dimensions: tuple[str, ...]) -> None:
    """Store a small array in one chunk with a checksum, unless it is there and holds these values already."""
    if _holds(group, path, values):
        return
    array = group.create_array(
        path,
        shape=values.shape,
        dtype=values.dtype,
        chunks=tuple(max(1, size) for size in values.shape),
        compressors=ZstdCodec(level=3, checksum=True),
        dimension_names=dimensions,
        overwrite=True,
    )
    array[...] = values


def _holds(group: zarr.Group, path: str, values: NDArray[Any]) -> bool:
    try:
        return np.array_equal(np.asarray(array_at(group, path)[...]), values)
    except (KeyError, RuntimeError, ValueError, OSError):
        return False


def _check_same_assets(url: str, group: zarr.Group, present: list[dict[str, str]]) -> None:
    stored = attributes_of(group)["body"]["assets"]
    if stored == present:
        return
    changed = [asset for asset in stored if asset not in present] or stored
    raise DatasetError(
        f"{url} was made from {_named(changed)}, but here is {_named([a for a in present if a not in stored])}. "
        "Use what it was made from, or write to another place, or add --fresh to make it anew"
    )


def _named(assets: Sequence[dict[str, Any]]) -> str:
    return ", ".join(f"{asset['name']} {asset['version']}" for asset in assets) or "nothing of the kind"


def check_same_recipe(url: str, group: zarr.Group, recipe: DatasetRecipe) -> None:
    """Refuse to go on with a dataset that another recipe (or version) began; the message names what differs."""
    check_version(url, group)
    attributes = attributes_of(group)
    if attributes["recipe_sha256"] == recipe.sha256():
        return
    stored = stored_recipe(url, group)
    changed = ", ".join(_differences(stored.identifying(), recipe.identifying()))
    raise DatasetError(
        f"{url} was made by another recipe ({changed}). Write to another place, or add --fresh to make it anew"
    )


def _differences(old: dict[str, Any], new: dict[str, Any], prefix: str = "data") -> Iterator[str]:
    for key in sorted(old.keys() | new.keys()):
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            yield from _differences(before, after, f"{prefix}.{key}")
        elif before != after:
            yield f"{prefix}.{key}: {before} there, {after} here"


@contextlib.contextmanager
def _writing(url: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"could not write to {url}: {error.strerror or error}. What was complete is untouched; "
            "make room or choose another --out, then run the same command again"
        ) from error


def _provenance(earlier: Any) -> dict[str, Any]:
    """What makes the data here and now, and what made the part that is there already, if that was something else."""
    now = {"packages": _versions(), "git_commit": _git_commit()}
    before = dict(earlier) if isinstance(earlier, dict) else {}
    history = before.pop("earlier", [])
    if before and before != now:
        history = [*history, before]
    return {**now, "earlier": history} if history else now


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in _PACKAGES}


def _git_commit() -> str:
    """Commit of the working tree this code runs from, or 'unknown' (an installed copy, a submitted job)."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
