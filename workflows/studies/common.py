"""What studies of trained weights (robustness, generalisation) share: whose weights, where results go, what is kept.

Results are files in one folder; a record beside them lets ``dsffnet sync FOLDER`` send them to MLflow.
"""

import argparse
import json
import shlex
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Generic

from datagen.common.errors import RecipeError, UnsafeFileError
from datagen.common.files import read_within, write_atomically
from datagen.common.printable import printable
from training.evaluation.evaluate import fingerprint_of
from training.evaluation.measure import LoadedMethod, load_methods
from training.evaluation.results import RowType, kept_rows, write_csv
from training.tracking.record import read_record, update_record
from workflows.pipeline.console import print_text
from workflows.pipeline.ray_cluster import require_reachable
from workflows.pipeline.run_folder import EvaluationFolder, require_place
from workflows.pipeline.stage import recorded
from workflows.pipeline.weights_argument import Evaluated, evaluated

_SETTINGS = "settings.json"
_MEASURED_AS = 2
"""Raise this when meshes are read, or measured, otherwise, so that rows of an earlier version are measured again."""
_SAVE_EVERY = 5.0  # seconds


def weights_of(options: argparse.Namespace) -> list[Evaluated]:
    """The weights that a person named.

    Raises
    ------
    CheckpointError
        A place has none, or they are damaged.
    RecipeError
        Some are named twice.
    """
    places = [Path(require_reachable(run, option="RUN")) for run in options.runs]
    found = [evaluated(place, options.checkpoint) for place in places]
    known = [each.weights.resolve() for each in found]
    twice = [str(place) for place, its in zip(places, known, strict=True) if known.count(its) > 1]
    if twice:
        raise RecipeError(f"{' and '.join(twice)} are the same weights. Name each once")
    return found


def methods_of(weights: Sequence[Evaluated]) -> list[LoadedMethod]:
    """Their networks, named after their networks and, where that is not unique, their folders."""
    return load_methods([each.weights for each in weights], labels=[_shown(each) for each in weights])


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
        The folder that was asked for is a dataset, or holds another run's record or rows of something else.
    """
    if options.out:
        folder = Path(require_reachable(options.out, option="--out"))
        require_place(folder)
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
    return [f"step {each.checkpoint.step} {fingerprint_of(each.checkpoint)}" for each in weights]


def keep_rows_if(folder: Path, settings: dict[str, Any]) -> None:
    """Remove a folder's rows unless they were measured with these settings; from now on the folder's rows are."""
    text = json.dumps({"measured_as": _MEASURED_AS, **settings}, indent=1, sort_keys=True).encode()
    try:
        same = read_within(folder, _SETTINGS) == text
    except (FileNotFoundError, UnsafeFileError):
        same = False
    if not same:
        (folder / "rows.csv").unlink(missing_ok=True)
        write_atomically(folder / _SETTINGS, text)


class Study(ABC, Generic[RowType]):
    """A study, planned: what is measured on which weights, and what is made of the rows.

    Attributes
    ----------
    name
        Of its record, and of its text (NAME.md).
    row
        The dataclass of its rows.
    pictures
        Files that :meth:`draw` leaves.
    folder, weights
        Where results go, and of which weights they are.
    settings
        What rows depend on, as plain data: rows of other settings are measured again.
    """

    name: str
    row: type[RowType]
    pictures: tuple[str, ...]
    folder: Path
    weights: Sequence[Evaluated]
    settings: dict[str, Any]

    def prepare(self) -> None:
        """Make what is measured, in the folder, which nobody else writes to meanwhile; `settings` may wait for it."""

    @abstractmethod
    def measure(self, done: list[RowType]) -> Iterable[list[RowType]]:
        """Rows that ``done`` lacks, in batches, with a bar."""

    @abstractmethod
    def draw(self, rows: list[RowType]) -> None:
        """Draw the pictures into the folder."""

    @abstractmethod
    def report(self, rows: list[RowType]) -> str:
        """The study as Markdown."""

    @abstractmethod
    def metrics(self, rows: list[RowType]) -> dict[str, float]:
        """What MLflow shows."""

    @property
    def files(self) -> tuple[str, ...]:
        """What the study leaves in its folder."""
        return (f"{self.name}.md", "rows.csv", *self.pictures)


def run_study(study: Study[RowType]) -> None:
    """Measure what is missing, draw, write and print the report, and record it for MLflow."""
    folder, parent = study.folder, parent_of(study.weights)
    with EvaluationFolder(folder).alone():
        study.prepare()
        with recorded(folder, kind="evaluate", name=study.name, parent=parent, parameters=study.settings):
            rows = _measured(study)
            study.draw(rows)
            text = study.report(rows)
            write_atomically(folder / f"{study.name}.md", text.encode())
            artifacts = [name for name in study.files if (folder / name).exists()]
            update_record(folder, artifacts=artifacts, metrics=study.metrics(rows))
    sync = f"dsffnet sync {shlex.quote(str(folder))}"
    print_text(f"{text}\npictures, rows, this text: {folder} ({', '.join(study.files)}). To MLflow: {sync}")


def _measured(study: Study[RowType]) -> list[RowType]:
    """All rows of the folder: those that were there with these settings, and what is missing."""
    path = study.folder / "rows.csv"
    keep_rows_if(study.folder, study.settings)
    rows, saved = kept_rows(path, study.row), time.monotonic()
    for some in study.measure(list(rows)):
        rows += some
        if time.monotonic() > saved + _SAVE_EVERY:  # a run that is stopped resumes from here
            write_csv(rows, path, study.row)
            saved = time.monotonic()
    write_csv(rows, path, study.row)
    return rows


def metric_name(method: str) -> str:
    """A method's name as part of the name of a metric in MLflow."""
    return method.replace(" ", "_").translate(str.maketrans("", "", "()"))
