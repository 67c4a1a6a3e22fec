"""The contact sheet shows every cell on one scale; training curves bear gaps."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from datagen.common.arrays import Floats, Integers
from training.reports.plots import training_curve as curves
from training.reports.plots.training_curve import training_curve
from training.viz.mesh_grid import contact_sheet


@dataclass
class Solid:
    vertices: Floats
    faces: Integers


def octahedron(scale: float = 1.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Solid:
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    signs = [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    return Solid(scale * points + shift, np.array(signs))


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def journal(count: int = 200) -> list[dict[str, float]]:
    rows: list[dict[str, float]] = []
    for step in range(0, 5 * count, 5):
        row = {"step": step, "loss/total": 1 / (1 + step), "loss/edge": 0.1 / (1 + step), "learning_rate": 1e-3}
        if step % 100 == 0:
            row |= {"evaluation/pmd_seen": 0.1 / (1 + step), "evaluation/pmd_unseen": 0.2 / (1 + step)}
        rows.append(row)
    rows[3]["loss/total"] = float("nan")
    rows[4]["loss/total"] = 0.0
    del rows[5]["loss/edge"]
    return rows


def drawn_axes(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    made: list[Figure] = []

    def keep(figure: Figure, path: str) -> Path:
        made.append(figure)
        return Path(path)

    monkeypatch.setattr(curves, "saved", keep)
    return made


def test_training_curve_draws_terms_evaluations_rate_and_baselines(monkeypatch: pytest.MonkeyPatch) -> None:
    made = drawn_axes(monkeypatch)
    training_curve(journal(), "unused.png", baselines={"target unchanged": 0.3, "unknown": float("nan")})
    loss, evaluation, rate = made[0].axes
    assert loss.get_legend_handles_labels()[1] == ["total", "edge"]
    assert evaluation.get_legend_handles_labels()[1] == ["seen", "unseen"]
    assert loss.get_yscale() == evaluation.get_yscale() == "log" and rate.get_yscale() == "linear"
    total = np.asarray(loss.get_lines()[0].get_ydata())
    assert len(total) == 198 and np.isfinite(total).all(), "the NaN and the zero are left out"
    assert [text.get_text() for text in evaluation.texts] == ["target unchanged"]
    assert evaluation.get_ylim()[1] > 0.3


@pytest.mark.parametrize("keys", [("loss/total",), ("evaluation/pmd_seen",), ("learning_rate", "loss/edge")])
def test_training_curve_bears_missing_terms(keys: tuple[str, ...], tmp_path: Path) -> None:
    rows = [{key: value for key, value in row.items() if key in ("step", *keys)} for row in journal(30)]
    picture = pixels(training_curve(rows, tmp_path / "sub" / "curve.png"))
    assert picture.shape[1] == 1600 and picture.std() > 5


def test_training_curve_without_any_value_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no finite loss"):
        training_curve([{"step": 1, "loss/total": float("nan")}], tmp_path / "curve.png")


def test_smoothing_keeps_a_constant_and_the_middle_of_a_power_law() -> None:
    assert curves._smooth(np.full(100, 0.3)) == pytest.approx(0.3)
    falling = np.exp(-np.arange(200) / 40)
    assert curves._smooth(falling)[50] == pytest.approx(falling[50])


def test_contact_sheet_shows_every_cell_on_one_scale(tmp_path: Path) -> None:
    big, small = octahedron(1.0), octahedron(0.5)
    grid = [[big.vertices, big.vertices + 9.0], [small.vertices, small.vertices]]
    path = contact_sheet(grid, [big.faces] * 2, ["a", "b"], ["p", "q"], tmp_path / "sheet.png", panel=(90, 100))
    picture = pixels(path)
    cells = [picture[70 + 100 * r : 170 + 100 * r, 70 + 90 * c : 160 + 90 * c] for r in (0, 1) for c in (0, 1)]
    widths = [int((np.ptp(cell, axis=-1) > 40).any(0).sum()) for cell in cells]
    assert widths[0] == widths[1] and widths[2] == widths[3]
    assert widths[2] == pytest.approx(widths[0] / 2, abs=4)


def test_contact_sheet_refuses_a_ragged_grid(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="differ in length"):
        contact_sheet([[octahedron().vertices]], [octahedron().faces], ["a"], ["p", "q"], tmp_path / "sheet.png")
