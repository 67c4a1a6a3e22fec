"""What data was made from: packages and files, with licence and hash, and this code, to make the same bytes again."""

import subprocess
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from datagen.common.errors import BodyError, UnsafeFileError, reason_of
from datagen.common.files import sha256_of


@dataclass(frozen=True)
class Asset:
    """A package or a file: its licence, and its version or the hash of its content."""

    name: str
    licence: str
    version: str


def file_asset(path: Path, *, licence: str, name: str | None = None) -> Asset:
    """Return a file as an asset, known by the sha256 of its bytes.

    Raises
    ------
    BodyError
        It cannot be read.
    """
    try:
        digest = sha256_of(path)
    except (OSError, UnsafeFileError) as error:
        raise BodyError(
            f"{path}, which the data is made from, cannot be read ({reason_of(error)}). Put it there, or name another "
            "in the recipe"
        ) from error
    return Asset(name or path.name, licence, f"sha256:{digest}")


def git(*arguments: str) -> str:
    """Return what git says of the working tree that this code runs from; nothing of an installed copy, a sent job."""
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    with suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(
            command, capture_output=True, encoding="utf-8", errors="replace", check=True, timeout=10
        ).stdout.strip()
    return ""
