"""Checkpoints: atomic, hashed, the newest few and the best kept. Rank 0 alone writes; every rank reads.

RUN/checkpoints/step-N/ holds weights.safetensors, average.safetensors where a moving average of the weights is kept,
state.pt (optimiser, schedule, counters, random states) and manifest.json: step, recipe, dataset, versions, whether it
was the best so far, and the sha256 of the other files. A checkpoint is written to a temporary folder, synced to the
disk and renamed, which is the one moment that counts; then RUN/best and, last, RUN/latest are moved.
Weights without state.pt (an exported model) load just as well, only they cannot be trained on.
"""

import logging
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import ValidationError
from torch import Tensor

from datagen.common.errors import CheckpointError, DamagedFileError
from datagen.common.files import resolve_within, warn_once, write_atomically
from training.checkpoints.folder import (
    AVERAGE,
    BEST,
    LATEST,
    MANIFEST,
    STATE,
    WEIGHTS,
    Writer,
    best_of,
    commit,
    commit_into,
    fault_of,
    forget_old,
    is_listed,
    manifest_of,
    newest_first,
    step_folder,
    weights_writer,
    write_manifest,
)
from training.checkpoints.state_file import read_state
from training.checkpoints.weights import About, cast_weights, read_header, read_weights
from training.recipes.training import TrainingRecipe

log = logging.getLogger(__name__)
Which = Literal["latest", "best", "result"] | int
"""The newest sound one; the best; that of a step; or a run's result: the newest, but where early stopping ended the
run, the best."""


@dataclass(frozen=True)
class Checkpoint:
    """One sound checkpoint: its folder (or file of weights), the step, and what it was trained by, on and with.

    ``dataset`` is the dataset's uuid, ``dataset_sha256`` the sha256 of its manifest ("" where it was not noted).
    ``finished``: training had come to its end there, by its steps or by early stopping. ``last_step``: the last that
    its recipe asked for, where noted. ``has_average``: it holds a moving average of the weights.
    """

    path: Path
    step: int = 0
    recipe: dict[str, Any] = field(default_factory=dict)
    dataset: str = ""
    dataset_sha256: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    best: bool = False
    finished: bool = False
    last_step: int | None = None
    has_average: bool = False

    def weights(self, *, average: bool = False) -> dict[str, Tensor]:
        """Weights by parameter name, on the CPU; ``average``: their moving average, if this training keeps one."""
        if self.path.is_file():
            return read_weights(self.path)
        return read_weights(resolve_within(self.path, AVERAGE if average and self.has_average else WEIGHTS))

    def state(self) -> dict[str, Any]:
        """State of the optimiser, the schedule and whatever else training resumes from.

        Raises
        ------
        CheckpointError
            These are weights only, or what is beside them is no state of a training.
        """
        if not (self.path / STATE).is_file():
            raise CheckpointError(f"{self.path} holds weights only, which training can start from but not resume from")
        return read_state(self.path, STATE)


def save_checkpoint(
    run: Path,
    *,
    about: Mapping[str, Any],
    weights: Mapping[str, Tensor],
    state: Mapping[str, Any],
    keep: int,
    best: bool = False,
    average: Mapping[str, Tensor] | None = None,
) -> Path:
    """Write RUN/checkpoints/step-N and forget all but the newest ``keep`` and the best.

    Parameters
    ----------
    about
        step, recipe and dataset (uuid), and dataset_sha256 where it is known; see :class:`Checkpoint`.
    weights, average
        Tensors by parameter name, and their moving average.
    state
        What ``torch.load(weights_only=True)`` reads: tensors, numbers, text, dictionaries, lists.
    best
        No earlier checkpoint of this run was as good.

    Raises
    ------
    StorageError
        It could not be written; earlier checkpoints are untouched.
    """
    final = step_folder(run, f"step-{about['step']:08d}")
    if fault_of(final) is not None:
        writers: dict[str, Writer] = {
            WEIGHTS: weights_writer(weights, about),
            STATE: lambda path: torch.save(dict(state), path),
        }
        if average is not None:
            writers[AVERAGE] = weights_writer(average, {**about, "average": True})
        commit(final, {**about, "versions": _versions(), "best": best}, writers)
    elif best:  # training is deterministic: this step's checkpoint is there, only perhaps not yet known as the best
        write_manifest(final, manifest_of(final) | {"best": True})
    if best:
        write_atomically(run / BEST, f"{final.name}\n".encode())
    write_atomically(run / LATEST, f"{final.name}\n".encode())
    forget_old(run, keep)
    return final


def load_checkpoint(run: Path, which: Which = "latest", *, weights_only: bool = False) -> Checkpoint | None:
    """Return a checkpoint of a run, see :data:`Which`; None where there is none.

    A damaged newest one is passed over with a warning that names it, and the one before it is taken. Where ``run`` is
    itself a checkpoint (a step's folder, exported weights, a .safetensors file), that one and no other is meant.
    ``weights_only``: for inference, which verifies the file that it loads and no other.

    Raises
    ------
    CheckpointError
        The one that was asked for, by its path, its step or as the best, is damaged; or there is no such step.
    """
    if _is_checkpoint(run):
        return _named(run, weights_only=weights_only)
    if which in ("latest", "result"):
        newest = _newest_sound(run, weights_only=weights_only)
        if which == "latest" or not _was_cut_short(newest):
            return newest
        return load_checkpoint(run, "best", weights_only=weights_only) or newest
    path = best_of(run) if which == "best" else step_folder(run, f"step-{which:08d}")
    if isinstance(which, int) and path and not path.exists():
        steps = sorted(int(each.name.removeprefix("step-")) for each in newest_first(run))
        another = f"Name another step: {', '.join(map(str, steps))}" if steps else "There is none yet"
        raise CheckpointError(f"checkpoint {path} is not there. {another}")
    return _named(path, weights_only=weights_only) if path else None


def require_checkpoint(run: Path, which: Which = "latest", *, weights_only: bool = False) -> Checkpoint:
    """As :func:`load_checkpoint`, for a run, a workflow's folder around it, or a checkpoint named by its path.

    Raises
    ------
    CheckpointError
        There is none, or the one that was asked for is damaged.
    """
    inner = run / "run"  # a workflow's folder holds its run under this name
    folder = inner if (inner / "checkpoints").exists() else run
    checkpoint = load_checkpoint(folder, which, weights_only=weights_only)
    if checkpoint is None and which == "best":
        raise CheckpointError(f"{run} has no best checkpoint: none was measured on unseen poses. Take the newest one")
    if checkpoint is None and (count := len(list(newest_first(folder)))):
        raise CheckpointError(
            f"{run} has no sound checkpoint: {count} of {count} are damaged. Copy one back, or repeat the command that "
            "trained it, which starts again from step 0"
        )
    if checkpoint is None:
        raise CheckpointError(f"{run} has no usable checkpoint. Name the folder of a training that has written one")
    return checkpoint


def read_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in a folder that is known to be sound.

    Raises
    ------
    CheckpointError
        It cannot be read from here.
    """
    try:
        return _checkpoint(path, manifest_of(path))
    except (OSError, DamagedFileError) as error:
        raise CheckpointError(f"checkpoint {path} cannot be read: {error}. --out must be on a shared disk") from error


def is_finished(checkpoint: Checkpoint, last_step: int) -> bool:
    """Whether training had come to its end there, or to a step."""
    return checkpoint.finished or checkpoint.step >= last_step


def export_weights(checkpoint: Checkpoint, folder: Path, *, dtype: torch.dtype | None = None) -> None:
    """Write a checkpoint's weights (their moving average, where it keeps one) and manifest, without training's state.

    ``dtype``, e.g. torch.bfloat16 or torch.float16, makes the file half as large; networks load it in float32. Of what
    the training began with (``start_from``) the name is kept, not where it lay on this machine.

    Raises
    ------
    CheckpointError
        A weight does not fit the range of ``dtype``.
    StorageError
        It could not be written.
    """
    weights = checkpoint.weights(average=True)
    if dtype is not None:
        weights = cast_weights(weights, dtype)
    about = {name: getattr(checkpoint, name) for name in ("step", "recipe", "dataset", "dataset_sha256")}
    if began := about["recipe"].get("start_from"):
        about["recipe"] = {**about["recipe"], "start_from": Path(began).name}
    commit_into(folder, {**about, "versions": _versions()}, {WEIGHTS: weights_writer(weights, about)})


def _was_cut_short(found: Checkpoint | None) -> bool:
    """Whether early stopping ended the run there."""
    return found is not None and found.finished and found.step < (found.last_step or 0)


def _versions() -> dict[str, str]:
    return {"python": platform.python_version(), "torch": str(torch.__version__), "numpy": np.__version__}


def _newest_sound(run: Path, *, weights_only: bool) -> Checkpoint | None:
    for path in newest_first(run):
        fault = fault_of(path, weights_only=weights_only)
        if fault is None:
            return read_checkpoint(path)
        warn_once(f"checkpoint {path} is damaged ({fault}) and passed over")
    return None


def _is_checkpoint(path: Path) -> bool:
    is_step = path.name.startswith("step-") and path.parent.name == "checkpoints"
    return is_step or path.suffix == ".safetensors" or any((path / name).exists() for name in (WEIGHTS, MANIFEST))


def _named(path: Path, *, weights_only: bool) -> Checkpoint:
    """The checkpoint that a person asked for by name: damage to it is an error."""
    is_file = path.suffix == ".safetensors"
    if is_file and not is_listed(path):
        return _checkpoint(path, read_header(path))
    folder = path.parent if is_file else path
    fault = fault_of(folder, only=path.name if is_file else None, weights_only=weights_only)
    if fault is not None:
        raise CheckpointError(f"checkpoint {path} is damaged or missing ({fault}). Name another, or the run's folder")
    return _checkpoint(path, manifest_of(folder))


def _checkpoint(path: Path, about: Mapping[str, Any]) -> Checkpoint:
    said = {name: about[name] for name in About.model_fields if name in about}
    return Checkpoint(path, has_average=AVERAGE in about.get("sha256", {}), **said)


def recipe_of(checkpoint: Checkpoint, *, network_only: bool = False) -> TrainingRecipe:
    """Return the recipe that a checkpoint was trained by.

    ``network_only``: where no more than the network is wanted, what this version does not know of the rest is left out.

    Raises
    ------
    CheckpointError
        It holds no recipe, or one that this version cannot read; the message names the field.
    """
    values = checkpoint.recipe
    if not values:
        raise CheckpointError(
            f"{checkpoint.path} holds weights without their recipe. Name a run, or weights exported from one"
        )
    try:
        return TrainingRecipe.model_validate(values)
    except ValidationError as error:
        if network_only and all(fault["loc"][:1] != ("network",) for fault in error.errors()):
            log.warning("%s was trained by a recipe that this version cannot read whole", checkpoint.path)
            return TrainingRecipe.model_validate({"network": values.get("network", {})})
        fault = error.errors()[0]
        place = ".".join(("training", *(str(part) for part in fault["loc"])))
        raise CheckpointError(
            f"{checkpoint.path} was trained by a recipe that this version cannot read ({place}: {fault['msg']}); "
            "it was written by another version. Train anew in another --out, or use the version that wrote it"
        ) from error
