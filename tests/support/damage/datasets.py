"""Datasets as somebody with bad intentions would send them: changed, and sealed again so that every hash fits."""

import contextlib
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from datagen.store.arrays import put_array, put_group
from datagen.store.manifest import Manifest, stored_manifest
from datagen.store.schema import attributes_of, open_group

Change = Callable[[dict[str, Any]], object]


def digest(content: Any) -> str:
    """Digest of plain data as a dataset's root has it."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def edit(path: Path, change: Change) -> None:
    """Change a JSON document in place."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def sealed(url: Path, *, manifest: Change = dict, attributes: Change = dict) -> None:
    """Change a dataset's manifest (its columns, and ``objects``) and root attributes; all hashes fit what is there."""
    group = open_group(str(url), mode="r+")
    found = stored_manifest(group)
    objects = {path: _sha256(url / path) or old for path, old in found.objects.items()}
    content = {name: values.copy() for name, values in found.columns.items()}
    changed: dict[str, Any] = {**content, "objects": objects}
    manifest(changed)
    objects = changed.pop("objects")
    _write_manifest(group, changed, objects)
    stated = attributes_of(group)
    with contextlib.suppress(AttributeError, ValueError, TypeError):  # what no hash can be made of
        stated["manifest_sha256"] = Manifest(changed, objects).digest()
    attributes(stated)
    stated.pop("attributes_sha256", None)
    edit(url / "zarr.json", lambda root: root.update(attributes={**stated, "attributes_sha256": digest(stated)}))


def _sha256(path: Path) -> str | None:
    """Of a file that can be read as one."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() and path.stat().st_size else None


def _write_manifest(group: Any, columns: dict[str, np.ndarray], objects: Any) -> None:
    if isinstance(objects, dict):
        hashes = b"".join(map(bytes.fromhex, objects.values()))
        put_array(group, "manifest/object_sha256", np.frombuffer(hashes, np.uint8).reshape(-1, 32), ("object", "byte"))
    put_group(group, "manifest", {"objects": list(objects) if isinstance(objects, dict) else objects})
    for name, values in columns.items():
        put_array(group, f"manifest/{name}", values, ["shard"] * values.ndim)
