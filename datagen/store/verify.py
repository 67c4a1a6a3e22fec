"""Finding every fault of a dataset, and describing one at any status."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import zarr

from datagen.common.errors import DatasetError, UnsafeFileError, reason_of
from datagen.common.printable import counted
from datagen.grid import POSE_TYPES, SPLITS, Grid, GridArrays, Shard, shard_path
from datagen.mesh.parts import part_name
from datagen.recipe import DatasetRecipe, MixedBody, plain_sha256
from datagen.store.arrays import ArrayDamage, read_array
from datagen.store.attributes import attributes_fault, changed_recipe
from datagen.store.manifest import (
    Manifest,
    ManifestRow,
    SoFar,
    changed_objects,
    covers,
    is_sealed,
    manifest_of,
    read_manifest,
    shard_hash,
)
from datagen.store.objects import read_bytes, stored_sizes
from datagen.store.reader import Dataset, damage_of
from datagen.store.schema import FORMAT_VERSION, OLDEST_RECIPE, attributes_of, check_version, open_group, stored_recipe
from datagen.store.writer import decoded, existing_shard


@dataclass(frozen=True)
class Fault:
    """Something in a dataset that is not what it must be: where, why, and whether it is a shard."""

    path: str
    reason: str
    shard: bool = False


FaultProgress = Callable[[Iterable[Fault | None], int], Iterable[Fault | None]]
"""Wraps the results of shards, of which there are so many."""


def find_faults(url: str, *, progress: FaultProgress = lambda shards, total: shards) -> Iterator[Fault]:
    """Check everything: each shard of the dataset's grid, then every other object, by the hashes of the manifest.

    Where a dataset is still being made the manifest does not have all shards; the others are decoded instead.
    """
    group = open_group(url)
    check_version(url, group)
    dataset, manifest = Dataset(url, group), read_manifest(group) or manifest_of(SoFar().written, {})
    arrays = _arrays(dataset)
    total = arrays.shard_count if arrays else len(manifest.shards)
    yield from filter(None, progress(_shard_faults(dataset, manifest, arrays), total))
    changed = [Fault(path, reason) for path, reason in changed_objects(group, manifest)]
    yield from changed
    if attributes_of(group).get("status") == "complete":
        root = list(_root_faults(dataset))
        yield from root
        if not changed and not root:
            yield from _misfits(dataset)


def _shard_faults(dataset: Dataset, manifest: Manifest, arrays: GridArrays | None) -> Iterator[Fault | None]:
    """The fault of every shard; which there are is known from the grid's arrays, or else from the manifest."""
    rows = {row.place: row for row in manifest.shards}
    if arrays is None:
        reasons = ((row.path, _committed(dataset.group, row)[1]) for row in manifest.shards)
    else:
        shards = (shard for array in arrays.arrays for shard in array.shards())
        reasons = ((shard.path, _fault(dataset, shard, rows.get(shard.place))) for shard in shards)
    for path, reason in reasons:
        yield Fault(path, reason, shard=True) if reason else None


def _fault(dataset: Dataset, shard: Shard, row: ManifestRow | None) -> str | None:
    """Why a shard is not as it was committed; where none was, why it is not whole."""
    if row is None:
        return None if existing_shard(dataset.group, dataset.recipe, shard) else "missing or damaged"
    content, reason = _committed(dataset.group, row)
    if content is None:
        return reason
    return None if decoded(content, dataset.recipe, shard) is not None else "cannot be decoded"


def _committed(group: zarr.Group, row: ManifestRow) -> tuple[bytes | None, str | None]:
    """The bytes of a shard, None where they are not those that were committed, and why not."""
    try:
        content = read_bytes(group, row.path, limit=row.bytes)
    except (OSError, UnsafeFileError) as error:
        return None, f"cannot be read ({reason_of(error)})"
    if content is None:
        return None, "missing"
    if len(content) != row.bytes:
        return None, f"{len(content)} bytes instead of {row.bytes}"
    if shard_hash(content) != row.blake3:
        return None, "its hash is not the manifest's"
    return content, None


def _arrays(dataset: Dataset) -> GridArrays | None:
    """The dataset's arrays of vertices; None where what says so is damaged, which is a fault of its own."""
    return None if damage_of(lambda: dataset.arrays) else dataset.arrays


def _root_faults(dataset: Dataset) -> Iterator[Fault]:
    if not is_sealed(dataset.group):
        yield Fault("zarr.json", "its attributes are not as they were written")
    elif reason := attributes_fault(dataset.group):
        yield Fault("zarr.json", reason)
    arrays, manifest = _arrays(dataset), read_manifest(dataset.group)
    if manifest is None or (arrays and not covers(manifest, arrays)):
        yield Fault("manifest/zarr.json", "not the manifest that was committed")


def _misfits(dataset: Dataset) -> Iterator[Fault]:
    """Arrays that are as they were committed, and yet not as the format has them."""
    reads: list[Callable[[], Any]] = [lambda: dataset.arrays, dataset.rotations, lambda: dataset.rig_numbers]
    reads += [partial(dataset.rigs, number) for number in range(len(dataset.attributes["rigs"]))]
    reads += [partial(dataset.evaluation_triples, pose_type) for pose_type in POSE_TYPES]
    arrays = _arrays(dataset)
    for array in arrays.arrays if arrays else ():
        first = int(array.identities[0])
        reads += [
            partial(read, first) for read in (dataset.faces, dataset.part, dataset.parameters, dataset.vertex_count)
        ]
        reads.append(partial(dataset.check_axes, array))
    found = (damage_of(read) for read in reads)
    yield from dict.fromkeys(Fault(damage.path, damage.reason) for damage in found if damage)


def describe(url: str, *, written: Mapping[str, int] | None = None) -> dict[str, Any]:
    """What a person wants to know of a dataset, at any status: grid, progress, sizes, provenance.

    ``written`` are the sizes of the shards that are there by their paths, where they are known.
    """
    group = open_group(url)
    check_version(url, group)
    fault = attributes_fault(group)
    if fault:
        raise DatasetError(f"{url}: {fault}. Repair it: dsffnet verify {url} --repair")
    attributes, recipe = attributes_of(group), stored_recipe(url, group)
    dataset = Dataset(url, group)
    grid, arrays = Grid(recipe), _arrays(dataset)
    places = arrays.places()[0].tolist() if arrays else []
    sizes = stored_sizes(group, [shard_path(place) for place in places]) if written is None else written
    facts = {
        "dataset": url,
        "status": attributes["status"],
        "uuid": attributes["uuid"],
        "body": f"{recipe.body.family} {_kind(recipe)}".strip(),
        "identities": ", ".join(f"{_count(grid.identities(split))} {split}" for split in SPLITS),
        "poses": f"{len(grid.poses('seen'))} seen, {len(grid.poses('unseen'))} unseen "
        f"({recipe.poses.distribution.name}, {counted(len(attributes['joints']), 'joint')})",
        "rig": _rigs(attributes["rigs"]),
        "clothes": _clothes(dataset, arrays),
        "appended": _growth(recipe),
        "meshes": f"{grid.mesh_count:,} of {_vertex_counts(arrays)} vertices",
        "shards": f"{len(sizes)} of {len(places)} written, {sum(sizes.values()) / 1e6:,.1f} MB",
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


def _rigs(rigs: Sequence[Mapping[str, Any]]) -> str:
    """The parts of the first rig as a tree, and how many more rigs there are."""
    if not rigs:
        return ""
    parts = rigs[0]
    tree = ", ".join(_tree(parts["names"], parts["parents"], -1))
    counts = ", ".join(str(len(rig["names"])) for rig in rigs[1:])
    more = f"; other rigs of {counts} parts" if counts else ""
    return f"{len(parts['names'])} parts: {tree}{more}"


def _tree(names: Sequence[str], parents: Sequence[int], above: int) -> list[str]:
    """The parts that hang on part ``above``, each with those that hang on it in brackets."""
    below = [(name, _tree(names, parents, part)) for part, name in enumerate(names) if parents[part] == above]
    return [f"{name} ({', '.join(inner)})" if inner else name for name, inner in below]


def _clothes(dataset: Dataset, arrays: GridArrays | None) -> str:
    """How many identities are dressed, and of each number of parts the vertices of skin and garments."""
    if not dataset.attributes.get("labelled") or arrays is None:
        return ""
    labels = [dataset.part(identity) for identity in range(len(arrays.topologies))]
    counts = [np.bincount(label) for label in labels if label is not None]
    words = [f"{len(counts)} identities are dressed"]
    for parts in sorted({len(count) for count in counts}):
        alike = np.array([count for count in counts if len(count) == parts])
        spans = (f"{low:,}" if low == high else f"{low:,} to {high:,}"
                 for low, high in zip(alike.min(axis=0).tolist(), alike.max(axis=0).tolist(), strict=True))  # fmt: skip
        named = ", ".join(f"{part_name(part)} {span}" for part, span in enumerate(spans))
        words.append(f"{len(alike)} in {parts - 1} {'garments' if parts > 2 else 'garment'} (vertices: {named})")
    return "; ".join(words)


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


def _vertex_counts(arrays: GridArrays | None) -> str:
    if arrays is None:
        return "unknown"
    counts = sorted({array.vertices for array in arrays.arrays})
    return f"{counts[0]:,}" if len(counts) == 1 else f"{counts[0]:,} to {counts[-1]:,}"


def require_recipe(url: str) -> DatasetRecipe:
    """The recipe stored with a dataset of any status, also of an older format: it makes the dataset anew.

    Raises
    ------
    DatasetError
        There is none that can be read, or it is not as it was written.
    """
    group = open_group(url)
    check_version(url, group, oldest=OLDEST_RECIPE)
    recipe, attributes = stored_recipe(url, group), attributes_of(group)
    if attributes.get("recipe_sha256") != plain_sha256(attributes["recipe"]):
        raise changed_recipe(url)
    complete = attributes["format_version"] == FORMAT_VERSION and attributes.get("status") == "complete"
    if complete and not is_sealed(group):
        raise DatasetError(
            f"{url}: its attributes (zarr.json) are not as they were written. Repair it: dsffnet verify {url} --repair"
        )
    return recipe
