"""Finding every fault of a dataset, and describing one at any status."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr

from datagen.grid import Grid, Shard
from datagen.recipe import DatasetRecipe
from datagen.store.reader import read_manifest
from datagen.store.schema import (
    ManifestRow,
    array_at,
    attributes_of,
    check_version,
    identity_name,
    open_group,
    read_bytes,
    shard_path,
    stored_recipe,
    stored_sizes,
    vertices_path,
)
from datagen.store.writer import existing_shard

Progress = Callable[[Iterable[Shard]], Iterable[Shard]]


@dataclass(frozen=True)
class Fault:
    """Something in a dataset that is not what it must be: where, why, and the shard to make again if it is one."""

    path: str
    reason: str
    shard: Shard | None = None


def find_faults(url: str, *, progress: Progress = iter) -> Iterator[Fault]:
    """Check every shard of the dataset's grid (present, hash as in the manifest, decodable, finite), then the rest."""
    group = open_group(url)
    grid = Grid(require_recipe(url))
    manifest = {row.path: row for row in read_manifest(group)}
    for shard in progress(grid.shards()):
        reason = _fault(url, grid.recipe, shard, read_bytes(group, shard_path(shard)), manifest.get(shard_path(shard)))
        if reason:
            yield Fault(shard_path(shard), reason, shard)
    yield from _small_faults(group, grid)


def _small_faults(group: zarr.Group, grid: Grid) -> Iterator[Fault]:
    homes = [f"identity/{identity_name(identity)}" for identity in range(grid.identity_count)]
    paths = ["pose/parameters", "evaluation/seen", "evaluation/unseen"]
    paths += [f"{home}/{name}" for home in homes for name in ("pose", "parameters")]
    topologies = {str(group[home].attrs.get("topology", "?")) for home in homes if home in group}
    paths += [f"topology/{topology}/faces" for topology in sorted(topologies)]
    for path in paths:
        try:
            np.asarray(array_at(group, path)[...])
        except KeyError:
            yield Fault(path, "missing")
        except (RuntimeError, ValueError, OSError) as error:
            yield Fault(path, f"cannot be read ({error})")


def _fault(url: str, recipe: DatasetRecipe, shard: Shard, raw: bytes | None, row: ManifestRow | None) -> str | None:
    if raw is None:
        return "missing"
    if row is not None and len(raw) != row.bytes:
        return f"{len(raw)} bytes instead of {row.bytes}"
    if row is not None and hashlib.sha256(raw).hexdigest() != row.sha256:
        return "its sha256 is not the manifest's"
    if existing_shard(url, recipe, shard) is None:
        return "cannot be decoded"
    return None


def describe(url: str) -> dict[str, Any]:
    """What a person wants to know of a dataset, at any status: grid, progress, sizes, provenance."""
    group = open_group(url)
    check_version(url, group)
    attributes = attributes_of(group)
    recipe = stored_recipe(url, group)
    grid = Grid(recipe)
    shards = grid.shards()
    sizes = stored_sizes(group, [shard_path(shard) for shard in shards])
    return {
        "dataset": url,
        "status": attributes["status"],
        "uuid": attributes["uuid"],
        "body": f"{recipe.body.family} {_topology(recipe)}".strip(),
        "identities": f"{recipe.identities.training} training, {recipe.identities.evaluation} evaluation",
        "poses": f"{recipe.poses.seen} seen, {recipe.poses.unseen} unseen ({recipe.poses.distribution})",
        "meshes": f"{grid.mesh_count:,} of {_vertex_counts(group, grid)} vertices",
        "shards": f"{len(sizes)} of {len(shards)} written, {sum(sizes.values()) / 1e6:,.1f} MB",
        "evaluation triples": f"{recipe.triples.count} for each pose type",
        "assets": "; ".join(f"{a['name']} {a['version']} ({a['licence']})" for a in attributes["body"]["assets"]),
        "packages": ", ".join(f"{name} {version}" for name, version in attributes["provenance"]["packages"].items()),
        "git commit": attributes["provenance"]["git_commit"],
        "recipe sha256": attributes["recipe_sha256"],
    }


def _topology(recipe: DatasetRecipe) -> str:
    return str(getattr(recipe.body, "topology", ""))


def _vertex_counts(group: zarr.Group, grid: Grid) -> str:
    paths = [vertices_path(identity) for identity in range(grid.identity_count)]
    counts = sorted({array_at(group, path).shape[1] for path in paths if path in group})
    if not counts:
        return "unknown"
    return f"{counts[0]:,}" if len(counts) == 1 else f"{counts[0]:,} to {counts[-1]:,}"


def require_recipe(url: str) -> DatasetRecipe:
    """The recipe stored with a dataset of any status (DatasetError where there is none that can be read)."""
    group = open_group(url)
    check_version(url, group)
    return stored_recipe(url, group)
