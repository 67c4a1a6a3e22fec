"""Transfers between kinds of meshes that the weights were not trained on (paper, Figure 8): rows and tables.

A kind is a dataset: one topology, one body model. Two kinds that hold the same poses have a ground truth between them:
the target's identity, in the target's own mesh, in the source's pose. Kinds without poses in common have none, and a
picture is then all that can be shown.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.store import Dataset
from training.evaluation.document import Table
from training.evaluation.measure import LoadedMethod, transfer_each
from training.evaluation.results import Score, Triple
from training.evaluation.robustness import NO_OP, Case, SourceCount, case_of, first_triples
from training.evaluation.statistics import mean
from training.inference.mesh_reading import normalised
from training.objectives import PMD_UNIT


@dataclass(frozen=True)
class MeshKind:
    """Meshes of one kind.

    Attributes
    ----------
    name
        What a person calls it, for example ``Anny 615``.
    dataset
        Its meshes.
    poses
        Kinds with the same text here hold the same poses under the same numbers, and as many identities.
    """

    name: str
    dataset: Dataset
    poses: str


@dataclass(frozen=True)
class Between:
    """Which method, and from which kind of mesh to which."""

    method: str
    source_kind: str
    target_kind: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What belongs together: method, kind of source, kind of target."""
        return self.method, self.source_kind, self.target_kind


@dataclass(frozen=True)
class Counts(SourceCount):
    """Vertices of source and target."""

    target_vertices: int


@dataclass(frozen=True)
class GeneralisationRow(Score, Counts, Triple, Between):
    """One method on one triple from a kind of source to a kind of target."""


def have_truth(source: MeshKind, target: MeshKind) -> bool:
    """Whether the ground truth of transfers from one kind to the other is known."""
    return source.poses == target.poses


def pairs_with_truth(kinds: Sequence[MeshKind]) -> list[tuple[MeshKind, MeshKind]]:
    """All (source, target) whose ground truth is known, sources in order."""
    return [(source, target) for source in kinds for target in kinds if have_truth(source, target)]


def cases_between(source: MeshKind, target: MeshKind, count: int) -> list[Case]:
    """The first triples of the source's list, with target and truth in the target's mesh."""
    advice = "Make one that has two evaluation identities: --set data.identities.evaluation=2"
    triples = first_triples(source.dataset, count, advice=advice).tolist()
    return [case_of(source.dataset, place, triple, target.dataset) for place, triple in enumerate(triples)]


def measured(
    methods: Sequence[LoadedMethod], kinds: Sequence[MeshKind], *, triples: int, done: Sequence[GeneralisationRow] = ()
) -> Iterator[list[GeneralisationRow]]:
    """Rows of every pair of kinds that has a truth, a list a pair: every method that ``done`` lacks.

    The no-op, which does not depend on the source's mesh, comes with the pairs within a kind. A method that needs
    equal counts is left out where counts differ.
    """
    there = {row.key for row in done}
    for source, target in pairs_with_truth(kinds):
        cases = cases_between(source, target, triples)
        rows = []
        if source is target and (NO_OP, source.name, target.name) not in there:
            scores = [case.score(normalised(case.target.vertices)) for case in cases]
            rows += _rows((NO_OP, source.name, target.name), cases, scores)
        for method in methods:
            if (method.name, source.name, target.name) not in there and takes(method, cases):
                rows += _rows((method.name, source.name, target.name), cases, _scores(method, cases))
        yield rows


def takes(method: LoadedMethod, cases: Sequence[Case]) -> bool:
    """Whether a method can take these cases' vertex counts."""
    equal = all(len(case.source.vertices) == len(case.target.vertices) for case in cases)
    return equal or not method.equal_counts


def _scores(method: LoadedMethod, cases: Sequence[Case]) -> list[Score]:
    pairs = ((case.source, case.target) for case in cases)
    return [case.score(output) for case, output in zip(cases, transfer_each(method.network, pairs), strict=True)]


def _rows(key: tuple[str, str, str], cases: Sequence[Case], scores: Sequence[Score]) -> list[GeneralisationRow]:
    return [
        GeneralisationRow(
            *key,
            case.number,
            *case.triple,
            len(case.source.vertices),
            len(case.target.vertices),
            **asdict(scored),
        )
        for case, scored in zip(cases, scores, strict=True)
    ]


def grid_of(
    rows: Sequence[GeneralisationRow], kinds: Sequence[str], method: str, field: str = "pmd"
) -> NDArray[np.float64]:
    """Means of a metric [source kind, target kind]; NaN where nothing was measured."""
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if row.method == method:
            found.setdefault((row.source_kind, row.target_kind), []).append(getattr(row, field))
    means = {pair: mean(values) for pair, values in found.items()}
    return np.array([[means.get((source, target), np.nan) for target in kinds] for source in kinds])


def no_op_line(rows: Sequence[GeneralisationRow], kinds: Sequence[str], field: str = "pmd") -> NDArray[np.float64]:
    """What returning the target unchanged scores for each kind of target [kind], whatever the source's kind."""
    grid = grid_of(rows, kinds, NO_OP, field)
    known = np.isfinite(grid)
    return np.where(known.any(0), np.where(known, grid, 0).sum(0) / np.maximum(known.sum(0), 1), np.nan)


def grid_table(
    rows: Sequence[GeneralisationRow], kinds: Sequence[str], method: str, *, field: str = "pmd", unit: float = PMD_UNIT
) -> Table:
    """The grid of one method, sources down, targets across, and the no-op as the last line."""
    lines = [["source \\ target", *kinds]]
    for kind, means in zip(kinds, grid_of(rows, kinds, method, field), strict=True):
        lines.append([kind, *(_cell(value, unit) for value in means)])
    lines.append([NO_OP, *(_cell(value, unit) for value in no_op_line(rows, kinds, field))])
    return Table(lines)


def _cell(value: float, unit: float) -> str:
    return f"{value / unit:.1f}" if np.isfinite(value) else "–"
