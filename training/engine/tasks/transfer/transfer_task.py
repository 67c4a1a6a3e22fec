"""Pose transfer as the trainer sees it: triples of a dataset, of each network its own objective, PMD on fixed triples.

What a step takes at least is known before any memory is taken, and a recipe that no memory could hold is refused: Linux
grants memory that it does not have and kills who uses it, so that most of what is too large would end without a word.
"""

import logging
import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from datagen.common.arrays import Integers
from datagen.common.errors import DatasetError, RecipeError
from datagen.common.resources import bytes_text
from datagen.store import Dataset
from training.data.augmentation import Augmentation, Shuffle, Supervise
from training.data.batch import Batch, read_batch
from training.data.cache_policy import Room
from training.data.order import TripleOrder, Triples, order_of
from training.data.rig_table import RigTable
from training.data.vertex_bank import VertexBank, open_bank
from training.engine.distributed import Ranks, agreed
from training.engine.tasks.protocol import Shares
from training.engine.tasks.transfer.snapshots import draw_snapshot
from training.inference.predict import predict
from training.networks import network_from
from training.networks.execution import autocast, compiled
from training.networks.padded_batches import MixedCounts
from training.networks.parts import Parts
from training.objectives.losses import transfer_loss
from training.objectives.metrics import point_mesh_distance
from training.objectives.parts import parts_loss
from training.recipes.training import NetworkRecipe, PartsRecipe, TrainingRecipe
from training.tracking.journal import coefficient_metrics

log = logging.getLogger(__name__)
Losses = dict[str, Tensor]
_PARAMETER = 16
"""Bytes of a parameter: itself, its gradient, the optimiser's two means."""
_ACTIVATIONS = 3 * 4
"""Bytes a vertex and channel that a step holds; measured: DSFFNet 3.1 to 5.6 float32, NPT 10 to 12, 3D-CoreNet 20."""
_NARROW = 2_048
"""Networks of no wider layers fit anywhere; to count the parameters of others exactly takes seconds."""


class TransferTask:
    """See :class:`training.engine.tasks.protocol.Task`.

    Parameters
    ----------
    recipe
        What to train and how.
    dataset
        A complete one.
    """

    def __init__(self, recipe: TrainingRecipe, dataset: Dataset) -> None:
        self._recipe, self._dataset = recipe, dataset
        self.url, self.uuid = dataset.url, dataset.uuid
        self.sha256: str = dataset.attributes["manifest_sha256"]

    @property
    def order(self) -> TripleOrder:
        """Of its triples (DatasetError where there are too few)."""
        return order_of(self._recipe, self._dataset)

    def check(self, room: Room, ranks: int) -> None:
        """See :func:`require_measurable`, :func:`require_step_memory`."""
        require_measurable(self._dataset, self._recipe)
        require_step_memory(self._recipe, self._dataset, room, ranks=ranks)

    def network(self) -> nn.Module:
        """See :func:`training.networks.network_from`."""
        return network_from(self._recipe.network)

    def objective(self, network: nn.Module, device: torch.device) -> nn.Module:
        """See :func:`objective_of`."""
        return objective_of(network, self._recipe, device)

    @contextmanager
    def feed(self, ranks: Ranks, device: torch.device) -> Iterator["TripleFeed"]:
        """The training meshes, decoded, and the rigs of the bodies where a network learns from these."""
        recipe, dataset = self._recipe, self._dataset
        with closing(agreed(ranks, lambda: self._bank(ranks, device), what="open the training meshes")) as bank:
            supervise = agreed(ranks, lambda: supervision_of(recipe, dataset, device), what="read the rigs")
            yield TripleFeed(recipe, self.order, bank, supervise, ranks)

    def validation(self, device: torch.device, dtype: torch.dtype) -> "TransferValidation":
        """Measures PMD on some of the dataset's evaluation triples."""
        return TransferValidation(self._dataset, self._recipe, device, dtype)

    def _bank(self, ranks: Ranks, device: torch.device) -> VertexBank:
        recipe, identities = self._recipe, self._dataset.identities("training")
        placed: dict[str, Any] = {"device": device, "cache": recipe.cache, "sharers": ranks.here}
        return open_bank(self._dataset, identities, edge_sum=recipe.edge_sum, **placed)


class TripleFeed:
    """This rank's share of every step's triples, in parts, and their meshes on the device."""

    def __init__(
        self, recipe: TrainingRecipe, order: TripleOrder, bank: VertexBank, supervise: Supervise, ranks: Ranks
    ) -> None:
        self._order, self._bank, self.where = order, bank, bank.where
        self._augment = Augmentation(recipe, supervise)
        self._mine = {"rank": ranks.rank, "ranks": ranks.count, "parts": recipe.accumulate}

    def batches(self, first_step: int) -> Shares:
        """See :class:`training.engine.tasks.protocol.Feed`."""
        places, mine = self._order.places(**self._mine), self._order.batches(first_step=first_step, **self._mine)
        for step, share in enumerate(self._bank.prefetch(mine), first_step):
            parts = zip(share, places, strict=True)
            yield (
                share,
                [self._augment(part, self._bank.batch(part), step=step, first=first) for part, first in parts],
            )


class TransferValidation:
    """Metrics and pictures of fixed triples of a dataset's evaluation lists, so that curves of a run are comparable.

    PMD is :func:`training.objectives.metrics.point_mesh_distance`, the mean over ``recipe.evaluate_triples`` of each
    pose type;
    ``evaluation/pmd_unseen`` decides which checkpoint is best (``pmd_seen`` where no unseen poses are listed).
    """

    def __init__(self, dataset: Dataset, recipe: TrainingRecipe, device: torch.device, dtype: torch.dtype) -> None:
        self._batches: dict[str, Batch] = {}
        self._faces: Integers | None = None
        for pose_type in ("seen", "unseen"):
            triples = dataset.evaluation_triples(pose_type)[: recipe.evaluate_triples]
            if len(triples):
                batch = read_batch(dataset, triples, padded=True, surfaces=isinstance(recipe.network, PartsRecipe))
                self._batches[pose_type] = batch.in_dtype(dtype).to(device)
                self._faces = _common_faces(dataset, triples)
        if recipe.picture_every and self._faces is None:
            log.info("no pictures while training: the evaluation triples are none, or of several topologies")

    def measure(self, network: nn.Module) -> dict[str, float]:
        """``evaluation/pmd_seen``, ``evaluation/pmd_unseen`` and, where there are, the adaptive coefficients."""
        found = {}
        with _evaluating(network):
            for pose_type, batch in self._batches.items():
                prediction = predict(network, batch)
                found[f"evaluation/pmd_{pose_type}"] = float(_pmd(prediction, batch).mean())
        return found | coefficient_metrics(network)

    def decisive(self, metrics: dict[str, float]) -> float:
        """The PMD that decides which weights are best."""
        return metrics.get("evaluation/pmd_unseen", metrics.get("evaluation/pmd_seen", float("inf")))

    def draw(self, network: nn.Module, path: Path, *, title: str) -> None:
        """A picture of a few fixed transfers, of unseen poses where there are; bodies of one topology only."""
        if self._faces is not None:
            draw_snapshot(network, list(self._batches.values())[-1], self._faces, path, title)


def require_measurable(dataset: Dataset, recipe: TrainingRecipe) -> None:
    """Refuse early stopping where there is nothing to go by.

    Raises
    ------
    DatasetError
        The dataset lists no evaluation triples.
    """
    if recipe.early_stopping and not any(len(dataset.evaluation_triples(kind)) for kind in ("seen", "unseen")):
        raise DatasetError(
            f"training.early_stopping is {recipe.early_stopping}, but {dataset.url} lists no evaluation triples to go "
            "by. Use --set training.early_stopping=null, or a dataset with evaluation identities"
        )


def _common_faces(dataset: Dataset, triples: Triples) -> Integers | None:
    """Faces [f, 3] of all meshes of some triples; None where they differ."""
    first, *others = (dataset.faces(identity) for identity in sorted({*triples[:, [0, 2]].flatten().tolist()}))
    return first if all(np.array_equal(first, other) for other in others) else None


def _pmd(prediction: Tensor, batch: Batch) -> Tensor:
    """PMD of each mesh [b], over its own vertices."""
    if batch.target_counts is None:
        return point_mesh_distance(prediction, batch.truth)
    meshes = zip(prediction, batch.truth, batch.target_counts, strict=True)
    return torch.cat([point_mesh_distance(found[None, :n], truth[None, :n]) for found, truth, n in meshes])


@contextmanager
def _evaluating(network: nn.Module) -> Iterator[None]:
    """The network in evaluation mode, without gradients."""
    network.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        network.train()


class TransferObjective(nn.Module):
    """The papers' networks: the output against the truth, vertex by vertex (DSFFNet, section 3.5)."""

    def __init__(self, network: nn.Module, recipe: TrainingRecipe, device: torch.device) -> None:
        super().__init__()
        self.model = MixedCounts(compiled(network, device) if recipe.compile else network)
        self._recipe = recipe

    def forward(self, batch: Batch, *, step: int) -> Losses:
        """Return the losses of a batch; ``step`` counts those done."""
        with autocast(self._recipe.precision, batch.source.device):
            prediction = self._predict(batch, step)
        loss, parts = transfer_loss(
            prediction,
            truth=batch.truth,
            target=batch.target,
            edges=batch.edges,
            counts=batch.target_counts,
            recipe=self._recipe,
        )
        return {**parts, "total": loss}

    def _predict(self, batch: Batch, step: int) -> Tensor:
        if not self._recipe.augmentation.shuffle:
            return self._output(batch, batch.target)
        shuffle = Shuffle(batch, seed=self._recipe.seed, step=step)
        return shuffle.undone(self._output(batch, shuffle(batch.target)))

    def _output(self, batch: Batch, target: Tensor) -> Tensor:
        counts = {"source_counts": batch.source_counts, "target_counts": batch.target_counts}
        found: Tensor = self.model(source=batch.source, target=target, **counts)
        return found


class PartsObjective(nn.Module):
    """The parts network: its output against the truth, and what it reads off both meshes against their rigs."""

    def __init__(self, network: Parts) -> None:
        super().__init__()
        self.network = network

    def forward(self, batch: Batch, *, step: int) -> Losses:
        """Return the losses of a batch that a :class:`training.data.rig_table.RigTable` was asked about."""
        assert batch.posed is not None
        loss, parts = parts_loss(
            self.network,
            source=batch.source,
            target=batch.target,
            truth=batch.truth,
            posed=batch.posed,
            surfaces=batch.surfaces,
        )
        return {**parts, "total": loss}


def objective_of(network: nn.Module, recipe: TrainingRecipe, device: torch.device) -> nn.Module:
    """Return the objective that a network is trained by."""
    return PartsObjective(network) if isinstance(network, Parts) else TransferObjective(network, recipe, device)


def supervision_of(recipe: TrainingRecipe, dataset: Dataset, device: torch.device) -> Supervise:
    """Return what adds to a batch of triples what its network learns from beside vertices.

    Raises
    ------
    RecipeError
        The dataset does not tell it (:class:`training.data.rig_table.RigTable`).
    """
    if not isinstance(recipe.network, PartsRecipe):
        return lambda triples, batch: batch
    return RigTable(dataset, dataset.identities("training"), recipe.network.joints, device=device).posed


def require_step_memory(recipe: TrainingRecipe, dataset: Dataset, room: Room, *, ranks: int = 1) -> None:
    """Raise if a step of one of the ranks needs more than the room of its device.

    Raises
    ------
    RecipeError
        It does; the message names what to lower.
    """
    most = max((dataset.vertex_count(identity) for identity in dataset.identities("training")), default=0)
    most = recipe.augmentation.subset or most
    meshes = math.ceil(recipe.batch / (ranks * recipe.accumulate))
    widths = _widths(recipe.network)
    needed = least_step_bytes(recipe, most, meshes=meshes, processes=room.sharers)
    if needed > room.free:
        alone = least_step_bytes(recipe, most, meshes=1, processes=room.sharers) > room.free
        lower = "training.network's widths" if alone else "training.batch, or raise training.accumulate"
        raise RecipeError(
            f"a training step takes at least {bytes_text(needed)} ({meshes:,} meshes of {most:,} vertices at a time, "
            f"widths {', '.join(map(str, widths))}), but the {room.where} has {bytes_text(room.free)} free. "
            f"Lower {lower}"
        )


def least_step_bytes(recipe: TrainingRecipe, vertices: int, *, meshes: int, processes: int) -> float:
    """The memory that a step of so many meshes at a time takes at least, of processes that share it."""
    of_a_mesh = _ACTIVATIONS * sum(_widths(recipe.network)) * vertices
    return processes * (_PARAMETER * _parameters(recipe.network) + meshes * of_a_mesh)


def _widths(network: NetworkRecipe) -> list[int]:
    values = network.model_dump().items()
    lists = [width for name, widths in values if name.endswith("_widths") for width in widths]
    return lists + [width for name, width in values if name.endswith("width")]


def _parameters(network: NetworkRecipe) -> float:
    """How many parameters a network has; 0 of a narrow one, infinite where no computer could address them."""
    if max(_widths(network)) <= _NARROW:
        return 0
    try:
        with torch.device("meta"):
            return sum(parameter.numel() for parameter in network_from(network).parameters())
    except RuntimeError:
        return math.inf
