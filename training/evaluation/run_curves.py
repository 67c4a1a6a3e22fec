"""How a run learned: a metric of its journal over steps and over seconds of training."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from datagen.common.arrays import Floats


@dataclass(frozen=True)
class RunCurve:
    """A run's metric at each of its evaluations.

    Parameters
    ----------
    name : str
        What to call the run.
    steps, seconds : float arrays [n]
        Steps, and seconds of training until then (evaluations included, pauses between commands not).
    pmd : float array [n]
        Point-wise mesh distance in normalised coordinates (:func:`training.objectives.metrics.point_mesh_distance`),
        not yet in units of 1e-4.
    finished : bool
        Whether it came to its end; one that did not is never the best.
    """

    name: str
    steps: Floats
    seconds: Floats
    pmd: Floats
    finished: bool = True

    def __len__(self) -> int:
        return len(self.pmd)

    @property
    def final(self) -> float:
        """The last measured value, infinity where none was."""
        return float(self.pmd[-1]) if len(self) else float("inf")

    @property
    def drawable(self) -> "RunCurve":
        """What a logarithmic scale can show of it: finite, positive values."""
        shown = np.isfinite(self.pmd) & (self.pmd > 0)
        return replace(self, steps=self.steps[shown], seconds=self.seconds[shown], pmd=self.pmd[shown])

    def first_reached(self, level: float) -> tuple[float, float] | None:
        """Step and seconds of the first evaluation at or below ``level``, None where there was none."""
        places = np.flatnonzero(self.pmd <= level)
        return (float(self.steps[places[0]]), float(self.seconds[places[0]])) if len(places) else None


def run_curve(
    rows: Sequence[Mapping[str, float]], key: str, *, batch: int, name: str = "", finished: bool = True
) -> RunCurve:
    """One metric of a journal over steps and seconds.

    Seconds are counted by the journal's own throughput, ``batch * steps / meshes_per_second`` of each line, so that
    time between two commands of a resumed run does not count.

    Parameters
    ----------
    rows : lines of a journal
    key : metric, for example ``evaluation/pmd_unseen``; lines without it, or where it is not finite, give no point
    batch : triples in a step
    name, finished : see :class:`RunCurve`
    """
    before = np.array([0, *(row["step"] for row in rows)], float)
    rates = np.array([row.get("meshes_per_second", np.nan) for row in rows], float)
    clock = np.nancumsum(np.diff(before) * batch / rates)
    measured = [place for place, row in enumerate(rows) if np.isfinite(row.get(key, np.nan))]
    values = np.array([rows[place][key] for place in measured], float)
    return RunCurve(name, before[1:][measured], clock[measured], values, finished)
