"""How a trained network bears a disturbed source (paper, Figure 9): rows, curves and tables.

The source alone is disturbed, before its normalisation, as a person's mesh would be; target and ground truth stay as
they are. The no-op ``target unchanged`` says what doing nothing would score, whatever the source.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import DatasetError
from datagen.mesh.geometry import Mesh, bounding_box
from datagen.store import Dataset
from training.evaluation.disturbances import DISTURBANCES, Disturbance
from training.evaluation.document import Table
from training.evaluation.measure import NO_OPS, POSE_TYPES, LoadedMethod, score, transfer_each
from training.evaluation.results import Score, Triple
from training.evaluation.statistics import mean, mean_and_interval
from training.inference.mesh_reading import normalised
from training.objectives import PMD_UNIT

NO_OP = NO_OPS[0]


class _OfMethod(Protocol):
    @property
    def method(self) -> str: ...


@dataclass(frozen=True)
class Case:
    """One evaluation triple: meshes in metres, Y up; truth = the target's identity in the source's pose."""

    number: int
    triple: tuple[int, int, int, int]
    source: Mesh
    target: Mesh
    truth: Mesh

    @cached_property
    def half(self) -> float:
        """Metres that one unit of the truth's normalised box is."""
        return float(bounding_box(self.truth.vertices).half)

    def score(self, output: NDArray[np.floating], emd_points: int | None = None) -> Score:
        """Metrics of an output [v, 3] in the normalised box."""
        truth = normalised(self.truth.vertices)
        return score(output, truth, self.target.faces, half=self.half, emd_points=emd_points)


@dataclass(frozen=True)
class Disturbed:
    """Which method, and how its sources were disturbed."""

    method: str
    disturbance: str
    amount: float

    @property
    def key(self) -> tuple[str, str, float]:
        """What belongs together: method, disturbance, amount."""
        return self.method, self.disturbance, self.amount


@dataclass(frozen=True)
class SourceCount:
    """Vertices of the source."""

    source_vertices: int


@dataclass(frozen=True)
class RobustnessRow(Score, SourceCount, Triple, Disturbed):
    """One method on one triple whose source was disturbed."""


def cases_of(dataset: Dataset, count: int) -> list[Case]:
    """The first ``count`` of a dataset's fixed evaluation triples; see :func:`first_triples`."""
    advice = "Make one that has: --set data.identities.evaluation=8 data.poses.unseen=200 data.triples.count=200"
    triples = first_triples(dataset, count, advice=advice).tolist()
    return [case_of(dataset, number, triple) for number, triple in enumerate(triples)]


def first_triples(dataset: Dataset, count: int, *, advice: str) -> NDArray[np.integer]:
    """The first ``count`` of a dataset's fixed evaluation triples, with unseen poses where it has any.

    Raises
    ------
    DatasetError
        It has no evaluation triples; with ``advice``.
    """
    for pose_type in POSE_TYPES[::-1]:
        triples = dataset.evaluation_triples(pose_type)[:count]
        if len(triples):
            return triples
    raise DatasetError(f"{dataset.url} has no evaluation triples. {advice}")


def case_of(dataset: Dataset, number: int, triple: Sequence[int], targets: Dataset | None = None) -> Case:
    """The meshes of a row (source identity, source pose, target identity, target pose).

    ``targets`` is where target and truth come from, if it is another dataset with the same poses.
    """
    source, source_pose, target, target_pose = (int(value) for value in triple)
    targets = targets or dataset
    faces = targets.faces(target)
    return Case(
        number,
        (source, source_pose, target, target_pose),
        Mesh(dataset.vertices(source, source_pose).astype(np.float64), dataset.faces(source)),
        Mesh(targets.vertices(target, target_pose).astype(np.float64), faces),
        Mesh(targets.vertices(target, source_pose).astype(np.float64), faces),
    )


def disturbed(case: Case, disturbance: Disturbance, amount: float) -> Mesh:
    """The case's source with so much of a disturbance; the seed is the triple's number."""
    return disturbance.apply(case.source, amount, case.number)


def refusal(method: LoadedMethod, disturbance: Disturbance) -> str:
    """Why a method cannot take a disturbance; empty where it can."""
    return "" if disturbance.keeps_count else method.equal_counts


def measured(
    methods: Sequence[LoadedMethod],
    cases: Sequence[Case],
    disturbances: Sequence[Disturbance] = DISTURBANCES,
    *,
    emd_points: int | None = None,
    done: Sequence[RobustnessRow] = (),
) -> Iterator[list[RobustnessRow]]:
    """Rows of every method, disturbance and amount that ``done`` lacks, one list each, the no-op first."""
    there = {row.key for row in done}
    if (NO_OP, "", 0.0) not in there:
        scores = [case.score(normalised(case.target.vertices), emd_points) for case in cases]
        counts = [len(case.source.vertices) for case in cases]
        yield _rows((NO_OP, "", 0.0), cases, counts, scores)
    for disturbance, method, amount in steps(methods, disturbances):
        if (method.name, disturbance.name, amount) not in there:
            yield _measure(method, cases, disturbance, amount, emd_points)


def steps(
    methods: Sequence[LoadedMethod], disturbances: Sequence[Disturbance]
) -> list[tuple[Disturbance, LoadedMethod, float]]:
    """What is measured, in order; without what a method cannot take."""
    return [
        (disturbance, method, float(amount))
        for disturbance in disturbances
        for method in methods
        if not refusal(method, disturbance)
        for amount in disturbance.amounts
    ]


def _measure(
    method: LoadedMethod, cases: Sequence[Case], disturbance: Disturbance, amount: float, emd_points: int | None
) -> list[RobustnessRow]:
    sources = [disturbed(case, disturbance, amount) for case in cases]
    outputs = transfer_each(method.network, zip(sources, (case.target for case in cases), strict=True))
    scores = [case.score(output, emd_points) for case, output in zip(cases, outputs, strict=True)]
    return _rows((method.name, disturbance.name, amount), cases, [len(source.vertices) for source in sources], scores)


def _rows(
    key: tuple[str, str, float], cases: Sequence[Case], counts: Sequence[int], scores: Sequence[Score]
) -> list[RobustnessRow]:
    return [
        RobustnessRow(*key, case.number, *case.triple, count, **asdict(scored))
        for case, count, scored in zip(cases, counts, scores, strict=True)
    ]


def methods_in(rows: Sequence[_OfMethod]) -> list[str]:
    """Trained methods in the order of the rows."""
    return [name for name in dict.fromkeys(row.method for row in rows) if name != NO_OP]


@dataclass(frozen=True)
class Level:
    """Mean of a metric over the triples at one amount, and the ends of its 95 % interval."""

    amount: float
    mean: float
    low: float
    high: float


def curve(rows: Sequence[RobustnessRow], method: str, disturbance: str, field: str = "pmd") -> list[Level]:
    """The metric at every amount of a disturbance that rows have of a method, ascending."""
    found: dict[float, list[float]] = {}
    for row in rows:
        if (row.method, row.disturbance) == (method, disturbance):
            found.setdefault(row.amount, []).append(getattr(row, field))
    return [Level(amount, *mean_and_interval(found[amount])) for amount in sorted(found)]


def no_op(rows: Sequence[RobustnessRow]) -> float:
    """PMD of returning the target unchanged."""
    return mean(row.pmd for row in rows if row.method == NO_OP)


def doubled(levels: Sequence[Level]) -> float | None:
    """The first measured amount at which the mean is twice that of amount 0; None where none is."""
    return next((level.amount for level in levels if level.mean >= 2 * levels[0].mean), None)


def limits_table(rows: Sequence[RobustnessRow]) -> Table:
    """For each disturbance the amount at which each method's PMD has doubled, and the PMD at the most."""
    names = methods_in(rows)
    heads = [head for name in names for head in (f"{name}: doubled at", "PMD at the most")]
    lines = [["disturbance", "amount (unit)", *heads]]
    for disturbance in DISTURBANCES:
        curves = [curve(rows, name, disturbance.name) for name in names]
        if any(curves):
            span = f"{disturbance.amounts[0]:g} to {disturbance.amounts[-1]:g} ({disturbance.unit})"
            lines.append([disturbance.heading, span, *(cell for levels in curves for cell in _limit(levels))])
    return Table(lines, "Where it breaks")


def _limit(levels: Sequence[Level]) -> tuple[str, str]:
    if not levels:
        return "not taken", ""
    amount = doubled(levels)
    return "never" if amount is None else f"{amount:g}", f"{levels[-1].mean / PMD_UNIT:.2f}"


def amounts_table(rows: Sequence[RobustnessRow]) -> Table:
    """PMD (1e-4) with its interval and millimetres of every method at every amount of every disturbance."""
    names = methods_in(rows)
    lines = [["disturbance", "amount", *(head for name in names for head in (f"{name} PMD x1e-4", "95 %", "mm"))]]
    for disturbance in DISTURBANCES:
        pmd = {name: curve(rows, name, disturbance.name) for name in names}
        metres = {name: curve(rows, name, disturbance.name, "millimetres") for name in names}
        amounts = sorted({level.amount for levels in pmd.values() for level in levels})
        for amount in amounts:
            cells = [cell for name in names for cell in _cells(pmd[name], metres[name], amount)]
            lines.append([disturbance.heading, f"{amount:g}", *cells])
    return Table(lines, "Every amount", "Mean over triples, with its 95 % interval.")


def _cells(pmd: Sequence[Level], millimetres: Sequence[Level], amount: float) -> tuple[str, str, str]:
    for level, distance in zip(pmd, millimetres, strict=True):
        if level.amount == amount:
            return (
                f"{level.mean / PMD_UNIT:.2f}",
                f"{level.low / PMD_UNIT:.2f} to {level.high / PMD_UNIT:.2f}",
                f"{distance.mean:.1f}",
            )
    return "", "", ""
