"""Hashes made to fit again, as somebody does who changes a dataset or a checkpoint on purpose."""

import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from datagen.common.errors import DsffnetError
from datagen.grid import shard_path
from datagen.store.manifest import shard_hash
from tests.support.damage.datasets import sealed

_LARGEST = 2**24  # bytes of a file that is looked into


def is_plain(path: Path) -> bool:
    """Whether a path is a regular file of a size that can be read; no earlier damage has made it another thing."""
    return path.is_file() and not path.is_symlink() and path.stat().st_size < _LARGEST


def reseal_dataset(root: Path) -> None:
    """Make every hash of a dataset fit what lies there, if its manifest can be read."""

    def with_shards(manifest: dict[str, Any]) -> None:
        for row, place in enumerate(manifest["place"].tolist()):
            if is_plain(root / shard_path(place)):
                content = _read(root / shard_path(place))
                manifest["bytes"][row] = len(content)
                manifest["blake3"][row] = np.frombuffer(bytes.fromhex(shard_hash(content)), np.uint8)

    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError, KeyError, RecursionError, DsffnetError):
        sealed(root, manifest=with_shards)


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


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
