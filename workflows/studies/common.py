"""What studies of trained weights (robustness, generalisation) share: whose weights, where results go, what is kept.

Results are files in one folder; a record beside them lets ``dsffnet sync FOLDER`` send them to MLflow.
"""

import argparse
import json
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datagen.common.errors import RecipeError, UnsafeFileError
from datagen.common.files import read_within, write_atomically
from datagen.common.printable import printable
from training.evaluation.evaluate import fingerprint_of
from training.evaluation.measure import LoadedMethod, load_methods
from training.tracking.record import read_record, update_record
from workflows.pipeline.ray_cluster import require_reachable
from workflows.pipeline.stage import recorded
from workflows.pipeline.weights_argument import Evaluated, evaluated

_SETTINGS = "settings.json"


def weights_of(options: argparse.Namespace) -> list[Evaluated]:
    """The weights that a person named.

    Raises
    ------
    CheckpointError
        A place has none, or they are damaged.
    """
    places = [Path(require_reachable(run, option="RUN")) for run in options.runs]
    return [evaluated(place, options.checkpoint) for place in places]


def methods_of(weights: Sequence[Evaluated]) -> list[LoadedMethod]:
    """Their networks, named after their networks and, where that is not unique, their folders."""
    return load_methods([its.weights for its in weights], labels=[_shown(its) for its in weights])


def _shown(weights: Evaluated) -> str:
    """What a person calls weights: their run's folder (a workflow's where the run is its ``run``), and their label."""
    home = weights.home.resolve()
    name = home.parent.name if home.name == "run" else home.name
    return printable(" ".join(filter(None, (name, weights.label))))


def folder_of(options: argparse.Namespace, weights: Sequence[Evaluated], study: str) -> Path:
    """Where results go: as asked; below the evaluations of the one run; or runs/STUDY.

    Raises
    ------
    RecipeError
        The folder that was asked for holds another run's record, or rows of something else.
    """
    if options.out:
        folder = Path(require_reachable(options.out, option="--out"))
        _require_own(folder, study)
        return folder
    if len(weights) > 1:
        return Path("runs") / study
    name = "-".join(filter(None, ("evaluation", weights[0].label)))
    return weights[0].home / name / study


def _require_own(folder: Path, study: str) -> None:
    """Refuse a folder whose record or rows a study would replace by its own."""
    record = read_record(folder)
    if (record and record.name != study) or ((folder / "rows.csv").exists() and not (folder / _SETTINGS).exists()):
        what = f"the record of {record.kind} {record.name!r}" if record else "rows of another study"
        raise RecipeError(f"--out {folder} holds {what}, which this would replace. Choose a folder of its own")


def parent_of(weights: Sequence[Evaluated]) -> Path | None:
    """The recorded run that a study belongs to, where it is of one run."""
    home = weights[0].home
    return home if len(weights) == 1 and read_record(home) else None


def about_weights(weights: Sequence[Evaluated]) -> list[str]:
    """What tells these weights from all others, wherever they lie, as plain data."""
    return [f"step {its.checkpoint.step} {fingerprint_of(its.checkpoint)}" for its in weights]


def sync_words(folder: Path) -> str:
    """The command that sends a study to MLflow."""
    return f"dsffnet sync {shlex.quote(str(folder))}"


def same_settings(folder: Path, settings: dict[str, Any]) -> bool:
    """Whether a folder's rows were measured with these settings; from now on the folder's rows are."""
    text = json.dumps(settings, indent=1, sort_keys=True).encode()
    try:
        same = read_within(folder, _SETTINGS) == text
    except (FileNotFoundError, UnsafeFileError):
        same = False
    if not same:
        (folder / "rows.csv").unlink(missing_ok=True)
        write_atomically(folder / _SETTINGS, text)
    return same


@contextmanager
def study(
    folder: Path, name: str, weights: Sequence[Evaluated], settings: dict[str, Any], artifacts: Sequence[str]
) -> Iterator[dict[str, float]]:
    """Record a study while the block runs; the block fills the dictionary with the metrics to show."""
    metrics: dict[str, float] = {}
    with recorded(folder, kind="evaluate", name=name, parent=parent_of(weights), parameters=settings):
        yield metrics
        update_record(folder, artifacts=[its for its in artifacts if (folder / its).exists()], metrics=metrics)
