"""Every metric of outputs, and measuring some methods on one chunk of triples: the work of one task of an evaluation.

The no-op baselines say what a method that does nothing would score: ``target unchanged`` returns the target as it is
(right identity, wrong pose), ``source unchanged`` returns the source (right pose, wrong identity).
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from datagen.grid import PoseType
from datagen.mesh import bounding_box, edges_of
from datagen.resources import memory_errors
from datagen.store import Dataset, open_dataset
from training import metrics
from training.batches import Batch, read_batch
from training.inference import load_trained, predict
from training.recipe import EvaluationRecipe
from training.rows import Row


@dataclass(frozen=True)
class Score:
    """Metrics of one output, as the last fields of :class:`training.rows.Row`; NaN: not measured, or not finite."""

    pmd: float
    pmd_recentred: float
    chamfer: float
    earth_mover: float
    millimetres: float
    edge_ratio: float
    normal_degrees: float


METRICS = tuple(field.name for field in fields(Score))
NO_OPS = ("target unchanged", "source unchanged")
POSE_TYPES: tuple[PoseType, ...] = ("seen", "unseen")


@dataclass(frozen=True)
class Method:
    """A network to measure: its name in tables, and its weights.

    ``weights``: a run, a checkpoint's folder or a file of weights (see ``training.checkpoint.require_checkpoint``).
    """

    name: str
    weights: str


@dataclass(frozen=True)
class Contender(Method):
    """A method whose weights are known: by the checkpoint's own path and a hash of them. No-ops have neither."""

    sha256: str = ""


def evaluation_list(dataset: Dataset, recipe: EvaluationRecipe, pose_type: PoseType) -> np.ndarray[Any, Any]:
    """The first ``recipe.triples`` of the dataset's fixed list."""
    return dataset.evaluation_triples(pose_type)[: recipe.triples]


def measure_chunk(
    contenders: Sequence[Contender], data: str, recipe: EvaluationRecipe, pose_type: PoseType, start: int
) -> list[Row]:
    """Rows of the triples [start, start + recipe.chunk) of one list, for each contender."""
    advice = f"Lower evaluation.chunk (it is {recipe.chunk}) or evaluation.emd_points (it is {recipe.emd_points})"
    with memory_errors(advice):
        return _measured(contenders, open_dataset(data), recipe, pose_type, start)


def _measured(
    contenders: Sequence[Contender], dataset: Dataset, recipe: EvaluationRecipe, pose_type: PoseType, start: int
) -> list[Row]:
    triples = evaluation_list(dataset, recipe, pose_type)[start : start + recipe.chunk]
    batch, groups = read_batch(dataset, triples, padded=True), _groups(dataset, triples)
    return [
        Row(contender.name, pose_type, start + place, *map(int, triple), *astuple(score))
        for contender in contenders
        for place, (triple, score) in enumerate(
            zip(triples, _measure_each(groups, _output(contender, batch), batch.truth, recipe), strict=True)
        )
    ]


def _output(contender: Contender, batch: Batch) -> Tensor:
    if contender.name in NO_OPS:
        return batch.target if contender.name == NO_OPS[0] else batch.source
    return predict(_network(contender.weights, contender.sha256), batch)


@lru_cache(maxsize=8)
def _network(weights: str, sha256: str) -> nn.Module:
    """The network of weights, once a process; ``sha256`` tells weights apart that were written to one place."""
    return load_trained(Path(weights))[0]


@dataclass(frozen=True)
class _Group:
    """Triples of one target identity in a chunk: their places, vertices, edges, faces, and metres a box unit is."""

    places: list[int]
    count: int
    edges: Tensor
    faces: Tensor
    metres: Tensor


def _groups(dataset: Dataset, triples: NDArray[np.integer]) -> list[_Group]:
    return [_group(dataset, triples, identity) for identity in np.unique(triples[:, 2]).tolist()]


def _group(dataset: Dataset, triples: NDArray[np.integer], identity: int) -> _Group:
    places, faces = np.flatnonzero(triples[:, 2] == identity).tolist(), dataset.faces(identity)
    metres = [float(bounding_box(dataset.vertices(identity, int(triples[place, 1]))).half) for place in places]
    edges, triangles = torch.from_numpy(edges_of(faces)), torch.from_numpy(faces).long()
    return _Group(places, dataset.vertex_count(identity), edges, triangles, torch.tensor(metres, dtype=torch.float64))


def _measure_each(groups: Sequence[_Group], output: Tensor, truth: Tensor, recipe: EvaluationRecipe) -> list[Score]:
    """Metrics of each triple over its target's own vertices and faces; rows behind its count are padding."""
    found: dict[int, Score] = {}
    for its in groups:
        ours, right = output[its.places, : its.count], truth[its.places, : its.count]
        about: dict[str, Any] = {"emd_points": recipe.emd_points, "seed": recipe.seed}
        scores = measure(ours, right, edges=its.edges, faces=its.faces, metres=its.metres, **about)
        found |= zip(its.places, scores, strict=True)
    return [found[place] for place in range(len(found))]


def measure(
    output: Tensor,
    truth: Tensor,
    *,
    edges: Tensor,
    faces: Tensor,
    metres: Tensor,
    emd_points: int | None,
    seed: int = 0,
) -> list[Score]:
    """Every metric of outputs for one target (see :mod:`training.metrics`).

    Parameters
    ----------
    output, truth
        ``[b, v, 3]`` in the normalised box, vertex by vertex.
    edges, faces
        ``[e, 2]`` and ``[f, 3]`` int64, the target's.
    metres
        ``[b]`` float64, what one unit of the box is for each truth.
    emd_points, seed
        Vertices of the earth mover's distance (None: it is not measured), and the seed they are drawn by.
    """
    columns = (
        metrics.point_mesh_distance(output, truth),
        metrics.recentred_point_mesh_distance(output, truth),
        metrics.chamfer_distance(output, truth),
        metrics.earth_mover_distance(output, truth, points=emd_points, seed=seed)
        if emd_points
        else torch.full((len(output),), torch.nan),
        metrics.mean_euclidean_error(output, truth) * metres * 1000,
        metrics.edge_length_ratio_error(output, truth, edges),
        metrics.normal_angle_error(output, truth, faces),
    )
    return [Score(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]
