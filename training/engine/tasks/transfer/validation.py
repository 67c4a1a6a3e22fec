"""What is measured of pose transfer while it learns: PMD on fixed triples of the evaluation list."""

import logging
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from datagen.common.arrays import Integers
from datagen.common.errors import DatasetError
from datagen.store import Dataset
from training.data.batch import Batch, read_batch
from training.data.triples import Triples
from training.engine.tasks.protocol import Validation
from training.engine.tasks.transfer.snapshots import draw_snapshot
from training.inference.predict import predict
from training.objectives.metrics import point_mesh_distance
from training.recipes.networks import PartsRecipe
from training.recipes.training import TrainingRecipe
from training.tracking.journal import coefficient_metrics

log = logging.getLogger(__name__)


class TransferValidation(Validation):
    """Metrics and pictures of fixed triples of a dataset's evaluation lists, so that curves of a run are comparable.

    PMD is :func:`training.objectives.metrics.point_mesh_distance`, the mean over ``recipe.evaluate_triples`` of each
    pose type;
    ``evaluation/pmd_unseen`` decides which checkpoint is best (``pmd_seen`` where no unseen poses are listed).
    """

    decides = "evaluation/pmd"

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
        found = {
            f"{self.decides}_{pose_type}": float(_pmd(predict(network, batch), batch).mean())
            for pose_type, batch in self._batches.items()
        }
        return found | coefficient_metrics(network)

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
