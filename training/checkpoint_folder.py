"""The folder of a checkpoint on the disk: committed at once, hashed, checked, forgotten. See training.checkpoint."""

import functools
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from torch import Tensor

from datagen.errors import storage_errors
from datagen.mesh import write_atomically
from training.weights import write_weights

WEIGHTS, AVERAGE, STATE, MANIFEST = "weights.safetensors", "average.safetensors", "state.pt", "manifest.json"
BEST, LATEST = "best", "latest"
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
        temporary = Path(tempfile.mkdtemp(dir=final.parent, prefix=".partial-"))
        try:
            _write(temporary, about, writers)
            shutil.rmtree(final, ignore_errors=True)  # a damaged one
            os.replace(temporary, final)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        _sync(final.parent)


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


def _writing(place: Path) -> AbstractContextManager[None]:
    """A full disk, which safetensors and torch say in their own ways, becomes one StorageError."""
    also = (SafetensorError, RuntimeError)
    return storage_errors(f"checkpoint {place}", advice="Earlier checkpoints are kept", also=also)


def manifest_of(path: Path) -> dict[str, Any]:
    """The manifest of a checkpoint, read as it is."""
    return dict(json.loads((path / MANIFEST).read_text()))


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


def fault_of(path: Path, *, only: str | None = None, once: bool = False) -> str | None:
    """What is wrong with the checkpoint in a folder (or with ``only`` one file of it), None if nothing is.

    ``once``: a file that looks as it did when this process last hashed it is not read again.
    """
    try:
        manifest = manifest_of(path)
        if manifest.get("manifest_sha256", _seal(manifest)) != _seal(manifest):
            return f"{MANIFEST} is not as it was written"
        for name, digest in manifest["sha256"].items():
            if only in (None, name) and (_sha256_once if once else _sha256)(path / name) != digest:
                return f"sha256 of {name} differs from its manifest"
    except _UNREADABLE as error:
        return f"{type(error).__name__}: {error}"
    return None


def best_of(run: Path) -> Path | None:
    """The newest checkpoint that was the best when it was written.

    The manifests decide, for a kill may come before RUN/best is moved; RUN/best counts where a manifest is unreadable.
    """
    marked = [path for path in newest_first(run) if _is_marked_best(path)][:1]
    if (run / BEST).exists():
        marked.append(run / "checkpoints" / (run / BEST).read_text().strip())
    return max(marked, default=None)


def newest_first(run: Path) -> Iterator[Path]:
    """Folders of a run's checkpoints, sound or not."""
    yield from sorted((run / "checkpoints").glob("step-*"), reverse=True)


def forget_old(run: Path, keep: int) -> None:
    """Remove all checkpoints but the newest ``keep`` sound ones and the best, and what a kill left half written."""
    sound = [path for path in newest_first(run) if fault_of(path, once=True) is None]
    for path in set(newest_first(run)) - {*sound[:keep], best_of(run)}:
        shutil.rmtree(path, ignore_errors=True)
    for path in (run / "checkpoints").glob(".partial-*"):
        shutil.rmtree(path, ignore_errors=True)


_UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""What a missing, cut or flipped manifest can lead to."""


def _write(folder: Path, about: Mapping[str, Any], writers: Mapping[str, Writer]) -> None:
    for name, write in writers.items():
        write(folder / name)
    manifest = {**about, "sha256": {name: _sha256(folder / name) for name in writers}}
    write_manifest(folder, manifest)
    for path in (*(folder / name for name in writers), folder / MANIFEST, folder):
        _sync(path)


def _seal(manifest: Mapping[str, Any]) -> str:
    content = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_marked_best(path: Path) -> bool:
    try:
        return bool(manifest_of(path).get("best"))
    except _UNREADABLE:
        return False


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sha256_once(path: Path) -> str:
    """As _sha256, without reading again a file that looks as it did: forgetting would hash every checkpoint kept."""
    status = path.stat()
    return _known_sha256(path, status.st_ino, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=64)
def _known_sha256(path: Path, *looks: int) -> str:
    return _sha256(path)
