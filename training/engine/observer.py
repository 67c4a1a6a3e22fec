"""What rank 0 observes of a training: its measures on fixed examples, the journal, pictures, its pace."""

import json
import logging
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from datagen.common.files import write_atomically
from training.engine.state import Job, State
from training.engine.tasks.protocol import Validation
from training.engine.train_step import Learner
from training.tracking.journal import Journal
from training.tracking.progress import Progress
from training.tracking.system_metrics import sampling

log = logging.getLogger(__name__)
_REPORT_SECONDS = 20.0
"""Between lines of the log."""


class Meter:
    """Counts steps since the last reading.

    Parameters
    ----------
    batch
        Examples in a step, over all ranks.
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
        """Write a line of the journal; return what decides which weights are best, where it was measured."""
        measured: dict[str, float] = {}
        if validate:
            with state.learner.evaluated():
                measured = self.validation.measure(state.learner.network)
        row = values | measured
        self.journal.write(state.step, row | self.meter.read())
        self._report({"step": state.step, "time": time.time(), **row})
        return self.validation.decisive(measured) if validate else None

    def draw(self, state: State, run: Path) -> None:
        """Draw a picture of fixed examples; one that cannot be drawn or written ends no training."""
        path, title = run / "pictures" / f"step-{state.step:08d}.png", f"step {state.step:,}"
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
    log.info("training data are kept in %s", where)
    write_atomically(job.run / "input.json", json.dumps({"where": where}).encode())
    validation = job.task.validation(learner.device, learner.dtype)
    progress = Progress(steps=job.last_step, steps_per_epoch=job.order.steps_per_epoch)
    with closing(Journal(job.run / "metrics.jsonl")) as journal, sampling(job.run / "system.jsonl"):
        yield Observer(validation, journal, progress, meter, job.last_step)
