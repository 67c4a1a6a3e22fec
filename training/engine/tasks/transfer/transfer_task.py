"""Pose transfer as the trainer sees it: triples, of each network its own objective, PMD on fixed ones."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import torch
from torch import nn

from datagen.store import Dataset
from training.data.augmentation.augment import Augmentation
from training.data.cache_policy import Room
from training.data.rigs.bodies_at_rest import BodiesAtRest, require_rigs
from training.data.rigs.posed_bodies import PosedBodies
from training.data.rigs.rig_table import RigTable
from training.data.triples import TripleOrder, order_of
from training.data.vertex_bank import VertexBank, open_bank
from training.engine.distributed import Ranks, agreed
from training.engine.tasks.protocol import Shares
from training.engine.tasks.transfer.objective import PartsObjective, TransferObjective
from training.engine.tasks.transfer.step_memory import require_step_memory
from training.engine.tasks.transfer.validation import TransferValidation, require_measurable
from training.networks import network_from
from training.networks.parts import Parts
from training.recipes.networks import PartsRecipe
from training.recipes.training import TrainingRecipe


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
        """See :func:`require_measurable`, :func:`require_step_memory`; rigs that are needed must be there."""
        if self._needs_rigs:
            require_rigs(self._dataset, self._dataset.identities("training"))  # before all meshes are decoded
        require_measurable(self._dataset, self._recipe)
        require_step_memory(self._recipe, self._dataset, room, ranks=ranks)

    def network(self) -> nn.Module:
        """See :func:`training.networks.network_from`."""
        return network_from(self._recipe.network)

    def objective(self, network: nn.Module, device: torch.device) -> nn.Module:
        """See :class:`PartsObjective`, :class:`TransferObjective`."""
        if isinstance(network, Parts):
            return PartsObjective(network, at_rest=self._recipe.augmentation.at_rest)
        return TransferObjective(network, self._recipe, device)

    @contextmanager
    def feed(self, ranks: Ranks, device: torch.device) -> Iterator["TripleFeed"]:
        """The training meshes, decoded, and the rigs where a network learns from them or poses are recombined."""
        with closing(agreed(ranks, lambda: self._bank(ranks, device), what="open the training meshes")) as bank:
            augment = agreed(ranks, lambda: self._augmentation(device), what="read the rigs")
            yield TripleFeed(self.order, bank, augment, ranks, self._recipe.accumulate)

    def validation(self, device: torch.device, dtype: torch.dtype) -> "TransferValidation":
        """Measures PMD on some of the dataset's evaluation triples."""
        return TransferValidation(self._dataset, self._recipe, device, dtype)

    def _bank(self, ranks: Ranks, device: torch.device) -> VertexBank:
        recipe, identities = self._recipe, self._dataset.identities("training")
        placed: dict[str, Any] = {"device": device, "cache": recipe.cache, "sharers": ranks.here}
        placed["block"] = self.order.memory(rank=ranks.rank, ranks=ranks.count)
        return open_bank(self._dataset, identities, edge_sum=recipe.edge_sum, **placed)

    @property
    def _needs_rigs(self) -> bool:
        return isinstance(self._recipe.network, PartsRecipe) or self._recipe.augmentation.recombined > 0

    def _augmentation(self, device: torch.device) -> Augmentation:
        """With what a network learns from beside vertices, and by which poses are recombined, where the recipe says."""
        recipe, dataset = self._recipe, self._dataset
        if not self._needs_rigs:
            return Augmentation(recipe)
        bodies = BodiesAtRest(dataset, dataset.identities("training"))
        rigs = (
            RigTable(bodies, recipe.network.joints, device=device) if isinstance(recipe.network, PartsRecipe) else None
        )
        posed = PosedBodies(bodies, device=device) if recipe.augmentation.recombined else None
        return Augmentation(recipe, rigs, posed)


class TripleFeed:
    """This rank's share of every step's triples, in parts, and their meshes on the device."""

    def __init__(self, order: TripleOrder, bank: VertexBank, augment: Augmentation, ranks: Ranks, parts: int) -> None:
        self._order, self._bank, self.where = order, bank, bank.where
        self._augment = augment
        self._mine = {"rank": ranks.rank, "ranks": ranks.count, "parts": parts}

    def batches(self, first_step: int) -> Shares:
        """See :class:`training.engine.tasks.protocol.Feed`."""
        places, mine = self._order.places(**self._mine), self._order.batches(first_step=first_step, **self._mine)
        for step, share in enumerate(self._bank.prefetch(mine), first_step):
            parts = zip(share, places, strict=True)
            yield (
                share,
                [self._augment(part, self._bank.batch(part), step=step, first=first) for part, first in parts],
            )
