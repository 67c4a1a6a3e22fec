"""Comparing and damaging files."""

import hashlib
from pathlib import Path


def tree_hash(root: Path | str) -> str:
    """Hash of the names and bytes of all files below a folder."""
    digest = hashlib.sha256()
    for path in sorted(Path(root).rglob("*")):
        if path.is_file():
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def flip_bit(path: Path, *, at: float = 0.5) -> None:
    """Flip one bit, ``at`` being the place as a fraction of the file."""
    content = bytearray(path.read_bytes())
    content[int(len(content) * at)] ^= 0x10
    path.write_bytes(content)


def truncate(path: Path) -> None:
    """Keep the first half of a file."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
