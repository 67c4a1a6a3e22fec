"""Figures: layout, error colours on one scale, curves that bear gaps, and files that are whole or absent."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from training import curves
from training.curves import training_curve
from training.figures import (
    ERROR_COLORS,
    ErrorScale,
    TransferExample,
    contact_sheet,
    error_colors,
    placed,
    transfer_figure,
    vertex_errors,
)
from training.rasteriser import Floats, Integers

PANEL = (120, 140)


@dataclass
class Solid:
    vertices: Floats
    faces: Integers


def octahedron(scale: float = 1.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Solid:
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    signs = [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    return Solid(scale * points + shift, np.array(signs))


def example(error: float = 0.1, title: str = "pose 1 -> identity 2") -> TransferExample:
    """Return a transfer whose output is off by `error` metres at every vertex."""
    truth = octahedron(0.8, (5, 7, -3))
    output = Solid(truth.vertices + np.array([0, error, 0]), truth.faces)
    return TransferExample(title, octahedron(), octahedron(0.8, (2, 0, 0)), output, truth, "PMD 1.0e-2")


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def panel(picture: np.ndarray, row: int, column: int) -> np.ndarray:
    top, left = 110 + 46 + row * (PANEL[1] + 46), 20 + column * PANEL[0]
    return picture[top : top + PANEL[1], left : left + PANEL[0]]


def hue(cut: np.ndarray) -> np.ndarray:
    """Return the mean colour of what is not near white or grey."""
    return cut[np.ptp(cut, axis=-1) > 40].mean(0)


def test_errors_are_distances_and_shapes_must_agree() -> None:
    assert vertex_errors(example(0.25)) == pytest.approx(0.25)
    wrong = replace(example(), truth=Solid(np.zeros((5, 3)), np.zeros((0, 3), int)))
    with pytest.raises(ValueError, match=r"output \(6, 3\) and truth \(5, 3\)"):
        vertex_errors(wrong)


def test_error_colours_grow_darker_to_the_limit_and_stay_there() -> None:
    colors = error_colors(np.linspace(0, 2, 41), limit=1.0)
    lightness = colors @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness[:21]) < 0).all() and (colors[20:] == ERROR_COLORS[-1]).all()
    assert (colors[0] == ERROR_COLORS[0]).all()


def test_roles_stand_on_the_ground_and_output_keeps_its_offset_from_the_truth() -> None:
    roles = placed(example(0.3))
    for role in ("source", "target", "truth"):
        assert roles[role][:, 1].min() == pytest.approx(0)
        assert (roles[role].min(0) + roles[role].max(0))[[0, 2]] == pytest.approx([0, 0])
    assert roles["output"] - roles["truth"] == pytest.approx(np.tile([0, 0.3, 0], (6, 1)))


def test_transfer_figure_is_sixteen_hundred_wide_by_default(tmp_path: Path) -> None:
    assert pixels(transfer_figure([example()], tmp_path / "figure.png")).shape[1] == 1600


def test_roles_have_their_colours_and_error_panels_share_one_scale(tmp_path: Path) -> None:
    rows = [example(0.001), example(0.02), example(0.04)]
    picture = pixels(transfer_figure(rows, tmp_path / "figure.png", panel=PANEL))
    source, target, output = (hue(panel(picture, 0, column)) for column in range(3))
    assert source[2] > source[0] + 50 and target[0] > target[2] + 50 and output[1] > output[0] + 40
    small, middle, large = (hue(panel(picture, row, 4)).sum() for row in range(3))
    assert small > middle + 60 > large + 120, "a larger error is darker than a smaller one in another row"
    assert np.ptp(panel(picture, 0, 3), axis=-1).max() < 40, "the truth is grey"


def test_panels_of_a_row_share_one_scale(tmp_path: Path) -> None:
    picture = pixels(transfer_figure([example(0)], tmp_path / "figure.png", panel=PANEL))
    widths = [int((panel(picture, 0, c) < 225).all(-1).any(0).sum()) for c in (0, 1, 3)]
    heights = [np.flatnonzero((np.ptp(panel(picture, 0, c), axis=-1) > 40).any(1)) for c in (0, 1)]
    assert widths[0] > 1.1 * widths[1] and abs(widths[1] - widths[2]) <= 3
    assert heights[1][-1] - heights[1][0] == pytest.approx(0.8 * (heights[0][-1] - heights[0][0]), rel=0.08)


def test_the_limit_of_the_error_scale_is_shared_and_can_be_given() -> None:
    rows = [example(0.01), example(0.05)]
    assert ErrorScale().resolved(rows) == pytest.approx(5.0)  # centimetres
    assert ErrorScale(unit="mm", factor=1000).resolved(rows) == pytest.approx(50.0)
    assert ErrorScale(limit=3.0).resolved(rows) == 3.0
    assert ErrorScale().resolved([example(0.0)]) > 0


def test_names_are_not_taken_for_mathematics(tmp_path: Path) -> None:
    transfer_figure([example(title=r"cost $x_{ \frac </script>")], tmp_path / "figure.png", panel=PANEL)


def test_nothing_to_draw_and_vertices_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one"):
        transfer_figure([], tmp_path / "figure.png")
    broken = example()
    broken.output.vertices[2] = np.nan
    with pytest.raises(ValueError, match="1 of 6 vertices of the output are not finite"):
        transfer_figure([broken], tmp_path / "figure.png")
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_figure_and_no_litter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = transfer_figure([example()], tmp_path / "figure.png", panel=PANEL)
    before = path.read_bytes()

    def full_disk(*_: object, **__: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(Figure, "savefig", full_disk)
    with pytest.raises(OSError, match="No space"):
        transfer_figure([example(0.5)], path, panel=PANEL)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


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
