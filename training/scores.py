"""Networks in memory, their outputs on pairs of any vertex counts, and every metric of one output."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from datagen.mesh import bounding_box, edges_of
from training.evaluation import method_name, needs_equal_counts
from training.inference import load_trained
from training.measuring import Score, measure

_EQUAL_COUNTS = "NPT 'origin' pairs source and target vertex by vertex, so that it needs as many of both"
_POINTS_AT_ONCE = 2**15  # source vertices and target vertices of pairs that go through a network together
Vertices = NDArray[np.floating]


@dataclass(frozen=True)
class LoadedMethod:
    """A trained network in memory, under the name that tables and figures have for it.

    :class:`training.measuring.Method` is one by the place of its weights alone. ``equal_counts`` says why it takes no
    source of another vertex count than the target's ("": it takes any).
    """

    name: str
    network: nn.Module
    step: int
    place: str
    equal_counts: str = ""


def load_methods(places: Sequence[Path], *, labels: Sequence[str]) -> list[LoadedMethod]:
    """The networks of some weights, named as evaluations name them and, where that is not unique, by their label too.

    Raises
    ------
    CheckpointError
        A place has no usable weights.
    """
    loaded = [load_trained(place) for place in places]
    titles = [method_name(recipe.network) for _, recipe, _ in loaded]
    names = _told_apart(titles, labels)
    return [
        LoadedMethod(name, network, step, str(place), _EQUAL_COUNTS if needs_equal_counts(recipe.network) else "")
        for name, place, (network, recipe, step) in zip(names, places, loaded, strict=True)
    ]


def _told_apart(titles: Sequence[str], labels: Sequence[str]) -> list[str]:
    """Titles, with a label where two are alike, and with a number where the labels are alike as well."""
    named = [
        title if titles.count(title) == 1 else f"{title} {label}" for title, label in zip(titles, labels, strict=True)
    ]
    return [
        name if named.count(name) == 1 else f"{name} ({named[: place + 1].count(name)})"
        for place, name in enumerate(named)
    ]


def normalised(vertices: Vertices) -> NDArray[np.float32]:
    """Vertices [v, 3] in the normalised box, computed in float64."""
    exact = np.asarray(vertices, np.float64)
    return bounding_box(exact).normalise(exact).astype(np.float32)


@torch.no_grad()
def transfer_each(network: nn.Module, pairs: Iterable[tuple[Vertices, Vertices]]) -> Iterator[NDArray[np.float64]]:
    """Outputs [m, 3] in the normalised box for pairs of source [n, 3] and target [m, 3] in any unit, in their order.

    Pairs of equal counts that follow each other go through the network together, as far as memory stays small.
    """
    for _, run in groupby(pairs, key=lambda pair: (len(pair[0]), len(pair[1]))):
        alike = list(run)
        at_once = max(1, _POINTS_AT_ONCE // (len(alike[0][0]) + len(alike[0][1])))
        for start in range(0, len(alike), at_once):
            part = alike[start : start + at_once]
            output = network(source=_stacked([source for source, _ in part]), target=_stacked([its for _, its in part]))
            yield from output.double().numpy()


def _stacked(meshes: Sequence[Vertices]) -> Tensor:
    return torch.from_numpy(np.stack([normalised(mesh) for mesh in meshes]))


def score(
    output: Vertices, truth: Vertices, faces: NDArray[np.integer], *, half: float, emd_points: int | None = None
) -> Score:
    """Every metric of one output (see :mod:`training.metrics`).

    Parameters
    ----------
    output, truth
        ``[v, 3]`` in the normalised box.
    faces
        ``[f, 3]``, the target's.
    half
        Metres that one unit of the box is for the truth.
    emd_points
        Vertices of the earth mover's distance; None: not measured (NaN).
    """
    ours, right = (torch.from_numpy(np.asarray(mesh, np.float64))[None] for mesh in (output, truth))
    triangles = np.ascontiguousarray(faces, np.int64)
    return measure(
        ours,
        right,
        edges=torch.from_numpy(_edges(triangles.tobytes())),
        faces=torch.from_numpy(triangles),
        metres=torch.tensor([half], dtype=torch.float64),
        emd_points=emd_points,
    )[0]


@lru_cache(maxsize=16)
def _edges(faces: bytes) -> NDArray[np.int64]:
    """Edges of int64 faces, which the triples of a topology share: sorting them takes longer than the metrics."""
    return edges_of(np.frombuffer(faces, np.int64).reshape(-1, 3))


def mean_and_interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and half the width of its 95 % interval: 1.96 standard errors (0 for one value)."""
    numbers = np.asarray(values, np.float64)
    if len(numbers) < 2:
        return float(numbers.mean()) if len(numbers) else float("nan"), 0.0
    return float(numbers.mean()), float(1.96 * numbers.std(ddof=1) / np.sqrt(len(numbers)))


def in_words(score: Score) -> str:
    """PMD and millimetres, for a caption."""
    pmd = score.pmd * 1e4
    return f"PMD {pmd:.{1 if pmd < 99.95 else 0}f}e-4, {score.millimetres:.0f} mm"
