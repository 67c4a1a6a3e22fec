"""Which weights a person means by a path, and where their evaluation goes."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.common.errors import CheckpointError
from datagen.common.files import resolve_within
from datagen.common.printable import nearest
from workflows.pretrained import own_names, own_weights, weights_named

if TYPE_CHECKING:  # torch takes seconds to import, and what is wrong with files is said before
    from datagen.store import Dataset
    from training.checkpoints.checkpoint import Checkpoint, Which

_WEIGHTS = ".safetensors"


@dataclass(frozen=True)
class Evaluated:
    """Weights to evaluate: their checkpoint, the folder that their evaluation goes into, and what it is called by.

    ``home`` is the run, or for exported weights their folder; ``label`` tells weights of one home apart ("": the
    result of a run, or those that were exported as weights.safetensors).
    """

    checkpoint: "Checkpoint"
    home: Path
    label: str

    @property
    def weights(self) -> Path:
        """The one checkpoint's folder or file, which stays the same while training continues."""
        return self.checkpoint.path

    def folder(self, dataset: "Dataset") -> Path:
        """HOME/evaluation[-DATASET][-LABEL]; DATASET where it is another than the weights were trained on."""
        own = self.checkpoint.dataset == dataset.uuid
        other = "" if own else Path(dataset.url).stem
        name = "-".join(filter(None, ("evaluation", other, self.label)))
        resolve_within(self.home, name)
        return self.home / name


def evaluated(place: Path, which: "Which" = "result") -> Evaluated:
    """The weights that a person names: a run, a workflow's folder, RUN/checkpoints/step-N, or exported weights.

    Raises
    ------
    CheckpointError
        There are none, or they are damaged.
    """
    from training.checkpoints.checkpoint import require_checkpoint

    if place.name in own_names() and not place.exists():
        raise CheckpointError(
            f"{place} is not there. Copy the weights of that name, which come along, as results are written beside "
            f"them: cp -r {shlex.quote(str(own_weights(place.name)))} {shlex.quote(str(place))}"
        )
    checkpoint, step = require_checkpoint(place, which, weights_only=True), _step_folder(place)
    if step is not None:
        return Evaluated(checkpoint, step.parent.parent, f"step-{checkpoint.step}")
    if checkpoint.path == place:  # exported weights
        is_file = place.suffix == _WEIGHTS
        label = place.stem if is_file and place.stem != "weights" else ""
        return Evaluated(checkpoint, place.parent if is_file else place, label)
    label = "" if which in ("result", "latest") else f"step-{checkpoint.step}"
    return Evaluated(checkpoint, checkpoint.path.parent.parent, label)


def weights_called(name: str, *, option: str) -> Path:
    """Where the weights are that an option names: a path that is there, or those of that name that come along.

    Raises
    ------
    CheckpointError
        There are none; what comes along is said.
    """
    place = weights_named(name)
    if not name or not place.exists():
        known = ", ".join(own_names())
        raise CheckpointError(
            f"{option} {name or repr(name)}: there is no such run or weights{nearest(name, own_names())}. Name one; "
            f"these come along: {known}"
        )
    return place


def projecting(name: str | None) -> Path | None:
    """The weights that ``--project`` names, None where it names none.

    Raises
    ------
    CheckpointError
        There are none, or they are damaged.
    """
    return None if name is None else evaluated(weights_called(name, option="--project")).weights


def _step_folder(place: Path) -> Path | None:
    """RUN/checkpoints/step-N, where ``place`` is it or a file in it."""
    folder = place.parent if place.suffix == _WEIGHTS else place
    return folder if folder.parent.name == "checkpoints" and folder.name.startswith("step-") else None
