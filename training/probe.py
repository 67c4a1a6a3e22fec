"""Looking at a network while it trains: PMD on a fixed subset, the best so far, patience, pictures; rank 0 alone."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from datagen.store import Dataset
from training.batches import Batch, read_batch
from training.inference import predict
from training.journal import coefficient_metrics
from training.metrics import point_mesh_distance
from training.recipe import TrainingRecipe
from training.snapshots import draw_snapshot


@dataclass(frozen=True)
class Verdict:
    """What an evaluation means for the run: the best PMD so far, evaluations since then, whether this was it."""

    best: float = float("inf")
    since: int = 0
    improved: bool = False

    def after(self, pmd: float) -> "Verdict":
        """The verdict after one more evaluation."""
        return Verdict(pmd, 0, True) if pmd < self.best else Verdict(self.best, self.since + 1, False)

    def gives_up(self, patience: int | None) -> bool:
        """Whether the best is so old that training ends (early stopping)."""
        return patience is not None and self.since >= patience

    def state(self) -> dict[str, Any]:
        return asdict(self)


class Probe:
    """Metrics and pictures of fixed triples of a dataset's evaluation lists, so that curves of a run are comparable.

    PMD is :func:`training.metrics.point_mesh_distance`, the mean over ``recipe.evaluate_triples`` of each pose type;
    ``evaluation/pmd_unseen`` decides which checkpoint is best (``pmd_seen`` where no unseen poses are listed).
    """

    def __init__(self, dataset: Dataset, recipe: TrainingRecipe, device: torch.device, dtype: torch.dtype) -> None:
        self._batches: dict[str, Batch] = {}
        for pose_type in ("seen", "unseen"):
            triples = dataset.evaluation_triples(pose_type)[: recipe.evaluate_triples]
            if len(triples):
                self._batches[pose_type] = read_batch(dataset, triples, padded=True).in_dtype(dtype).to(device)
                self._faces = dataset.faces(triples[0, 2])

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
        batch = list(self._batches.values())[-1]
        if isinstance(batch.edges, Tensor):
            draw_snapshot(network, batch, self._faces, path, title)


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
    with torch.no_grad():
        yield
    network.train()
