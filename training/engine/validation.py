"""What rank 0 observes of a training: its PMD on a fixed subset, the best so far, the journal, pictures, its pace."""

import json
import logging
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from datagen.common.arrays import Integers
from datagen.common.errors import DatasetError
from datagen.common.files import write_atomically
from datagen.store import Dataset
from training.data.batch import Batch, read_batch
from training.data.triples import Triples
from training.engine.snapshots import draw_snapshot, snapshot_path
from training.engine.state import Job, State
from training.engine.train_step import Learner
from training.inference.predict import predict
from training.objectives.metrics import point_mesh_distance
from training.recipes.training import PartsRecipe, TrainingRecipe
from training.tracking.journal import Journal, coefficient_metrics
from training.tracking.progress import Progress
from training.tracking.system_metrics import sampling

log = logging.getLogger(__name__)
_REPORT_SECONDS = 20.0
"""Between lines of the log."""


class Validation:
    """Metrics and pictures of fixed triples of a dataset's evaluation lists, so that curves of a run are comparable.

    PMD is :func:`training.objectives.metrics.point_mesh_distance`, the mean over ``recipe.evaluate_triples`` of each
    pose type;
    ``evaluation/pmd_unseen`` decides which checkpoint is best (``pmd_seen`` where no unseen poses are listed).
    """

    def __init__(self, dataset: Dataset, recipe: TrainingRecipe, device: torch.device, dtype: torch.dtype) -> None:
        self._batches: dict[str, Batch] = {}
        self._faces: Integers | None = None
        for pose_type in ("seen", "unseen"):
            triples = dataset.evaluation_triples(pose_type)[: recipe.evaluate_triples]
            if len(triples):
                batch = read_batch(dataset, triples, padded=True, surfaces=isinstance(recipe.network, PartsRecipe))
                self._batches[pose_type] = batch.in_dtype(dtype).to(device)
                self._faces = _common_faces(dataset, triples)
        if recipe.picture_every and self._faces is None:
            log.info("no pictures while training: the evaluation triples are none, or of several topologies")

    def measure(self, network: nn.Module) -> dict[str, float]:
        """``evaluation/pmd_seen``, ``evaluation/pmd_unseen`` and, where there are, the adaptive coefficients."""
        found = {}
        with _evaluating(network):
            for pose_type, batch in self._batches.items():
                prediction = predict(network, batch)
                found[f"evaluation/pmd_{pose_type}"] = float(_pmd(prediction, batch).mean())
        return found | coefficient_metrics(network)

    def decisive(self, metrics: dict[str, float]) -> float:
        """The PMD that decides which weights are best."""
        return metrics.get("evaluation/pmd_unseen", metrics.get("evaluation/pmd_seen", float("inf")))

    def draw(self, network: nn.Module, path: Path, *, title: str) -> None:
        """A picture of a few fixed transfers, of unseen poses where there are; bodies of one topology only."""
        if self._faces is not None:
            draw_snapshot(network, list(self._batches.values())[-1], self._faces, path, title)


def require_measurable(dataset: Dataset, recipe: TrainingRecipe) -> None:
    """Refuse early stopping where there is nothing to go by.

    Raises
    ------
    DatasetError
        The dataset lists no evaluation triples.
    """
    if recipe.early_stopping and not any(len(dataset.evaluation_triples(kind)) for kind in ("seen", "unseen")):
        raise DatasetError(
            f"training.early_stopping is {recipe.early_stopping}, but {dataset.url} lists no evaluation triples to go "
            "by. Use --set training.early_stopping=null, or a dataset with evaluation identities"
        )


def _common_faces(dataset: Dataset, triples: Triples) -> Integers | None:
    """Faces [f, 3] of all meshes of some triples; None where they differ."""
    first, *others = (dataset.faces(identity) for identity in sorted({*triples[:, [0, 2]].flatten().tolist()}))
    return first if all(np.array_equal(first, other) for other in others) else None


def _pmd(prediction: Tensor, batch: Batch) -> Tensor:
    """PMD of each mesh [b], over its own vertices."""
    if batch.target_counts is None:
        return point_mesh_distance(prediction, batch.truth)
    meshes = zip(prediction, batch.truth, batch.target_counts, strict=True)
    return torch.cat([point_mesh_distance(found[None, :n], truth[None, :n]) for found, truth, n in meshes])


@contextmanager
def _evaluating(network: nn.Module) -> Iterator[None]:
    """The network in evaluation mode, without gradients."""
    network.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        network.train()


class Meter:
    """Counts steps since the last reading.

    Parameters
    ----------
    batch
        Triples in a step, over all ranks.
    """

    def __init__(self, batch: int) -> None:
        self._batch = batch
        self._reset()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Around whatever brings the next batch."""
        began = time.perf_counter()
        yield
        self._waited += time.perf_counter() - began
        self._steps += 1

    def read(self) -> dict[str, float]:
        """Return ``meshes_per_second`` and ``input_wait`` (a share of the time) since the last reading."""
        seconds = time.perf_counter() - self._began
        values = {"meshes_per_second": self._steps * self._batch / seconds, "input_wait": self._waited / seconds}
        self._reset()
        return values

    def _reset(self) -> None:
        self._began, self._waited, self._steps = time.perf_counter(), 0.0, 0


@dataclass
class Observer:
    """What rank 0 alone measures with and writes to."""

    validation: Validation
    journal: Journal
    progress: Progress
    meter: Meter
    last_step: int
    reported: float = field(default_factory=time.monotonic)

    def log(self, state: State, values: dict[str, float], *, validate: bool) -> float | None:
        """Write a line of the journal; return the PMD that decides which weights are best, where it was measured."""
        measured: dict[str, float] = {}
        if validate:
            with state.learner.evaluated():
                measured = self.validation.measure(state.learner.network)
        row = values | measured
        self.journal.write(state.step, row | self.meter.read())
        self._report({"step": state.step, "time": time.time(), **row})
        return self.validation.decisive(measured) if validate else None

    def draw(self, state: State, run: Path) -> None:
        """Draw a picture of fixed transfers; one that cannot be drawn or written ends no training."""
        path, title = snapshot_path(run, state.step), f"step {state.step:,}"
        try:
            with state.learner.evaluated():
                self.validation.draw(state.learner.network, path, title=title)
        except Exception as error:
            log.warning("no picture of step %s: %s: %s", state.step, type(error).__name__, error)

    def _report(self, row: dict[str, Any]) -> None:
        """For launchers that show nothing themselves; at intervals, and at the end."""
        self.progress.add(row)
        if time.monotonic() - self.reported > _REPORT_SECONDS or row["step"] == self.last_step:
            log.info("%s", self.progress.line())
            self.reported = time.monotonic()


@contextmanager
def observing(job: Job, learner: Learner, meter: Meter, where: str) -> Iterator[Observer]:
    """Observe a training while the block runs; ``where`` its meshes are kept is noted in RUN/input.json."""
    log.info("training meshes are kept in %s", where)
    write_atomically(job.run / "input.json", json.dumps({"where": where}).encode())
    validation = Validation(job.dataset, job.recipe, learner.device, learner.dtype)
    progress = Progress(steps=job.last_step, steps_per_epoch=job.order.steps_per_epoch)
    with closing(Journal(job.run / "metrics.jsonl")) as journal, sampling(job.run / "system.jsonl"):
        yield Observer(validation, journal, progress, meter, job.last_step)
