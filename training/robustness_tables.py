"""Curves and tables of a study of robustness: what its rows say."""

from collections.abc import Sequence
from dataclasses import dataclass

from training.disturbances import DISTURBANCES
from training.robustness import NO_OP, RobustnessRow, methods_in
from training.scores import mean_and_interval
from training.tables import markdown


@dataclass(frozen=True)
class Level:
    """Mean of a metric over the triples at one amount, and half the width of its 95 % interval."""

    amount: float
    mean: float
    interval: float


def curve(rows: Sequence[RobustnessRow], method: str, disturbance: str, field: str = "pmd") -> list[Level]:
    """The metric at every amount of a disturbance that rows have of a method, ascending."""
    found: dict[float, list[float]] = {}
    for row in rows:
        if (row.method, row.disturbance) == (method, disturbance):
            found.setdefault(row.amount, []).append(getattr(row, field))
    return [Level(amount, *mean_and_interval(found[amount])) for amount in sorted(found)]


def no_op(rows: Sequence[RobustnessRow], field: str = "pmd") -> float:
    """What returning the target unchanged scores."""
    return mean_and_interval([getattr(row, field) for row in rows if row.method == NO_OP])[0]


def doubled(levels: Sequence[Level]) -> float | None:
    """The first measured amount at which the mean is twice that of amount 0; None where none is."""
    return next((level.amount for level in levels if level.mean >= 2 * levels[0].mean), None)


def limits_table(rows: Sequence[RobustnessRow]) -> str:
    """Markdown: for each disturbance the amount at which each method's PMD has doubled, and the PMD at the most."""
    names = methods_in(rows)
    heads = [head for name in names for head in (f"{name}: doubled at", "PMD at the most")]
    lines = [["disturbance", "amount (unit)", *heads]]
    for disturbance in DISTURBANCES:
        curves = [curve(rows, name, disturbance.name) for name in names]
        if any(curves):
            span = f"{disturbance.amounts[0]:g} to {disturbance.amounts[-1]:g} ({disturbance.unit})"
            lines.append([disturbance.heading, span, *(cell for levels in curves for cell in _limit(levels))])
    return markdown(lines)


def _limit(levels: Sequence[Level]) -> tuple[str, str]:
    if not levels:
        return "not taken", ""
    amount = doubled(levels)
    return "never" if amount is None else f"{amount:g}", f"{levels[-1].mean * 1e4:.2f}"


def amounts_table(rows: Sequence[RobustnessRow]) -> str:
    """Markdown: PMD (1e-4) and millimetres of every method at every amount of every disturbance."""
    names = methods_in(rows)
    lines = [["disturbance", "amount", *(head for name in names for head in (f"{name} PMD x1e-4", "+- 95 %", "mm"))]]
    for disturbance in DISTURBANCES:
        pmd = {name: curve(rows, name, disturbance.name) for name in names}
        metres = {name: curve(rows, name, disturbance.name, "millimetres") for name in names}
        amounts = sorted({level.amount for levels in pmd.values() for level in levels})
        for amount in amounts:
            cells = [cell for name in names for cell in _cells(pmd[name], metres[name], amount)]
            lines.append([disturbance.heading, f"{amount:g}", *cells])
    return markdown(lines)


def _cells(pmd: Sequence[Level], millimetres: Sequence[Level], amount: float) -> tuple[str, str, str]:
    for level, distance in zip(pmd, millimetres, strict=True):
        if level.amount == amount:
            return f"{level.mean * 1e4:.2f}", f"{level.interval * 1e4:.2f}", f"{distance.mean:.1f}"
    return "", "", ""
