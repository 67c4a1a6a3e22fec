"""Every metric of outputs, and measuring some methods on one chunk of triples: the work of one task of an evaluation.

The no-op baselines say what a method that does nothing would score: ``target unchanged`` returns the target as it is
(right identity, wrong pose), ``source unchanged`` returns the source (right pose, wrong identity). Of dressed targets
``target skinned`` says what a method that is perfect but knows no cloth would score: the target moved by its own rig.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from datagen.common.resources import memory_errors
from datagen.grid import PoseType
from datagen.mesh.geometry import Mesh, bounding_box, edges_of
from datagen.mesh.rig import rest_vertices, skinned, world_rotations
from datagen.store import Dataset, open_dataset
from training.data.batch import Batch, read_batch
from training.data.vertex_layout import read_each
from training.evaluation.results import Dressed, Row, Score
from training.inference.mesh_reading import takes_surfaces, transferred
from training.inference.predict import load_trained, predict
from training.inference.projection import OntoParts
from training.objectives import PMD_UNIT, metrics
from training.recipes.training import EvaluationRecipe

NO_OPS = ("target unchanged", "source unchanged")
SKINNED = "target skinned"
CONTROLS = (*NO_OPS, SKINNED)
"""Methods without a network."""
POSE_TYPES: tuple[PoseType, ...] = ("seen", "unseen")


@dataclass(frozen=True)
class Method:
    """A network to measure: its name in tables, and its weights.

    ``weights``: a run, a checkpoint's folder or a file of weights
    (see ``training.checkpoints.checkpoint.require_checkpoint``). ``projected_by``: weights of a parts network, onto
    whose parts its outputs are projected; "" for none.
    """

    name: str
    weights: str
    projected_by: str = ""


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
    told = any(takes_surfaces(_network_of(method)) for method in contenders if method.name not in CONTROLS)
    batch, groups = read_batch(dataset, triples, padded=True, surfaces=told), _groups(dataset, triples)
    return [
        Row(contender.name, pose_type, start + place, *map(int, triples[place]), *astuple(score), *astuple(dressed))
        for contender in contenders
        for place, (score, dressed) in enumerate(
            _measure_each(groups, outputs_of(contender, batch, dataset, triples), batch.truth, recipe)
        )
    ]


def outputs_of(contender: Contender, batch: Batch, dataset: Dataset, triples: NDArray[np.integer]) -> Tensor:
    """What a contender makes of some triples [b, v, 3], in the truth's box; ``batch`` is theirs, padded."""
    if contender.name == SKINNED:
        return _skinned(dataset, triples, batch.truth)
    if contender.name in NO_OPS:
        return batch.target if contender.name == NO_OPS[0] else batch.source
    return predict(_network_of(contender), batch)


def _skinned(dataset: Dataset, triples: NDArray[np.integer], like: Tensor) -> Tensor:
    """Targets ``[b, v, 3]`` in the source's pose by their own rigs, in the truth's box; padded as ``like`` is."""
    rotations, parents = dataset.rotations(), dataset.attributes["joint_parents"]
    found = torch.zeros_like(like)
    for place, (_, wanted, identity, pose) in enumerate(triples.tolist()):
        rig, vertices = dataset.rig(identity), dataset.vertices(identity, pose).astype(np.float64)
        assert rig is not None
        here, there = rig.transforms(world_rotations(rotations[[pose, wanted]], parents))
        unposed = rest_vertices(vertices[None], rig.weights, here[None])
        box = bounding_box(dataset.vertices(identity, wanted).astype(np.float64))
        moved = box.normalise(skinned(unposed, rig.weights, there[None])[0])
        found[place, : len(moved)] = torch.from_numpy(moved)
    return found


def _network_of(contender: Contender) -> nn.Module:
    return _network(contender.weights, contender.projected_by, contender.sha256)


@lru_cache(maxsize=8)
def _network(weights: str, projected_by: str, sha256: str) -> nn.Module:
    """The network of weights, once a process; ``sha256`` tells weights apart that were written to one place."""
    network = load_trained(Path(weights))[0]
    return OntoParts.of(network, Path(projected_by)) if projected_by else network


@dataclass(frozen=True)
class _Group:
    """Triples of one target identity in a chunk: places, vertices, edges, faces, metres a box unit is, and garments.

    ``is_garment`` [vertex]: which vertices are; None of a bare identity.
    """

    places: list[int]
    count: int
    edges: Tensor
    faces: Tensor
    metres: Tensor
    is_garment: Tensor | None


def _groups(dataset: Dataset, triples: NDArray[np.integer]) -> list[_Group]:
    return [_group(dataset, triples, identity) for identity in np.unique(triples[:, 2]).tolist()]


def _group(dataset: Dataset, triples: NDArray[np.integer], identity: int) -> _Group:
    places, faces = np.flatnonzero(triples[:, 2] == identity).tolist(), dataset.faces(identity)
    truths = read_each(dataset, [identity] * len(places), triples[places, 1].tolist())
    metres = [float(bounding_box(vertices).half) for vertices in truths]
    edges, triangles = torch.from_numpy(edges_of(faces)), torch.from_numpy(faces).long()
    lengths, part = torch.tensor(metres, dtype=torch.float64), dataset.part(identity)
    is_garment = None if part is None else torch.from_numpy(part > 0)
    return _Group(places, dataset.vertex_count(identity), edges, triangles, lengths, is_garment)


def _measure_each(
    groups: Sequence[_Group], output: Tensor, truth: Tensor, recipe: EvaluationRecipe
) -> list[tuple[Score, Dressed]]:
    """Metrics of each triple over its target's own vertices and faces; rows after its count are padding."""
    found: dict[int, tuple[Score, Dressed]] = {}
    for group in groups:
        ours, right = output[group.places, : group.count], truth[group.places, : group.count]
        about: dict[str, Any] = {"emd_points": recipe.emd_points, "seed": recipe.seed}
        scores = measure(ours, right, edges=group.edges, faces=group.faces, metres=group.metres, **about)
        dressed = [Dressed()] * len(ours)
        if group.is_garment is not None:
            skin, garment = (_of_part(group, its, ours, right, about) for its in (~group.is_garment, group.is_garment))
            dressed = [Dressed(*one, *other) for one, other in zip(skin, garment, strict=True)]
        found |= zip(group.places, zip(scores, dressed, strict=True), strict=True)
    return [found[place] for place in range(len(found))]


def _of_part(group: _Group, part: Tensor, output: Tensor, truth: Tensor, about: dict[str, Any]) -> list[list[float]]:
    """Metrics of the vertices of a ``part`` [vertex] as a mesh of their own, in the order of `Dressed`."""
    number = part.cumsum(0) - 1
    edges, faces = (number[each[part[each].all(dim=1)]] for each in (group.edges, group.faces))
    scores = measure(output[:, part], truth[:, part], edges=edges, faces=faces, metres=group.metres, **about)
    return [
        [its.pmd, its.chamfer, its.earth_mover, its.millimetres, its.edge_ratio, its.normal_degrees] for its in scores
    ]


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
    """Every metric of outputs for one target (see :mod:`training.objectives.metrics`).

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
        metrics.area_point_mesh_distance(output, truth, faces),
    )
    return [Score(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]


_EQUAL_COUNTS = "NPT 'origin' pairs source and target vertex by vertex, so that it needs as many of both"
_POINTS_AT_ONCE = 2**15  # source vertices and target vertices of pairs that go through a network together
Vertices = NDArray[np.floating]


@dataclass(frozen=True)
class LoadedMethod:
    """A trained network in memory, under the name that tables and figures have for it.

    :class:`training.evaluation.measure.Method` is one by the place of its weights alone. ``equal_counts`` says why it
    takes no source of another vertex count than the target's ("": it takes any).
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
    titles = [recipe.network.title for _, recipe, _ in loaded]
    names = _told_apart(titles, labels)
    return [
        LoadedMethod(name, network, step, str(place), _EQUAL_COUNTS if recipe.network.needs_equal_counts else "")
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


@torch.no_grad()
def transfer_each(network: nn.Module, pairs: Iterable[tuple[Mesh, Mesh]]) -> Iterator[NDArray[np.float64]]:
    """Outputs [m, 3] in the normalised box for pairs of source and target in any unit, in their order.

    Pairs of equal counts that follow each other go through the network together, as far as memory stays small.
    """
    for counts, run in groupby(pairs, key=lambda pair: (len(pair[0].vertices), len(pair[1].vertices))):
        alike, at_once = list(run), max(1, _POINTS_AT_ONCE // sum(counts))
        for start in range(0, len(alike), at_once):
            sources, targets = zip(*alike[start : start + at_once], strict=True)
            yield from transferred(network, sources, targets).double().cpu().numpy()


def score(
    output: Vertices, truth: Vertices, faces: NDArray[np.integer], *, half: float, emd_points: int | None = None
) -> Score:
    """Every metric of one output (see :mod:`training.objectives.metrics`).

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


def in_words(score: Score) -> str:
    """PMD and millimetres, for a caption."""
    pmd = score.pmd / PMD_UNIT
    return f"PMD {pmd:.{1 if pmd < 99.95 else 0}f}e-4, {score.millimetres:.0f} mm"
