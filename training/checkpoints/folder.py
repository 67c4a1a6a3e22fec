"""The folder of a checkpoint on the disk: committed at once, hashed, checked, forgotten. See
training.checkpoints.checkpoint.

What a manifest or RUN/best names is read inside its own folder only.
"""

import functools
import hashlib
import json
import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError
from safetensors import SafetensorError
from torch import Tensor

from datagen.common.errors import DamagedFileError, UnsafeFileError, storage_errors
from datagen.common.files import (
    fault_in,
    open_regular,
    read_within,
    resolve_within,
    sha256_of,
    sync_folder,
    warn_once,
    write_atomically,
)
from training.checkpoints.weights import About, about_in, write_weights

WEIGHTS, AVERAGE, STATE, MANIFEST = "weights.safetensors", "average.safetensors", "state.pt", "manifest.json"
BEST, LATEST = "best", "latest"
_STEP = re.compile(r"step-\d{8,15}")
Writer = Callable[[Path], None]


def weights_writer(weights: Mapping[str, Tensor], about: Mapping[str, Any]) -> Writer:
    """What writes a file of weights once its path is known."""
    return lambda path: write_weights(path, weights, about)


def commit(final: Path, about: Mapping[str, Any], writers: Mapping[str, Writer]) -> None:
    """Make the folder of a checkpoint appear whole or not at all.

    Raises
    ------
    StorageError
        It could not be written.
    """
    with _writing(final):
        final.parent.mkdir(parents=True, exist_ok=True)
        temporary = final.parent / f".partial-{secrets.token_hex(8)}"
        temporary.mkdir()  # not mkdtemp, whose folders nobody but the owner may read
        try:
            _write(temporary, about, writers)
            shutil.rmtree(final, ignore_errors=True)  # a damaged one
            os.replace(temporary, final)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        sync_folder(final.parent)


def commit_into(folder: Path, about: Mapping[str, Any], writers: Mapping[str, Writer]) -> None:
    """Write files and their manifest, which comes last, into a folder that may hold other things.

    Raises
    ------
    StorageError
        They could not be written.
    """
    with _writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".partial-") as temporary:
            _write(Path(temporary), about, writers)
            for name in (*writers, MANIFEST):
                os.replace(Path(temporary) / name, folder / name)
        sync_folder(folder)


def _writing(place: Path) -> AbstractContextManager[None]:
    """A full disk, which safetensors and torch say in their own ways, becomes one StorageError."""
    also = (SafetensorError, RuntimeError)
    return storage_errors(f"checkpoint {place}", advice="Earlier checkpoints are kept", also=also)


class _Manifest(About):
    sha256: dict[Literal["weights.safetensors", "average.safetensors", "state.pt"], str]
    manifest_sha256: str | None = None


def manifest_of(path: Path) -> dict[str, Any]:
    """The manifest of a checkpoint, read as it is.

    Raises
    ------
    DamagedFileError
        It is no JSON object with values of a manifest's types, or nested too deep.
    UnsafeFileError
        It leads out of the folder, is not a regular file, or is far too long.
    OSError
        It is not there, or cannot be read.
    """
    content = read_within(path, MANIFEST)
    try:
        return about_in(content, _Manifest)
    except ValidationError as error:
        raise DamagedFileError(f"{MANIFEST} is unreadable: {fault_in(error)}") from error


def is_listed(path: Path) -> bool:
    """Whether a file is one of those that the manifest beside it vouches for."""
    try:
        return path.name in manifest_of(path.parent)["sha256"]
    except _UNREADABLE:
        return False


def write_manifest(path: Path, manifest: Mapping[str, Any]) -> None:
    """Write a manifest with a hash of itself, at once."""
    sealed = {**manifest, "manifest_sha256": _seal(manifest)}
    write_atomically(path / MANIFEST, json.dumps(sealed, indent=1).encode())


def fault_of(path: Path, *, only: str | None = None, weights_only: bool = False) -> str | None:
    """Return what is wrong with the checkpoint in a folder, None if nothing is.

    A file is read once in a process, while it stays as it is.

    Parameters
    ----------
    only
        Name of the one file to verify.
    weights_only
        Verify the file that inference loads and no other: the average of the weights, where there is one.
    """
    try:
        manifest = manifest_of(path)
        if manifest.get("manifest_sha256", _seal(manifest)) != _seal(manifest):
            return f"{MANIFEST} is not as it was written"
        listed = manifest["sha256"]
        if weights_only and only is None:
            only = AVERAGE if AVERAGE in listed else WEIGHTS
        for name in listed if only is None else [only]:
            if _sha256_once(resolve_within(path, name)) != listed.get(name):
                return f"sha256 of {name} differs from its manifest"
    except _UNREADABLE as error:
        return str(error)
    return None


def best_of(run: Path) -> Path | None:
    """The newest checkpoint that was the best when it was written.

    The manifests decide, for a kill may come before RUN/best is moved; RUN/best counts where a manifest is unreadable.
    """
    marked = [path for path in newest_first(run) if _is_marked_best(path)][:1]
    return max((*marked, *_named_best(run)), default=None)


def checkpoints_of(run: Path) -> Path:
    """RUN/checkpoints.

    Raises
    ------
    UnsafeFileError
        It is a link that leads out of the run.
    """
    resolve_within(run, "checkpoints")
    return run / "checkpoints"


def step_folder(run: Path, name: str) -> Path:
    """RUN/checkpoints/NAME.

    Raises
    ------
    UnsafeFileError
        It leads out of RUN/checkpoints.
    """
    resolve_within(checkpoints_of(run), name)
    return run / "checkpoints" / name


def newest_first(run: Path) -> Iterator[Path]:
    """Folders of a run's checkpoints, sound or not; links are none."""
    folders = (path for path in checkpoints_of(run).glob("step-*") if not path.is_symlink())
    yield from sorted(folders, reverse=True)


def forget_old(run: Path, keep: int) -> None:
    """Remove all checkpoints but the newest ``keep`` sound ones and the best, and what a kill left half written."""
    sound = [path for path in newest_first(run) if fault_of(path) is None]
    for path in set(newest_first(run)) - {*sound[:keep], best_of(run)}:
        shutil.rmtree(path, ignore_errors=True)
    for path in checkpoints_of(run).glob(".partial-*"):
        shutil.rmtree(path, ignore_errors=True)


_UNREADABLE = (OSError, DamagedFileError, UnsafeFileError)
"""What a missing, cut, flipped or made up manifest can lead to."""


def _write(folder: Path, about: Mapping[str, Any], writers: Mapping[str, Writer]) -> None:
    for name, write in writers.items():
        write(folder / name)
        _sync(folder / name)
    write_manifest(folder, {**about, "sha256": {name: sha256_of(folder / name) for name in writers}})


def _seal(manifest: Mapping[str, Any]) -> str:
    content = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _sync(path: Path) -> None:
    with open_regular(path) as file:
        os.fsync(file.fileno())


def _named_best(run: Path) -> Iterator[Path]:
    """The checkpoint that RUN/best names, if it names one; what else it holds is said and left out."""
    try:
        name = read_within(run, BEST, limit=_LONGEST_NAME).decode().strip()
        if not _STEP.fullmatch(name):
            raise DamagedFileError(f"{run / BEST} names {name[:80]!r}, which is no checkpoint")
        yield step_folder(run, name)
    except FileNotFoundError:
        return
    except (UnicodeDecodeError, DamagedFileError, UnsafeFileError) as error:
        warn_once(f"{error}. The manifests of the checkpoints say which is the best")


_LONGEST_NAME = 1000  # bytes


def _is_marked_best(path: Path) -> bool:
    try:
        return bool(manifest_of(path).get("best"))
    except _UNREADABLE:
        return False


def _sha256_once(path: Path) -> str:
    """Return the sha256 of a file, read again only where its status has changed or is so young that it may not tell."""
    status = path.stat()
    if time.time() - status.st_mtime < _CLOCK_TICK:
        return sha256_of(path)
    return _known_sha256(path, status.st_ino, status.st_mtime_ns, status.st_size)


_CLOCK_TICK = 2.0
"""Seconds within which two writes of a file may bear the same time, on the coarsest file systems."""


@functools.lru_cache(maxsize=64)
def _known_sha256(path: Path, *signature: int) -> str:
    return sha256_of(path)
