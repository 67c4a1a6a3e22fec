"""Pictures while training, and the curves of the adaptive coefficients."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

from datagen.store import open_dataset
from training.data.batch import Batch, read_batch
from training.engine.tasks.transfer.snapshots import draw_snapshot
from training.reports.plots.training_curve import draw_coefficients
from training.tracking.journal import Journal


class Returns(nn.Module):
    """A network that gives what it is told to."""

    def __init__(self, output: Tensor) -> None:
        super().__init__()
        self.output = output

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        return self.output[: len(source)]


@pytest.fixture
def batch(dataset: str) -> Batch:
    opened = open_dataset(dataset)
    return read_batch(opened, opened.evaluation_triples("unseen")[:3])


@pytest.fixture
def faces(dataset: str) -> np.ndarray:
    return open_dataset(dataset).faces(0)


def drawn(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), int)


def column(picture: np.ndarray, number: int) -> np.ndarray:
    """The panels of a column, without its heading."""
    left = 156 + 210 * number
    return picture[100:, left : left + 210]


def coloured(pixels: np.ndarray) -> np.ndarray:
    return (pixels.max(2) - pixels.min(2)) > 40


def test_four_columns_and_a_row_an_example(batch: Batch, faces: np.ndarray, tmp_path: Path) -> None:
    network, place = Returns(batch.truth), tmp_path / "step-00001000.png"
    path = draw_snapshot(network, batch, faces, place, "step 1,000 of $x$", examples=2)
    assert path == place
    two, three = drawn(path), drawn(draw_snapshot(network, batch, faces, tmp_path / "3.png", "three"))
    assert two.shape[1] == three.shape[1] and two.shape[0] < three.shape[0]
    assert all(coloured(column(two, number)).mean() > 0.01 for number in range(3)), "each mesh is seen, in its colour"


@pytest.mark.parametrize("value", [float("nan"), 1e30])
def test_a_broken_network_is_drawn_as_it_is(batch: Batch, faces: np.ndarray, tmp_path: Path, value: float) -> None:
    broken = batch.truth.clone()
    broken[0, 3] = value
    picture = drawn(draw_snapshot(Returns(broken), batch, faces, tmp_path / "x.png", "broken", examples=1))
    assert coloured(column(picture, 0)).mean() > 0.01
    assert coloured(column(picture, 2)).any() == np.isfinite(value)


def test_coefficients_are_drawn_a_panel_a_block(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "metrics.jsonl")
    for step in range(0, 100, 10):
        places = [f"block{b}.norm{n}" for b in (1, 2, 3, 4) for n in (1, 2)]
        names = [f"modulation/{kind}/{place}" for kind in ("alpha", "beta") for place in places]
        journal.write(step, {name: np.sin(step / 30 + place) / 5 for place, name in enumerate(names)})
    journal.write(100, {"loss/total": 1.0, "modulation/alpha/block1.norm1": float("nan")})
    journal.close()
    path = draw_coefficients(tmp_path, tmp_path / "figures" / "coefficients.png")
    assert path is not None
    picture = drawn(path)
    assert picture.shape[1] == 1600 and ((picture.max(2) - picture.min(2)) > 60).sum() > 3000


def test_no_coefficients_no_figure(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "metrics.jsonl")
    journal.write(1, {"loss/total": 1.0})
    journal.close()
    assert draw_coefficients(tmp_path, tmp_path / "c.png") is None and not (tmp_path / "c.png").exists()
    assert torch.is_grad_enabled()
