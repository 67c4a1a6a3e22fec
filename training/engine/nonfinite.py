"""What is said, and kept in RUN/not-finite.json, when a loss or a gradient was not finite."""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from datagen.common.errors import StorageError, TrainingError
from datagen.common.files import write_atomically
from training.checkpoints.folder import newest_first
from training.engine.distributed import Ranks, gathered

log = logging.getLogger(__name__)
NOT_FINITE = "not-finite.json"
RecentStep = tuple[int, Any, Any]
"""A step, its parts of examples, its loss."""


@dataclass(frozen=True)
class Broken:
    """What a rank knows of its first step that was not finite: 0 if it had none, and then no examples.

    ``examples``: their numbers, a row each; of transfer (source identity, source pose, target identity, target pose),
    of an avatar (outfit, frame).
    """

    rank: int
    step: int
    what: Literal["loss", "gradient"]
    examples: list[list[int]]


def broken_step(bad_step: int, recent: Sequence[RecentStep], rank: int) -> Broken:
    """What was wrong at a step, of the latest ones."""
    for step, parts, loss in recent:
        if step == bad_step:
            finite = bool(torch.isfinite(torch.as_tensor(loss)))
            return Broken(rank, step, "gradient" if finite else "loss", np.concatenate(parts).tolist())
    return Broken(rank, bad_step, "gradient", [])


def stop_for(mine: Broken, run: Path, ranks: Ranks) -> None:
    """Tell what broke; all ranks must call this together, and all raise.

    The gradient is a mean over ranks: where one rank's loss broke it, that rank alone is named, else all.

    Raises
    ------
    TrainingError
        Always; ``secondary`` on ranks that another one tells for.
    """
    everyone = [each for each in gathered(mine, ranks) if each.step]
    step = min(each.step for each in everyone)
    at_fault = [each for each in everyone if each.step == step]
    culprits = [each for each in at_fault if each.what == "loss"] or at_fault
    kept = _written(run, step, culprits) if ranks.rank == 0 else f" (see {run / NOT_FINITE})"
    here = mine in culprits
    where = f"this rank's examples were {mine.examples}" if here else "on another rank"
    earlier = "The last good checkpoint is kept" if any(newest_first(run)) else "There is no checkpoint yet"
    if culprits[0].what == "gradient":
        where = f"in the gradient only; {where}"
    raise TrainingError(
        f"loss or gradient is not finite at step {step} ({where}). Nothing was learned from it{kept}. "
        f"{earlier}; lower training.learning_rate or set training.gradient_clip",
        secondary=mine.rank != culprits[0].rank,
    )


def _written(run: Path, step: int, culprits: list[Broken]) -> str:
    """Write RUN/not-finite.json; where that fails too, it is a warning beside the error."""
    about = {"step": step, "what": culprits[0].what, "ranks": [asdict(each) for each in culprits]}
    try:
        write_atomically(run / NOT_FINITE, json.dumps(about, indent=1).encode())
    except StorageError as error:
        log.warning("%s", error)
        return ""
    return f" (see {run / NOT_FINITE})"
