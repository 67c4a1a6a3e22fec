"""What a complete dataset consists of: a row for each shard, a hash for every other object, one digest over all.

The manifest is committed last, and the root's attributes carry its digest and one of their own, so that nothing in
a dataset can change unnoticed.
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from typing import Any

import zarr

from datagen.store.schema import ManifestRow, attributes_of, list_objects, read_bytes, require_group

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


def read_manifest(group: zarr.Group) -> list[ManifestRow]:
    """Manifest rows of a group, empty where there is no manifest yet."""
    return [ManifestRow.from_json(row) for row in _content(group).get("shards", [])]


def is_sealed(group: zarr.Group) -> bool:
    """Whether the root's attributes are as :func:`commit` left them."""
    attributes = attributes_of(group)
    return attributes.get(_SEAL) == _digest(_without_seal(attributes))


def manifest_is_the_committed_one(group: zarr.Group) -> bool:
    """Whether the manifest is the one that the root's attributes name."""
    return attributes_of(group).get("manifest_sha256") == _digest(_content(group))


def changed_objects(group: zarr.Group) -> Iterator[tuple[str, str]]:
    """Objects beside the shards that are not as they were written: path, and what is wrong."""
    for path, digest in _content(group).get("objects", {}).items():
        content = read_bytes(group, path)
        if content is None:
            yield path, "missing"
        elif _sha256(content) != digest:
            yield path, "its sha256 is not the manifest's"


def _content(group: zarr.Group) -> dict[str, Any]:
    try:
        return dict(json.loads(read_bytes(group, _MANIFEST) or b"{}").get("attributes", {}))
    except ValueError:
        return {}


def _small_objects(group: zarr.Group) -> list[str]:
    return [path for path in list_objects(group) if path not in (_ROOT, _MANIFEST) and "/vertices/c/" not in path]


def _without_seal(attributes: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in attributes.items() if key != _SEAL}


def _digest(content: Any) -> str:
    return _sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
