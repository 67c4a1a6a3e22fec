"""The trainer knows nothing of triples: another task is learned, stopped, resumed and shared out by the same loop."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from datagen.common.errors import CheckpointError, TrainingError
from tests.support.recipes import tiny_training
from training.checkpoints.checkpoint import require_checkpoint
from training.data.order import BatchOrder, Items
from training.engine import trainer
from training.engine.distributed import Ranks
from training.engine.tasks.protocol import Shares
from training.networks import network_from
from training.tracking.journal import read_journal


@dataclass(frozen=True)
class Clouds(BatchOrder):
    """The order of some point clouds."""

    count: int

    @property
    def cells(self) -> int:
        return self.count

    def epoch(self, number: int) -> Items:
        return np.random.default_rng((self.seed, number)).permutation(self.count)[:, None]


@dataclass(frozen=True)
class Cloud:
    points: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def in_dtype(self, dtype: torch.dtype) -> "Cloud":
        return replace(self, points=self.points.to(dtype))


class Same(nn.Module):
    """What a network of transfers makes of a cloud and itself shall be the cloud."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, batch: Cloud, *, step: int) -> dict[str, Tensor]:
        assert self.network.training and torch.is_grad_enabled()
        loss = (self.network(source=batch.points, target=batch.points) - batch.points).square().mean()
        return {"total": loss, "same": loss}


class CloudTask:
    url, sha256 = "clouds", "0" * 64

    def __init__(self, uuid: str = "clouds-1") -> None:
        self.uuid, self.order = uuid, Clouds(batch=4, seed=0, count=8)
        self.where = "nowhere"
        self.shown: list[list[int]] = []

    def check(self, room: Any, ranks: int) -> None:
        if ranks > 8:
            raise TrainingError("too many ranks")

    def network(self) -> nn.Module:
        return network_from(tiny_training().network)

    def objective(self, network: nn.Module, device: torch.device) -> nn.Module:
        return Same(network)

    @contextmanager
    def feed(self, ranks: Ranks, device: torch.device) -> Iterator["CloudTask"]:
        yield self

    def batches(self, first_step: int) -> Shares:
        points = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (8, 12, 3)).astype(np.float32))
        for parts in self.order.batches(first_step=first_step):
            self.shown.append(parts[0][:, 0].tolist())
            yield parts, [Cloud(points[its[:, 0]]) for its in parts]

    def validation(self, device: torch.device, dtype: torch.dtype) -> "CloudTask":
        return self

    def measure(self, network: nn.Module) -> dict[str, float]:
        assert not network.training and not torch.is_grad_enabled()
        return {"evaluation/size": float(sum(its.detach().square().sum() for its in network.parameters()))}

    def decisive(self, metrics: dict[str, float]) -> float:
        return metrics["evaluation/size"]

    def draw(self, network: nn.Module, path: Path, *, title: str) -> None:
        assert not network.training and not torch.is_grad_enabled()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(title)


def learned(task: CloudTask, run: Path, monkeypatch: pytest.MonkeyPatch, **changes: Any) -> int:
    monkeypatch.setattr(trainer, "task_of", lambda recipe, data: task)
    recipe = tiny_training(batch=4, **{"steps": 6, "checkpoint_every": 2, "evaluate_every": 2, **changes})
    return trainer.train(recipe, data="clouds", run=run)


def test_another_task_learns_and_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert learned(CloudTask(), tmp_path, monkeypatch, steps=40, picture_every=20, learning_rate=0.01) == 40
    rows = read_journal(tmp_path / "metrics.jsonl")
    losses = [row["loss/same"] for row in rows if "loss/same" in row]
    assert losses[-1] < losses[0] and any("evaluation/size" in row for row in rows)
    assert (tmp_path / "pictures" / "step-00000020.png").read_text() == "step 20"


def test_a_stopped_one_goes_on_to_the_same_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, halves = CloudTask(), CloudTask()
    learned(whole, tmp_path / "whole", monkeypatch)
    (tmp_path / "parts").mkdir()
    real = Same.forward

    def told(self: Same, batch: Cloud, *, step: int) -> dict[str, Tensor]:
        if step == 3:
            raise KeyboardInterrupt
        return real(self, batch, step=step)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Same, "forward", told)
        learned(halves, tmp_path / "parts", patch)
    learned(halves, tmp_path / "parts", monkeypatch)
    there, here = (require_checkpoint(tmp_path / name).weights() for name in ("whole", "parts"))
    assert all(torch.equal(there[name], here[name]) for name in there)
    assert halves.shown[-4:] == whole.shown[-4:], "the order is a function of the step"


def test_it_is_resumed_on_no_other_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learned(CloudTask(), tmp_path, monkeypatch)
    with pytest.raises(CheckpointError, match="was trained on dataset clouds-1, not on clouds"):
        learned(CloudTask("clouds-2"), tmp_path, monkeypatch)
