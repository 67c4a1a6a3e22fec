"""Hashes made to fit again, as somebody does who changes a dataset or a checkpoint on purpose."""

import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any

_LARGEST = 2**24  # bytes of a file that is looked into


def is_plain(path: Path) -> bool:
    """Whether a path is a regular file of a size that can be read; no earlier damage has made it another thing."""
    return path.is_file() and not path.is_symlink() and path.stat().st_size < _LARGEST


def reseal_dataset(root: Path) -> None:
    """Make every hash of a dataset fit what lies there; what cannot be read is left out."""
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError, KeyError, RecursionError):
        manifest = json.loads(_read(root / "manifest" / "zarr.json"))
        content = manifest["attributes"]
        objects = content.get("objects", {})
        for name in list(objects):
            if is_plain(root / name):
                objects[name] = _sha256(_read(root / name))
        for row in content.get("shards", []):
            _reseal_row(root, row)
        _write(root / "manifest" / "zarr.json", manifest)
        whole = json.loads(_read(root / "zarr.json"))
        attributes = whole["attributes"]
        attributes["manifest_sha256"] = _digest(content)
        attributes.pop("attributes_sha256", None)
        attributes["attributes_sha256"] = _digest(attributes)
        _write(root / "zarr.json", whole)


def _reseal_row(root: Path, row: Any) -> None:
    with contextlib.suppress(OSError, TypeError, KeyError):
        content = _read(root / row["path"])
        row.update(sha256=_sha256(content), bytes=len(content))


def reseal_checkpoint(folder: Path) -> None:
    """Make the hashes of a checkpoint's manifest fit what lies there."""
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError, KeyError, RecursionError):
        manifest = json.loads(_read(folder / "manifest.json"))
        for name in manifest["sha256"]:
            if is_plain(folder / name):
                manifest["sha256"][name] = _sha256(_read(folder / name))
        manifest.pop("manifest_sha256", None)
        seal = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
        _write(folder / "manifest.json", {**manifest, "manifest_sha256": seal})


def _read(path: Path) -> bytes:
    if not is_plain(path):
        raise OSError(f"{path} has been made another thing")
    return path.read_bytes()


def _write(path: Path, value: Any) -> None:
    path.unlink()
    path.write_text(json.dumps(value))


def _digest(content: Any) -> str:
    return _sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
