"""Finding every fault of a dataset, and describing one at any status."""

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import zarr

from datagen.common.errors import DatasetError, UnsafeFileError, reason_of
from datagen.grid import POSE_TYPES, SPLITS, Grid, Shard
from datagen.recipe import DatasetRecipe, MixedBody
from datagen.store.arrays import ArrayDamage, read_array
from datagen.store.attributes import attributes_fault
from datagen.store.manifest import Manifest, changed_objects, covers, is_sealed, read_manifest
from datagen.store.reader import Dataset
from datagen.store.schema import (
    ManifestRow,
    attributes_of,
    check_version,
    open_group,
    read_bytes,
    shard_path,
    stored_recipe,
    stored_sizes,
)
from datagen.store.writer import existing_shard, stored_vertex_count

Progress = Callable[[Iterable[Shard]], Iterable[Shard]]


@dataclass(frozen=True)
class Fault:
    """Something in a dataset that is not what it must be: where, why, and the shard to make again if it is one."""

    path: str
    reason: str
    shard: Shard | None = None


def find_faults(url: str, *, progress: Progress = iter) -> Iterator[Fault]:
    """Check everything: each shard of the dataset's grid, then every other object, by the hashes of the manifest.

    Where a dataset is still being made there is no manifest; its shards are decoded instead.
    """
    group = open_group(url)
    grid, manifest = Grid(require_recipe(url)), read_manifest(group) or Manifest()
    rows = {row.path: row for row in manifest.shards}
    for shard in progress(grid.shards()):
        reason = _fault(group, grid, shard, rows.get(shard_path(shard)))
        if reason:
            yield Fault(shard_path(shard), reason, shard)
    changed = [Fault(path, reason) for path, reason in changed_objects(group, manifest)]
    yield from changed
    if attributes_of(group).get("status") == "complete":
        root = list(_root_faults(group, grid))
        yield from root
        if not changed and not root:
            yield from _misfits(Dataset(url, group))


def _root_faults(group: zarr.Group, grid: Grid) -> Iterator[Fault]:
    if not is_sealed(group):
        yield Fault("zarr.json", "its attributes are not as they were written")
    elif reason := attributes_fault(group):
        yield Fault("zarr.json", reason)
    manifest = read_manifest(group)
    if manifest is None or not covers(manifest, grid):
        yield Fault("manifest/zarr.json", "not the manifest that was committed")


def _misfits(dataset: Dataset) -> Iterator[Fault]:
    """Arrays that are as they were committed, and yet not as the format has them."""
    identities = range(dataset.grid.identity_count)
    reads = [
        dataset.poses,
        *(partial(dataset.evaluation_triples, pose_type) for pose_type in POSE_TYPES),
        *(partial(read, identity) for identity in identities for read in (dataset.faces, dataset.parameters)),
    ]
    found = (_damage_of(read) for read in reads)
    yield from dict.fromkeys(Fault(damage.path, damage.reason) for damage in found if damage)


def _damage_of(read: Callable[[], Any]) -> ArrayDamage | None:
    try:
        read()
    except DatasetError as error:
        if isinstance(error.__cause__, ArrayDamage):
            return error.__cause__
        raise
    return None


def _fault(group: zarr.Group, grid: Grid, shard: Shard, row: ManifestRow | None) -> str | None:
    if row is None:
        return None if existing_shard(group, grid, shard) else "missing or damaged"
    try:
        content = read_bytes(group, row.path, limit=row.bytes)
    except (OSError, UnsafeFileError) as error:
        return f"cannot be read ({reason_of(error)})"
    if content is None:
        return "missing"
    if len(content) != row.bytes:
        return f"{len(content)} bytes instead of {row.bytes}"
    if hashlib.sha256(content).hexdigest() != row.sha256:
        return "its sha256 is not the manifest's"
    metadata_is_lost = stored_vertex_count(group, grid, shard.identity) is None  # a fault of its own
    return None if metadata_is_lost or existing_shard(group, grid, shard) else "cannot be decoded"


def describe(url: str) -> dict[str, Any]:
    """What a person wants to know of a dataset, at any status: grid, progress, sizes, provenance."""
    group = open_group(url)
    check_version(url, group)
    fault = attributes_fault(group)
    if fault:
        raise DatasetError(f"{url}: {fault}. Mend it: dsffnet verify {url} --repair")
    attributes, recipe = attributes_of(group), stored_recipe(url, group)
    grid = Grid(recipe)
    shards = grid.shards()
    sizes = stored_sizes(group, [shard_path(shard) for shard in shards])
    facts = {
        "dataset": url,
        "status": attributes["status"],
        "uuid": attributes["uuid"],
        "body": f"{recipe.body.family} {_kind(recipe)}".strip(),
        "identities": ", ".join(f"{_count(grid.identities(split))} {split}" for split in SPLITS),
        "poses": f"{len(grid.poses('seen'))} seen, {len(grid.poses('unseen'))} unseen "
        f"({recipe.poses.distribution.name}, {len(attributes['joints'])} joints)",
        "appended": _growth(recipe),
        "meshes": f"{grid.mesh_count:,} of {_vertex_counts(group, grid)} vertices",
        "shards": f"{len(sizes)} of {len(shards)} written, {sum(sizes.values()) / 1e6:,.1f} MB",
        "extent": _extent(attributes),
        "evaluation triples": ", ".join(f"{_triples(group, kind)} {kind}" for kind in POSE_TYPES),
        "assets": _assets(attributes["body"]["assets"]),
        "packages": ", ".join(f"{name} {version}" for name, version in attributes["provenance"]["packages"].items()),
        "git commit": attributes["provenance"]["git_commit"],
        "recipe sha256": attributes["recipe_sha256"],
    }
    return {name: fact for name, fact in facts.items() if fact}


def _assets(assets: list[dict[str, str]]) -> str:
    """What it was made from, with licences; hashes are cut short, the attributes have them whole."""
    named: dict[str, list[str]] = {}
    for asset in assets:
        version = asset["version"]
        short = version[:19] if version.startswith("sha256:") else version
        named.setdefault(asset["licence"], []).append(f"{asset['name']} {short}")
    return "; ".join(f"{', '.join(names)} ({licence})" for licence, names in named.items())


def _triples(group: zarr.Group, pose_type: str) -> int:
    try:
        return len(read_array(group, f"evaluation/{pose_type}", "int32", (None, 4)))
    except ArrayDamage:
        return 0


def _count(numbers: list[int]) -> str:
    """How many, and which numbers."""
    if not numbers:
        return "0"
    spans = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    words = (f"{span[0]}-{span[-1]}" if len(span) > 1 else str(span[0]) for span in spans)
    return f"{len(numbers)} ({', '.join(words)})"


def _growth(recipe: DatasetRecipe) -> str:
    steps = (
        ", ".join(f"{count} {name}" for name, count in step.model_dump().items() if count) for step in recipe.growth
    )
    return "; then ".join(steps)


def _extent(attributes: dict[str, Any]) -> str:
    if attributes["status"] != "complete":
        return ""
    found = attributes["statistics"]
    sides = np.subtract(found["maximum"], found["minimum"])
    return " x ".join(f"{side:.2f}" for side in sides) + " m, all meshes together"


def _kind(recipe: DatasetRecipe) -> str:
    """The one word that says which of its family a body is."""
    body = recipe.body
    if isinstance(body, MixedBody):
        return "of " + ", ".join(part.family for part in body.bodies)
    words = (getattr(body, name, None) for name in ("topology", "model", "layout", "characters", "path"))
    return next((word if isinstance(word, str) else ", ".join(word) for word in words if word), "")


def _vertex_counts(group: zarr.Group, grid: Grid) -> str:
    found = {stored_vertex_count(group, grid, identity) for identity in range(grid.identity_count)}
    counts = sorted(count for count in found if count)
    if not counts:
        return "unknown"
    return f"{counts[0]:,}" if len(counts) == 1 else f"{counts[0]:,} to {counts[-1]:,}"


def require_recipe(url: str) -> DatasetRecipe:
    """The recipe stored with a dataset of any status (DatasetError where there is none that can be read)."""
    group = open_group(url)
    check_version(url, group)
    return stored_recipe(url, group)
