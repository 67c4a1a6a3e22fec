"""Datasets as somebody with bad intentions would send them: changed, and sealed again so that every hash fits."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
    """Change a dataset's manifest and root attributes, and make all hashes fit what is there then."""

    def with_hashes(document: dict[str, Any]) -> None:
        objects = document["attributes"]["objects"]
        for path in objects:
            if (url / path).is_file() and (url / path).stat().st_size:
                objects[path] = hashlib.sha256((url / path).read_bytes()).hexdigest()
        manifest(document["attributes"])

    def with_digests(document: dict[str, Any]) -> None:
        content = json.loads((url / "manifest/zarr.json").read_text())["attributes"]
        found = document["attributes"]
        attributes(found)
        found["manifest_sha256"] = digest(content)
        found.pop("attributes_sha256", None)
        found["attributes_sha256"] = digest(found)

    edit(url / "manifest/zarr.json", with_hashes)
    edit(url / "zarr.json", with_digests)
