"""The tasks of generation: what comes before the shards, and each shard. Each can be repeated at any time."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import load_body
from datagen.common.errors import BodyError
from datagen.generate.plan import READS_FOLDERS, assets_of, identity_parameters, plan_of
from datagen.grid import GridArrays, Shard
from datagen.mesh.geometry import bounds
from datagen.poses import draw_poses
from datagen.recipe import DatasetRecipe
from datagen.store.attributes import check_same_assets
from datagen.store.manifest import ManifestRow
from datagen.store.schema import open_group
from datagen.store.writer import begin, existing_shard, require_driven, write_shard


def prepare(url: str, recipe: DatasetRecipe, growing: bool = False, lost: Sequence[str] = ()) -> GridArrays:
    """Load the body model and the poses, check that they fit, and create all of the dataset but its shards.

    Returns where its meshes go. See :func:`datagen.store.writer.begin`.
    """
    plan = plan_of(recipe)
    begin(url, plan, growing=growing, lost=lost)
    return plan.arrays


def make_shard(recipe: DatasetRecipe, shard: Shard) -> NDArray[np.float32]:
    """Vertices [identity, pose, vertex, 3] of one shard in metres, Y up: a pure function of its arguments.

    Raises
    ------
    BodyError
        The body model gave coordinates that are not finite, a mesh without extent, or other vertices than planned.
    """
    body, poses = load_body(recipe.body), draw_poses(recipe.poses, shard.poses)
    meshes = np.empty((len(shard.identities), len(shard.poses), shard.vertices, 3), np.float32)
    for place, identity in enumerate(shard.identities):
        vertices = body.vertices(identity_parameters(recipe, body, identity), poses)
        if vertices.shape[1] != shard.vertices:
            raise BodyError(
                f"identity {identity} has {vertices.shape[1]:,} vertices in pose {shard.poses[0]}, and had "
                f"{shard.vertices:,} when the dataset was begun. Use the files that it was begun with, and run again"
            )
        meshes[place] = vertices
    _require_extent(recipe, shard, meshes)
    return meshes


def _require_extent(recipe: DatasetRecipe, shard: Shard, meshes: NDArray[np.float32]) -> None:
    low, high = bounds(meshes.reshape(-1, *meshes.shape[2:]))
    sound = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1) & ((high - low).max(axis=1) > 0)
    faulty = np.flatnonzero(~sound.reshape(meshes.shape[:2]).all(axis=1))
    if len(faulty):
        identity = shard.identities[faulty[0]]
        parameters = identity_parameters(recipe, load_body(recipe.body), identity)
        raise BodyError(
            f"identity {identity} (parameters {parameters.tolist()}) has a degenerate or non-finite mesh in "
            f"poses {shard.poses[0]} to {shard.poses[-1]}. Narrow the identity ranges of the recipe"
        )


def ensure_shard(url: str, recipe: DatasetRecipe, shard: Shard, committed: str | None = None) -> ManifestRow:
    """The manifest row of a shard, which is made and written first unless it is there and sound.

    ``committed`` is its sha256 where the dataset has a manifest already: other bytes are neither kept nor written.

    Raises
    ------
    DatasetError
        The dataset is being made by another recipe now, or from other assets than this machine has.
    """
    group = require_driven(url, recipe)
    require_same_assets(url, recipe.model_dump_json())
    row = existing_shard(group, recipe, shard)
    if row is not None and committed in (None, row.sha256):
        return row
    return write_shard(url, recipe, shard, make_shard(recipe, shard), committed=committed)


@lru_cache(maxsize=64)
def require_same_assets(url: str, recipe: str) -> None:
    """Once a process: this machine has the assets that the dataset was begun with."""
    parsed = DatasetRecipe.model_validate_json(recipe)
    if parsed.body.family not in READS_FOLDERS:
        check_same_assets(url, open_group(url), assets_of(parsed, load_body(parsed.body)))
