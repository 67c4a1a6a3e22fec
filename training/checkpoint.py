"""Checkpoints: atomic, hashed, the newest few kept. Rank 0 alone writes; every rank reads.

RUN/checkpoints/step-N/ holds weights.safetensors, state.pt (optimiser and schedule) and manifest.json: step, recipe,
dataset, and the sha256 of the two files. A checkpoint is written to a temporary folder and renamed; RUN/latest is
moved last. Weights without state.pt (an exported model) load just as well, only they cannot be trained on.
"""

import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from datagen.errors import DsffnetError, StorageError
from datagen.mesh import write_atomically

log = logging.getLogger(__name__)

_WEIGHTS, _STATE, _MANIFEST = "weights.safetensors", "state.pt", "manifest.json"


class CheckpointError(DsffnetError):
    """A run without a usable checkpoint, or one that does not belong to what is asked."""


@dataclass(frozen=True)
class Checkpoint:
    """One sound checkpoint: its folder, the step, and the recipe and the dataset's uuid that it was trained with."""

    path: Path
    step: int
    recipe: dict[str, Any]
    dataset: str

    def weights(self) -> dict[str, Tensor]:
        """Weights by parameter name, on the CPU."""
        return load_file(self.path / _WEIGHTS)

    def state(self) -> dict[str, Any]:
        """State of the optimiser and the schedule."""
        return dict(torch.load(self.path / _STATE, map_location="cpu", weights_only=True))


def save_checkpoint(
    run: Path, *, about: dict[str, Any], weights: dict[str, Tensor], state: dict[str, Any], keep: int
) -> Path:
    """Write RUN/checkpoints/step-N and forget all but the newest ``keep``.

    ``about`` holds step, recipe and dataset, see :class:`Checkpoint`.

    Raises
    ------
    StorageError
        It could not be written; earlier checkpoints are untouched.
    """
    folder = run / "checkpoints"
    final = folder / f"step-{about['step']:08d}"
    if final.exists() and _fault(final) is None:
        return final  # training is deterministic: this step's checkpoint is there
    try:
        folder.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=folder, prefix=".partial-"))
        try:
            _write(temporary, about, weights, state)
            shutil.rmtree(final, ignore_errors=True)  # a damaged one
            os.replace(temporary, final)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    except (OSError, SafetensorError, RuntimeError) as error:  # a full disk: safetensors and torch say it their own way
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise StorageError(f"could not write checkpoint {final}: {reason}. Earlier checkpoints are kept") from error
    write_atomically(run / "latest", f"{final.name}\n".encode())
    _forget_old(folder, keep)
    return final


def load_checkpoint(run: Path) -> Checkpoint | None:
    """The newest sound checkpoint of a run (or the one that ``run`` itself is), None where there is none.

    A damaged one is passed over with a warning that names it, and the one before it is taken.
    """
    here = [run] if (run / _MANIFEST).exists() else []
    for path in (*here, *_newest_first(run / "checkpoints")):
        fault = _fault(path)
        if fault is None:
            return read_checkpoint(path)
        log.warning("checkpoint %s is damaged (%s); falling back to the one before it", path, fault)
    return None


def require_checkpoint(run: Path) -> Checkpoint:
    """The newest sound checkpoint of a run.

    Raises
    ------
    CheckpointError
        There is none.
    """
    found = load_checkpoint(run) or load_checkpoint(run / "run")  # a workflow's folder holds its run under this name
    if found is None:
        raise CheckpointError(f"{run} has no usable checkpoint. Name the folder of a training that has written one")
    return found


def export_weights(checkpoint: Checkpoint, folder: Path) -> None:
    """Copy a checkpoint's weights and manifest, without the optimiser's state."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy2(checkpoint.path / _WEIGHTS, folder / _WEIGHTS)
    manifest = json.loads((checkpoint.path / _MANIFEST).read_text())
    del manifest["sha256"][_STATE]
    (folder / _MANIFEST).write_text(json.dumps(manifest, indent=1))


def _write(folder: Path, about: dict[str, Any], weights: dict[str, Tensor], state: dict[str, Any]) -> None:
    save_file({name: value.contiguous() for name, value in weights.items()}, folder / _WEIGHTS)
    torch.save(state, folder / _STATE)
    hashes = {name: _sha256(folder / name) for name in (_WEIGHTS, _STATE)}
    (folder / _MANIFEST).write_text(json.dumps({**about, "sha256": hashes}, indent=1))
    for name in (_WEIGHTS, _STATE, _MANIFEST):
        with open(folder / name, "rb") as file:
            os.fsync(file.fileno())


def read_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in a folder that is known to be sound."""
    manifest = json.loads((path / _MANIFEST).read_text())
    return Checkpoint(path, manifest["step"], manifest["recipe"], manifest["dataset"])


def _fault(path: Path) -> str | None:
    try:
        manifest = json.loads((path / _MANIFEST).read_text())
        for name, digest in manifest["sha256"].items():
            if _sha256(path / name) != digest:
                return f"sha256 of {name} differs from its manifest"
    except (OSError, ValueError, KeyError) as error:
        return f"{type(error).__name__}: {error}"
    return None


def _newest_first(folder: Path) -> Iterator[Path]:
    yield from sorted(folder.glob("step-*"), reverse=True)


def _forget_old(folder: Path, keep: int) -> None:
    sound = [path for path in _newest_first(folder) if _fault(path) is None]
    for path in set(_newest_first(folder)) - set(sound[:keep]):
        shutil.rmtree(path, ignore_errors=True)
    for path in folder.glob(".partial-*"):
        shutil.rmtree(path, ignore_errors=True)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
