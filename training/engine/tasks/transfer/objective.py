"""What a step computes, by kind of network: what of a batch of triples the network is given, and its losses."""

import torch
from torch import Tensor, nn

from training.data.augmentation.shuffle import Shuffle
from training.data.batch import Batch
from training.networks.execution import autocast, compiled
from training.networks.padded_batches import MixedCounts
from training.networks.parts import Parts
from training.objectives.losses import transfer_loss
from training.objectives.parts import parts_loss
from training.recipes.training import TrainingRecipe

Losses = dict[str, Tensor]


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

    def __init__(self, network: Parts, *, at_rest: bool = False) -> None:
        super().__init__()
        self.network, self._at_rest = network, at_rest

    def forward(self, batch: Batch, *, step: int) -> Losses:
        """Return the losses of a batch that a :class:`training.data.rigs.rig_table.RigTable` was asked about."""
        assert batch.posed is not None
        loss, parts = parts_loss(
            self.network,
            source=batch.source,
            target=batch.target,
            truth=batch.truth,
            posed=batch.posed,
            surfaces=batch.surfaces,
            at_rest=self._at_rest,
        )
        return {**parts, "total": loss}
