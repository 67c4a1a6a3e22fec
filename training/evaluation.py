"""Rows (one a triple: who, which pose, every metric) for the trained network and for the two no-op baselines.

The no-op baselines say what a method that does nothing would score: ``target unchanged`` returns the target as it is
(right identity, wrong pose), ``source unchanged`` returns the source (right pose, wrong identity).
"""

import csv
import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from datagen.grid import PoseType
from datagen.mesh import bounding_box, edges_of, write_atomically
from datagen.store import Dataset, open_dataset
from training import metrics
from training.batches import read_batch
from training.checkpoint import require_checkpoint
from training.inference import load_trained, predict
from training.recipe import EvaluationRecipe

NO_OPS = ("target unchanged", "source unchanged")
POSE_TYPES: tuple[PoseType, ...] = ("seen", "unseen")
Runner = Callable[[Callable[..., Any], list[tuple[Any, ...]]], Iterator[Any]]


@dataclass(frozen=True, order=True)
class Row:
    """One method on one evaluation triple. Metrics are in the normalised box unless their name says otherwise."""

    method: str
    pose_type: str
    triple: int
    source_identity: int
    source_pose: int
    target_identity: int
    target_pose: int
    pmd: float
    pmd_recentred: float
    chamfer: float
    earth_mover: float
    millimetres: float
    edge_ratio: float
    normal_degrees: float


def evaluation_list(dataset: Dataset, recipe: EvaluationRecipe, pose_type: PoseType) -> np.ndarray[Any, Any]:
    """The first ``recipe.triples`` of the dataset's fixed list."""
    return dataset.evaluation_triples(pose_type)[: recipe.triples]


def evaluate(
    run: Path,
    data: str,
    recipe: EvaluationRecipe,
    *,
    tasks: Runner,
    method: str = "DSFFNet",
    progress: Callable[[Iterable[list[Row]], int], Iterable[list[Row]]] = lambda rows, total: rows,
) -> list[Row]:
    """Measure a run on a dataset's fixed evaluation triples; rows come back in a fixed order.

    ``tasks`` runs functions over argument tuples here or on a cluster (see ``datagen.generate``).
    """
    dataset, checkpoint = open_dataset(data), require_checkpoint(run, "result").path
    arguments = [
        (str(checkpoint), data, recipe, method, pose_type, start)
        for pose_type in POSE_TYPES
        for start in range(0, len(evaluation_list(dataset, recipe, pose_type)), recipe.chunk)
    ]
    chunks = progress(tasks(measure_chunk, arguments), len(arguments))
    return sorted(row for chunk in chunks for row in chunk)


def measure_chunk(
    checkpoint: str, data: str, recipe: EvaluationRecipe, method: str, pose_type: PoseType, start: int
) -> list[Row]:
    """Rows of the triples [start, start + recipe.chunk) of one list, for one checkpoint and the no-op baselines."""
    dataset, network = open_dataset(data), _network(checkpoint)
    triples = evaluation_list(dataset, recipe, pose_type)[start : start + recipe.chunk]
    batch = read_batch(dataset, triples, padded=True)
    outputs = {method: predict(network, batch), NO_OPS[0]: batch.target}
    if _one_count(dataset, evaluation_list(dataset, recipe, pose_type)):
        outputs[NO_OPS[1]] = batch.source
    return [
        Row(name, pose_type, start + place, *map(int, triple), *values)
        for name, output in outputs.items()
        for place, (triple, values) in enumerate(
            zip(triples, _measure_each(dataset, triples, output, batch.truth, recipe), strict=True)
        )
    ]


def _one_count(dataset: Dataset, triples: NDArray[np.integer]) -> bool:
    """Whether all sources and targets of a list have as many vertices, so that a source can stand for an output."""
    identities = np.unique(triples[:, [0, 2]]).tolist()
    return len({dataset.vertex_count(identity) for identity in identities}) == 1


def _measure_each(
    dataset: Dataset, triples: NDArray[np.integer], output: Tensor, truth: Tensor, recipe: EvaluationRecipe
) -> list[tuple[float, ...]]:
    """Metrics of each triple over its target's own vertices and faces; rows behind its count are padding."""
    found: dict[int, tuple[float, ...]] = {}
    for identity in np.unique(triples[:, 2]).tolist():
        places, count = np.flatnonzero(triples[:, 2] == identity).tolist(), dataset.vertex_count(identity)
        half = torch.tensor([_half_size(dataset, identity, int(triples[place, 1])) for place in places])
        ours, right = output[places, :count], truth[places, :count]
        found |= zip(places, _measure(ours, right, dataset.faces(identity), half, recipe), strict=True)
    return [found[place] for place in range(len(triples))]


def _measure(
    output: Tensor, truth: Tensor, faces: NDArray[np.int32], half: Tensor, recipe: EvaluationRecipe
) -> list[tuple[float, ...]]:
    edges, triangles = torch.from_numpy(edges_of(faces)), torch.from_numpy(faces).long()
    columns = (
        metrics.point_mesh_distance(output, truth),
        metrics.recentred_point_mesh_distance(output, truth),
        metrics.chamfer_distance(output, truth),
        metrics.earth_mover_distance(output, truth, points=recipe.emd_points, seed=recipe.seed),
        metrics.mean_euclidean_error(output, truth) * half * 1000,
        metrics.edge_length_ratio_error(output, truth, edges),
        metrics.normal_angle_error(output, truth, triangles),
    )
    return list(zip(*(column.tolist() for column in columns), strict=True))


def _half_size(dataset: Dataset, identity: int, pose: int) -> float:
    """Metres that one unit of the normalised box is, for one mesh."""
    return float(bounding_box(dataset.vertices(identity, pose)).half)


@lru_cache(maxsize=1)
def _network(checkpoint: str) -> nn.Module:
    return load_trained(Path(checkpoint))[0]


def write_rows(rows: list[Row], path: Path) -> None:
    """Write rows as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Row)])
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    write_atomically(path, text.getvalue().encode())


def read_rows(path: Path) -> list[Row]:
    """Rows of a CSV that :func:`write_rows` wrote."""
    with open(path, encoding="utf-8") as file:
        return [
            Row(**{field.name: field.type(line[field.name]) for field in fields(Row)})  # type: ignore[operator]
            for line in csv.DictReader(file)
        ]
