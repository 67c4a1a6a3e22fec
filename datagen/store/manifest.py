"""What a complete dataset consists of: a row for each shard, a hash for every other object, one digest over all.

The manifest is committed last, and the root's attributes carry its digest and one of their own, so that nothing in
a dataset can change unnoticed.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import zarr
from pydantic import TypeAdapter

from datagen.common.errors import UnsafeFileError, reason_of
from datagen.grid import Grid
from datagen.store.object_names import is_member, require_member
from datagen.store.schema import (
    ManifestRow,
    attributes_of,
    list_objects,
    parse_json,
    read_bytes,
    require_group,
    shard_path,
)

_ROOT, _MANIFEST = "zarr.json", "manifest/zarr.json"
_SEAL = "attributes_sha256"


def commit(group: zarr.Group, rows: Sequence[ManifestRow], attributes: dict[str, Any]) -> None:
    """Write the manifest, then the root's last attributes with the digests of both."""
    ordered = sorted(rows)
    content = {
        "shards": [row.as_json() for row in ordered],
        "objects": {path: _sha256(read_bytes(group, path) or b"") for path in _small_objects(group)},
    }
    require_group(group, "manifest").update_attributes(content)
    stated = {**attributes_of(group), **attributes, "manifest_sha256": _digest(content)}
    group.update_attributes({**stated, _SEAL: _digest(_without_seal(stated))})


@dataclass(frozen=True)
class Manifest:
    """What a dataset was when it was committed: its shards, and the sha256 of every other object by its path."""

    shards: list[ManifestRow] = field(default_factory=list)
    objects: dict[str, str] = field(default_factory=dict)


_PARSED = TypeAdapter(Manifest)


def read_manifest(group: zarr.Group) -> Manifest | None:
    """The manifest that the root's attributes name, None where there is none or another.

    Raises
    ------
    UnsafeFileError
        It names what is no object of a dataset.
    """
    try:
        content = parse_json(read_bytes(group, _MANIFEST) or b"")["attributes"]
        if attributes_of(group).get("manifest_sha256") != _digest(content):
            return None
        manifest = _PARSED.validate_python(content)
    except (ValueError, TypeError, KeyError, RecursionError, OSError, UnsafeFileError):
        return None
    for path in (*manifest.objects, *(row.path for row in manifest.shards)):
        require_member(path)
    return manifest


def covers(manifest: Manifest, grid: Grid) -> bool:
    """Whether a manifest lists the shards of a grid and no others; none are listed where their number differs."""
    if len(manifest.shards) != grid.shard_count:
        return False
    rows = {shard_path(shard): shard.rows for shard in grid.shards()}
    return {row.path: row.rows for row in manifest.shards} == rows


def is_sealed(group: zarr.Group) -> bool:
    """Whether the root's attributes are as :func:`commit` left them."""
    attributes = attributes_of(group)
    return attributes.get(_SEAL) == _digest(_without_seal(attributes))


def changed_objects(group: zarr.Group, manifest: Manifest) -> Iterator[tuple[str, str]]:
    """Objects beside the shards that are not as they were written: path, and what is wrong."""
    for path, digest in manifest.objects.items():
        try:
            content = read_bytes(group, path)
        except (OSError, UnsafeFileError) as error:
            yield path, f"cannot be read ({reason_of(error)})"
            continue
        if content is None:
            yield path, "missing"
        elif _sha256(content) != digest:
            yield path, "its sha256 is not the manifest's"


def _small_objects(group: zarr.Group) -> list[str]:
    paths = (path for path in list_objects(group) if is_member(path) and "/vertices/c/" not in path)
    return [path for path in paths if path not in (_ROOT, _MANIFEST)]


def _without_seal(attributes: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in attributes.items() if key != _SEAL}


def _digest(content: Any) -> str:
    return _sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
