"""How far a mean over triples can be trusted: bootstrap intervals of means, and of paired differences of methods."""

from collections.abc import Iterable, Sequence

import numpy as np

from datagen.grid import PoseType
from training.evaluation.results import Row

_DRAWS = 2000

BOOTSTRAP = f"bootstrap of {_DRAWS:,} draws over triples, which share a few identities: new bodies may vary more"
"""What stands beside an interval."""


def values_of(rows: Iterable[Row], *, method: str, pose_type: str, field: str) -> dict[int, float]:
    """Triple -> value of one method's metric."""
    return {row.triple: getattr(row, field) for row in rows if (row.method, row.pose_type) == (method, pose_type)}


def mean(values: Iterable[float]) -> float:
    """The mean; NaN of no values."""
    numbers = np.fromiter(values, np.float64)
    return float(numbers.mean()) if len(numbers) else float("nan")


def interval(values: Iterable[float]) -> tuple[float, float] | None:
    """The 95 % percentile-bootstrap interval of a mean, the same each time; None for fewer than two values."""
    numbers = np.fromiter(values, np.float64)
    if len(numbers) < 2:
        return None
    drawn = np.random.default_rng(0).integers(len(numbers), size=(_DRAWS, len(numbers)))
    low, high = np.quantile(numbers[drawn].mean(axis=1), [0.025, 0.975])
    return float(low), float(high)


def mean_and_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """The mean and the ends of :func:`interval`, which are the mean itself where there is none."""
    middle = mean(values)
    return middle, *(interval(values) or (middle, middle))


def differences(rows: Sequence[Row], *, method: str, reference: str, pose_type: str, field: str) -> list[float]:
    """The method's values minus the reference's, over the triples of both."""
    ours, theirs = (values_of(rows, method=name, pose_type=pose_type, field=field) for name in (method, reference))
    return [ours[triple] - theirs[triple] for triple in ours if triple in theirs]


def spread_over(rows: Iterable[Row]) -> PoseType:
    """The pose type whose spread is told: unseen where there are any."""
    return "unseen" if any(row.pose_type == "unseen" for row in rows) else "seen"
