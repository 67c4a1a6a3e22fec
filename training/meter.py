"""Throughput and the share of time spent waiting for input."""

import contextlib
import time
from collections.abc import Iterator


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

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Around whatever brings the next batch."""
        began = time.perf_counter()
        yield
        self._waited += time.perf_counter() - began
        self._steps += 1

    def read(self) -> dict[str, float]:
        """Return ``meshes_per_second`` and ``input_wait`` (a share of the time) since the last reading."""
        seconds = time.perf_counter() - self._began
        found = {"meshes_per_second": self._steps * self._batch / seconds, "input_wait": self._waited / seconds}
        self._reset()
        return found

    def _reset(self) -> None:
        self._began, self._waited, self._steps = time.perf_counter(), 0.0, 0
