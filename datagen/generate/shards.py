"""The tasks that make shards, which can be repeated at any time."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import load_body
from datagen.bodies.skinning import VERTICES_AT_ONCE
from datagen.common.errors import BodyError
from datagen.generate.identities import identity_parameters
from datagen.generate.plan import READS_FOLDERS, assets_of
from datagen.grid import Shard
from datagen.mesh.geometry import Bounds, bounds
from datagen.poses import Poses, draw_poses
from datagen.recipe import DatasetRecipe, PoseRecipe
from datagen.sizes import seconds_of
from datagen.store.attributes import check_same_assets
from datagen.store.manifest import ManifestRow
from datagen.store.schema import open_group
from datagen.store.writer import ShardWriter, existing_shard

Wanted = tuple[Shard, str | None]
"""A shard, and its hash where the dataset has a manifest already: other bytes are neither kept nor written."""
TASK_SECONDS, _FEWEST_TASKS = 0.5, 64
"""Of work in a task at most, and tasks at least: for many workers, and for progress that is seen."""


def make_shard(recipe: DatasetRecipe, shard: Shard) -> Iterator[tuple[NDArray[np.float32], Bounds]]:
    """The meshes of a shard in the order of its rows, as many at a time as a CPU's cache holds: a pure function.

    Yields
    ------
    vertices
        [mesh, vertex, 3] in metres, Y up.
    bounds
        Their lowest and highest coordinates, each [mesh, 3].

    Raises
    ------
    BodyError
        The body model gave other vertices than planned, vertices that are not finite, or a mesh without extent.
    """
    body, poses = load_body(recipe.body), _poses(recipe.poses.model_dump_json(), shard.poses)
    poses.world()  # once for all slices, whatever the identity
    at_once = max(1, VERTICES_AT_ONCE // shard.vertices)
    for identity in shard.identities:
        parameters = identity_parameters(recipe, body, identity)
        for first in range(0, len(shard.poses), at_once):
            some = slice(first, first + at_once)
            vertices = body.vertices(parameters, poses[some])
            yield vertices, _sound_bounds(shard, identity, parameters, shard.poses[some], vertices)


def _sound_bounds(
    shard: Shard, identity: int, parameters: NDArray[np.float64], poses: range, vertices: NDArray[np.float32]
) -> Bounds:
    if vertices.shape[1] != shard.vertices:
        raise BodyError(
            f"identity {identity} has {vertices.shape[1]:,} vertices in pose {poses[0]}, and had {shard.vertices:,} "
            "when the dataset was begun. Use the files that it was begun with, and run again"
        )
    low, high = bounds(vertices)
    sound = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1) & ((high - low).max(axis=1) > 0)
    if not sound.all():
        raise BodyError(
            f"identity {identity} (parameters {parameters.tolist()}) has a degenerate or non-finite mesh in pose "
            f"{poses[int(np.argmin(sound))]}. Narrow the identity ranges of the recipe"
        )
    return low, high


_kept: dict[tuple[str, range], Poses] = {}
_keeping = Lock()
_KEPT_POSES = 12_800
"""Poses of earlier shards that a process keeps: some 30 MB with the world rotations of SMPL's joints."""


def _poses(recipe: str, numbers: range) -> Poses:
    """The poses of a shard, kept for the next identities, whose shards have the same blocks of poses."""
    key = recipe, numbers
    with _keeping:
        poses = _kept.pop(key, None) or draw_poses(PoseRecipe.model_validate_json(recipe), numbers)
        _kept[key] = poses
        while sum(map(len, _kept.values())) > _KEPT_POSES:  # the block that was asked for longest ago
            del _kept[next(iter(_kept))]
    return poses


def batches(recipe: DatasetRecipe, shards: Sequence[Wanted]) -> Iterator[list[Wanted]]:
    """Divide shards among tasks: each makes at least one, half a second of them where there are many."""
    estimates = [seconds_of(recipe, shard.rows, shard.vertices) for shard, _ in shards]
    most, batch, seconds = min(TASK_SECONDS, sum(estimates) / _FEWEST_TASKS), list[Wanted](), 0.0
    for wanted, estimate in zip(shards, estimates, strict=True):
        if batch and seconds + estimate > most:
            yield batch
            batch, seconds = [], 0.0
        batch.append(wanted)
        seconds += estimate
    if batch:
        yield batch


def ensure_shards(url: str, recipe: DatasetRecipe, shards: Sequence[Wanted]) -> list[ManifestRow]:
    """The manifest rows of some shards, each of which is made and written first unless it is there and sound; a task.

    Raises
    ------
    DatasetError
        The dataset is being made by another recipe now, or from other assets than this machine has.
    """
    writer = ShardWriter(url, recipe)
    require_same_assets(url, recipe.model_dump_json())
    return [_ensured(writer, recipe, shard, committed) for shard, committed in shards]


def _ensured(writer: ShardWriter, recipe: DatasetRecipe, shard: Shard, committed: str | None) -> ManifestRow:
    row = existing_shard(writer.group, recipe, shard)
    if row is not None and committed in (None, row.blake3):
        return row
    return writer.write(shard, make_shard(recipe, shard), committed=committed)


@lru_cache(maxsize=64)
def require_same_assets(url: str, recipe: str) -> None:
    """Once a process: this machine has the assets that the dataset was begun with."""
    parsed = DatasetRecipe.model_validate_json(recipe)
    if parsed.body.family not in READS_FOLDERS:
        check_same_assets(url, open_group(url), assets_of(parsed, load_body(parsed.body)))
