"""What data was made from: packages and files, with licence and hash, so that the same bytes can be made again."""

import hashlib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Asset:
    """A package or a file: its licence, and its version or the hash of its content."""

    name: str
    licence: str
    version: str


def file_asset(path: Path, *, licence: str, name: str | None = None) -> Asset:
    """A file as an asset, known by the sha256 of its bytes."""
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return Asset(name or path.name, licence, f"sha256:{digest}")
