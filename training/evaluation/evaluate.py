"""Rows (one a triple: who, which pose, every metric) for any number of networks and for the two no-op baselines.

Every method is measured on the same triples of a dataset's fixed lists, by tasks that run here or on a cluster; what a
task does is in :mod:`training.evaluation.measure`. Finished chunks are kept, so that a second start does what is
missing.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import EvaluationError, RecipeError
from datagen.common.files import sha256_of
from datagen.common.resources import bytes_text, free_memory
from datagen.grid import PoseType
from datagen.store import Dataset, open_dataset
from training.checkpoints.checkpoint import Checkpoint, recipe_of, require_checkpoint
from training.checkpoints.folder import AVERAGE, WEIGHTS, manifest_of
from training.evaluation.measure import (
    CONTROLS,
    NO_OPS,
    POSE_TYPES,
    SKINNED,
    Contender,
    Method,
    evaluation_list,
    measure_chunk,
)
from training.evaluation.results import Row, forget_pieces, piece_name, read_piece, read_rows, write_rows
from training.recipes.networks import NetworkRecipe
from training.recipes.training import EvaluationRecipe

__all__ = [
    "NO_OPS",
    "POSE_TYPES",
    "EvaluationError",
    "Method",
    "Row",
    "evaluate",
    "evaluation_list",
    "fingerprint_of",
    "measure_chunk",
    "read_rows",
    "require_pairable",
    "triples_in",
    "write_rows",
]

ChunkRunner = Callable[[Callable[..., Any], list[tuple[Any, ...]]], Iterator[Any]]
EvaluationProgress = Callable[[Iterable[list[Row]], int, int], Iterable[list[Row]]]
"""Passes on rows as they come; told the triples of the whole evaluation, and those that were kept from before."""

_DISTANCE = 2 * 8
"""Bytes of a pair of points in the earth mover's distance: its cost in float64, and that reduced."""
_MEASURED_AS = 1
"""Raise this when a metric is computed otherwise, so that rows kept by an earlier version are not taken for new."""


def evaluate(
    methods: Sequence[Method],
    data: str,
    recipe: EvaluationRecipe,
    *,
    tasks: ChunkRunner,
    keep: Path | None = None,
    progress: EvaluationProgress = lambda rows, total, done: rows,
) -> list[Row]:
    """Measure methods and the no-op baselines on a dataset's fixed evaluation triples; rows come in a fixed order.

    A task measures all methods on one chunk of triples: meshes are read once, and slow networks slow every task alike.

    Parameters
    ----------
    methods
        Networks, of any recipe and training; names must differ.
    data
        URL of a complete dataset.
    tasks
        Runs functions over argument tuples here or on a cluster (see ``datagen.generate``).
    keep
        Folder for finished pieces, one small CSV a method and chunk: the same call again measures only what is missing,
        and one with another method added only that method. Pieces of other weights, data or recipes are removed.
    progress
        See :data:`EvaluationProgress`; :func:`triples_in` counts what comes.

    Raises
    ------
    EvaluationError
        Two methods of one name, no triples, or a network that cannot take the vertex counts.
    CheckpointError
        Weights are missing or damaged.
    RecipeError
        The earth mover's distance of so many points needs more memory than there is.
    """
    dataset = open_dataset(data)
    _require_memory(dataset, recipe)
    pieces = _pieces(dataset, _contenders(methods, dataset, recipe), recipe)
    found = {piece: kept for piece in pieces if keep and (kept := read_piece(keep / piece.file, piece.expected))}
    missing = _by_chunk(piece for piece in pieces if piece not in found)
    total = len({chunk for piece in pieces for chunk in piece.triples})
    done = total - len({chunk for chunk_pieces in missing.values() for chunk in chunk_pieces[0].triples})
    arguments = [(tuple(p.contender for p in these), data, recipe, *chunk) for chunk, these in missing.items()]
    for rows in progress(tasks(measure_chunk, arguments), total, done):
        for piece in missing[_chunk_of(rows)]:
            found[piece] = [row for row in rows if row.method == piece.contender.name]
            if keep:
                write_rows(found[piece], keep / piece.file)
    if keep:
        forget_pieces(keep, but=[piece.file for piece in pieces])
    return sorted(row for rows in found.values() for row in rows)


def _require_memory(dataset: Dataset, recipe: EvaluationRecipe) -> None:
    counts = (dataset.vertex_count(identity) for identity in dataset.identities("evaluation"))
    points = min(recipe.emd_points, max(counts, default=0))
    needed, free = _DISTANCE * points**2, free_memory()
    if needed > free:
        raise RecipeError(
            f"the earth mover's distance of {points:,} points takes {bytes_text(needed)} of memory, but "
            f"{bytes_text(free)} are free. Lower evaluation.emd_points (it is {recipe.emd_points:,})"
        )


def triples_in(rows: Iterable[Row]) -> int:
    """How many triples rows are of, each counted once for all methods."""
    return len({(row.pose_type, row.triple) for row in rows})


def require_distinct(names: Sequence[str]) -> None:
    """Refuse methods that tables could not tell apart.

    Raises
    ------
    EvaluationError
        Two have one name.
    """
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise EvaluationError(f"two methods are called {twice[0]!r}: give each a name of its own")


def require_pairable(name: str, network: NetworkRecipe, source: int, target: int, *, where: str) -> None:
    """Refuse a network that pairs source and target by index for meshes of different counts.

    Raises
    ------
    EvaluationError
        Naming the method, the counts and ``where`` they are.
    """
    if network.needs_equal_counts and source != target:
        raise EvaluationError(
            f"{name} pairs source and target vertex by vertex (training.network.variant 'origin'), but {where} has a "
            f"source of {source:,} vertices and a target of {target:,}. Evaluate it on a dataset of one vertex count, "
            "or train the variant maxpool: --set training.network.variant=maxpool"
        )


@dataclass(frozen=True)
class _Piece:
    """One method on one chunk of one list; ``file``: what its rows are kept as."""

    contender: Contender
    pose_type: PoseType
    start: int
    stop: int
    file: str

    @property
    def triples(self) -> list[tuple[str, int]]:
        return [(self.pose_type, number) for number in range(self.start, self.stop)]

    @property
    def expected(self) -> list[tuple[str, str, int]]:
        return [(self.contender.name, *triple) for triple in self.triples]


def _contenders(methods: Sequence[Method], dataset: Dataset, recipe: EvaluationRecipe) -> list[Contender]:
    require_distinct([*(method.name for method in methods), *CONTROLS])
    if not any(len(evaluation_list(dataset, recipe, pose_type)) for pose_type in POSE_TYPES):
        raise EvaluationError(
            f"{dataset.url} lists no evaluation triples. Make a dataset that does: --set data.triples.count=400, with "
            "evaluation identities and at least two poses of a type"
        )
    return [*(_resolved(method, dataset, recipe) for method in methods), *(Contender(name, "") for name in CONTROLS)]


def _resolved(method: Method, dataset: Dataset, recipe: EvaluationRecipe) -> Contender:
    checkpoint = require_checkpoint(Path(method.weights), "result", weights_only=True)
    network = recipe_of(checkpoint, network_only=True).network
    for pose_type in POSE_TYPES:
        for number, triple in enumerate(evaluation_list(dataset, recipe, pose_type)):
            counts = dataset.vertex_count(int(triple[0])), dataset.vertex_count(int(triple[2]))
            require_pairable(method.name, network, *counts, where=f"{pose_type} triple {number} of {dataset.url}")
    if not method.projected_by:
        return Contender(method.name, str(checkpoint.path), "", fingerprint_of(checkpoint))
    parts = require_checkpoint(Path(method.projected_by), "result", weights_only=True)
    weights = fingerprint_of(checkpoint) + fingerprint_of(parts)
    return Contender(method.name, str(checkpoint.path), str(parts.path), weights)


def fingerprint_of(checkpoint: Checkpoint) -> str:
    """What tells weights from all others, wherever they lie: a hash of their network's recipe and of their files."""
    network = recipe_of(checkpoint, network_only=True).network
    return _digest({"network": network.model_dump(mode="json"), "files": _hashes(checkpoint.path)})


def _hashes(weights: Path) -> dict[str, str]:
    if weights.is_dir():
        return {name: digest for name, digest in manifest_of(weights)["sha256"].items() if name in (WEIGHTS, AVERAGE)}
    return {WEIGHTS: sha256_of(weights)}


def _pieces(dataset: Dataset, contenders: Sequence[Contender], recipe: EvaluationRecipe) -> list[_Piece]:
    pieces = []
    for pose_type in POSE_TYPES:
        listed = evaluation_list(dataset, recipe, pose_type)
        unable = [name for name, is_able in _CAN_STAND.items() if not is_able(dataset, listed)]
        able = [method for method in contenders if method.name not in unable]
        for start in range(0, len(listed), recipe.chunk):
            triples = listed[start : start + recipe.chunk]
            pieces += [_piece(dataset, method, recipe, pose_type, start, triples) for method in able]
    return pieces


def _piece(
    dataset: Dataset, contender: Contender, recipe: EvaluationRecipe, pose_type: PoseType, start: int, triples: Any
) -> _Piece:
    about = {
        "measured_as": [_MEASURED_AS, *(field.name for field in fields(Row))],
        "method": [contender.name, contender.sha256],
        "dataset": [dataset.uuid, dataset.attributes["manifest_sha256"]],
        "triples": [pose_type, start, triples.tolist()],
        "earth_mover": [recipe.emd_points, recipe.seed],
    }
    return _Piece(contender, pose_type, start, start + len(triples), piece_name(pose_type, start, _digest(about)))


def _digest(about: Any) -> str:
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:32]


def _by_chunk(pieces: Iterable[_Piece]) -> dict[tuple[PoseType, int], list[_Piece]]:
    chunks: dict[tuple[PoseType, int], list[_Piece]] = {}
    for piece in pieces:
        chunks.setdefault((piece.pose_type, piece.start), []).append(piece)
    return chunks


def _chunk_of(rows: list[Row]) -> Any:
    return rows[0].pose_type, min(row.triple for row in rows)


def _one_count(dataset: Dataset, triples: NDArray[np.integer]) -> bool:
    """Whether all sources and targets of a list have as many vertices, so that a source can stand for an output."""
    identities = np.unique(triples[:, [0, 2]]).tolist()
    return len({dataset.vertex_count(identity) for identity in identities}) == 1


def _are_dressed(dataset: Dataset, triples: NDArray[np.integer]) -> bool:
    """Whether a target of a list has garments, and all have rigs, so that skinning alone can stand for an output."""
    targets = np.unique(triples[:, 2]).tolist()
    return any(dataset.part(its) is not None for its in targets) and all(dataset.rig(its) for its in targets)


_CAN_STAND = {NO_OPS[1]: _one_count, SKINNED: _are_dressed}
"""Controls that not every list has."""
