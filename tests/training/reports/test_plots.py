"""Plots show the numbers that they are given, name who is best, are written whole, and refuse what cannot be drawn."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure

from datagen.common.errors import CheckpointError
from tests.support.reports.pictures import caught, octahedron, pixels
from training.evaluation.evaluate import Row
from training.evaluation.run_curves import RunCurve
from training.reports.plots import ablation, convergence, sweep, training_curve
from training.reports.plots.ablation import ablation_figure
from training.reports.plots.convergence import convergence_figure, learning_of
from training.reports.plots.sweep import sweep_figure
from training.viz.mesh_grid import Panel, mesh_grid
from training.viz.mesh_grid import Row as Drawn
from training.viz.style import apart


def run_of(folder: Path, *, level: float, steps: int = 40) -> Path:
    """A run whose batches have PMD `level` / step, evaluated every tenth step at twice that on unseen poses."""
    folder.mkdir(parents=True)
    (folder / "recipe.yaml").write_text(yaml.safe_dump({"batch": 8, "reconstruction_weight": 1000.0}))
    lines = []
    for step in range(1, steps + 1):
        line = {"step": step, "loss/reconstruction": 3 * level / step, "meshes_per_second": 16.0}
        if step % 10 == 0:
            line |= {"evaluation/pmd_seen": level / step, "evaluation/pmd_unseen": 2 * level / step}
        lines.append(json.dumps(line) + "\n")
    (folder / "metrics.jsonl").write_text("".join(lines))
    return folder


def curve(name: str, *pmd: float, finished: bool = True) -> RunCurve:
    steps = 10.0 * np.arange(1, len(pmd) + 1)
    return RunCurve(name, steps, steps, np.array(pmd), finished)


def rows_of(method: str, pmd: float, *, pose_types: tuple[str, ...] = ("seen", "unseen"), count: int = 8) -> list[Row]:
    """Rows whose PMD is `pmd` +- a tenth, doubled on unseen poses."""
    return [
        Row(method, kind, n, 0, 0, 1, 1, *[pmd * (1 + 0.1 * (-1) ** n) * (1 + (kind == "unseen"))] * 8)
        for kind in pose_types
        for n in range(count)
    ]


def journal(count: int = 200) -> list[dict[str, float]]:
    """Losses and a learning rate every fifth step, evaluations every hundredth; one NaN, one zero, one gap."""
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


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    return caught(monkeypatch, ablation, convergence, sweep, training_curve)


def texts(figure: Figure, panel: int = 0, **style: Any) -> list[str]:
    """The words in a panel and at its sides, those of a weight alone if asked."""
    found = [text for text in figure.axes[panel].texts if text.get_text()]
    return [text.get_text() for text in found if style.get("weight", text.get_weight()) == text.get_weight()]


@pytest.mark.parametrize("heights", [[0.1, 0.1, 0.1], [0.0, 0.5, 0.51, 0.52, 0.9], [0.0, 0.001], [0.7]])
def test_heights_are_moved_apart_in_their_order_and_stay_where_there_is_room(heights: list[float]) -> None:
    placed = apart(np.array(heights), 0.05, least=0.0)
    assert (np.diff(placed) >= 0.05 - 1e-9).all() and placed[0] >= 0
    for place, height in enumerate(heights):
        if all(abs(height - other) > 0.2 for other in heights[:place] + heights[place + 1 :]):
            assert placed[place] == pytest.approx(height)


def test_lines_are_named_in_the_order_of_their_ends_and_the_best_finished_one_is_bold(drawn: list[Figure]) -> None:
    broken = curve("broken", 0.5, 0.001, finished=False)
    curves = [curve("high", 0.5, 0.4), curve("low", 0.6, 0.01), broken]
    sweep_figure(curves, "unused.png", level=("twice", 0.2))
    for panel in (0, 1):
        assert texts(drawn[0], panel) == ["twice", "10.0  broken (unfinished)", "100.0  low", "4000.0  high"]
        assert texts(drawn[0], panel, weight="bold") == ["100.0  low"]
    thick = max(drawn[0].axes[0].get_lines(), key=lambda line: line.get_linewidth())
    assert np.asarray(thick.get_ydata()) == pytest.approx([6000, 100])
    sweep_figure(curves, "unused.png", level=("far above", 3.0))
    assert "far above" not in texts(drawn[1], 0)


@pytest.mark.parametrize("steps", [4.0, 10.0, 20_000.0])
def test_numbers_along_steps_and_seconds_are_true(drawn: list[Figure], steps: float) -> None:
    places = np.linspace(0, steps, 5)
    sweep_figure([RunCurve("a", places, places / 8000, np.full(5, 0.1), True)], "unused.png")
    for axes, whole in zip(drawn[0].axes, (True, False), strict=True):
        axis = axes.xaxis
        said = [axis.get_major_formatter()(place, 0) for place in axis.get_majorticklocs()]
        assert [float(word.replace(",", "")) for word in said] == pytest.approx(list(axis.get_majorticklocs()))
        assert len(set(said)) > 2 and (not whole or not any("." in word for word in said))


def test_many_runs_with_one_end_have_names_that_do_not_overlap(drawn: list[Figure]) -> None:
    sweep_figure([curve(f"trial-{i}", 0.5, 0.1) for i in range(20)], "unused.png")
    axes = drawn[0].axes[0]
    heights = sorted(text.get_position()[1] for text in axes.texts if text.get_text())
    points = np.diff(heights) * axes.get_window_extent().height / drawn[0].dpi * 72
    assert len(heights) == 20 and points.min() > 7, "a line of seven-point letters"


def test_pmd_of_training_is_a_third_of_the_unweighted_reconstruction_loss(tmp_path: Path) -> None:
    learned = learning_of("ours", run_of(tmp_path / "run", level=0.01))
    assert learned.training.pmd == pytest.approx(0.01 / np.arange(1, 41))
    assert learned.unseen.pmd == pytest.approx(0.02 / np.array([10, 20, 30, 40]))
    assert learned.unseen.seconds == pytest.approx([5, 10, 15, 20]), "8 triples a step at 16 a second"


def test_methods_end_at_their_pmd_on_unseen_poses_or_of_training_where_none_was_evaluated(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    runs = {name: run_of(tmp_path / name, level=level) for name, level in (("NPT", 0.04), ("DSFFNet", 0.01))}
    convergence_figure(runs, "unused.png")
    for panel in (0, 1):
        assert texts(drawn[0], panel) == ["5  DSFFNet", "20  NPT"]
        assert sorted(len(np.asarray(line.get_xdata())) for line in drawn[0].axes[panel].get_lines())[-2:] == [40, 40]
    with open(run_of(tmp_path / "short", level=0.01, steps=9) / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"step": 10, "loss/reconstruction": float("nan"), "meshes_per_second": 16.0}) + "\n")
    convergence_figure({"ours": tmp_path / "short"}, "unused.png")
    assert texts(drawn[1]) == ["11.1  ours"]


def test_each_method_has_a_dot_its_value_and_its_ratio_to_the_full_network(drawn: list[Figure]) -> None:
    ablation_figure([*rows_of("w/o L_edge", 0.006), *rows_of("DSFFNet", 0.002)], "unused.png")
    assert texts(drawn[0]) == ["20", "60  ×3.00", "40", "120  ×3.00", "DSFFNet", "w/o L_edge"]
    dots: list[Any] = [line for line in drawn[0].axes[0].get_lines() if line.get_marker() == "o"]
    assert sorted(round(float(line.get_xdata()[0])) for line in dots) == [20, 40, 60, 120]
    ablation_figure(rows_of("$x_{", 0.002, pose_types=("seen",)), "unused.png")
    assert texts(drawn[1]) == ["20", "$x_{"], "neither a reference nor another pose type is needed"


def test_a_training_curve_has_terms_evaluations_rate_and_baselines(drawn: list[Figure]) -> None:
    baselines = {"target unchanged": 0.3, "unknown": float("nan")}
    training_curve.training_curve(journal(), "unused.png", baselines=baselines)
    loss, evaluation, rate = drawn[0].axes
    assert loss.get_legend_handles_labels()[1] == ["total", "edge"]
    assert evaluation.get_legend_handles_labels()[1] == ["seen", "unseen"]
    assert loss.get_yscale() == evaluation.get_yscale() == "log" and rate.get_yscale() == "linear"
    total = np.asarray(loss.get_lines()[0].get_ydata())
    assert len(total) == 198 and np.isfinite(total).all(), "the NaN and the zero are left out"
    assert texts(drawn[0], 1) == ["target unchanged"] and evaluation.get_ylim()[1] > 0.3


def test_a_page_shows_every_mesh_on_one_scale(tmp_path: Path) -> None:
    big, small = octahedron(1.0), octahedron(0.5)
    rows = [Drawn(label, [Panel(mesh, (0.2, 0.4, 0.8))] * 2) for label, mesh in (("a", big), ("b", small))]
    picture = pixels(mesh_grid(rows, tmp_path / "page.png", columns=["p", "q"], title="t", size=(90, 100)))
    cells = [picture[96 + 126 * r : 196 + 126 * r, 156 + 90 * c : 246 + 90 * c] for r in (0, 1) for c in (0, 1)]
    widths = [int((np.ptp(cell, axis=-1) > 40).any(0).sum()) for cell in cells]
    assert widths[0] == widths[1] and widths[2] == widths[3] == pytest.approx(widths[0] / 2, abs=4)


def only(*keys: str) -> list[dict[str, float]]:
    return [{key: value for key, value in row.items() if key in ("step", *keys)} for row in journal(30)]


@pytest.mark.parametrize(
    "draw",
    [
        lambda path: training_curve.training_curve(only("loss/total"), path),
        lambda path: training_curve.training_curve(only("learning_rate", "evaluation/pmd_seen"), path),
        lambda path: sweep_figure([curve("$x_{", 0.0, 0.1, float("inf"), 0.05), curve("b")], path),
        lambda path: convergence_figure({"$x_{": run_of(path.parent.parent / "run", level=0.01)}, path),
        lambda path: ablation_figure(rows_of("DSFFNet", 0.002), path),
    ],
)
def test_plots_are_written_whole_and_leave_nothing_else(tmp_path: Path, draw: Callable[[Path], Path]) -> None:
    path = draw(tmp_path / "figures" / "plot.png")
    assert pixels(path).shape[1] > 1000 and pixels(path).std() > 5
    assert [file.name for file in path.parent.iterdir()] == ["plot.png"]


@pytest.mark.parametrize(
    ("draw", "error", "says"),
    [
        (lambda path: sweep_figure([curve("a"), curve("b", 0.0, float("nan"))], path), ValueError, "no run has a PMD"),
        (lambda path: convergence_figure({}, path), ValueError, "none was given"),
        (
            lambda path: convergence_figure({"a": run_of(path.parent / "zero", level=0.0)}, path),
            ValueError,
            "no run has",
        ),
        (
            lambda path: convergence_figure({"ours": path.parent / "nowhere"}, path),
            CheckpointError,
            r"nowhere \(ours\) is no folder of a run",
        ),
        (lambda path: ablation_figure([], path), ValueError, "at least one row"),
        (lambda path: ablation_figure(rows_of("a", float("nan")), path), ValueError, "pmd of a on seen poses must be"),
        (
            lambda path: training_curve.training_curve([{"step": 1, "loss/total": np.nan}], path),
            ValueError,
            "no finite",
        ),
        (
            lambda path: mesh_grid([Drawn("a", ["none", "none"])], path, columns=["p"], title="t"),
            ValueError,
            r"need rows of at most 1 panels, got \[2\]",
        ),
    ],
)
def test_what_cannot_be_drawn_is_refused(
    tmp_path: Path, draw: Callable[[Path], Path], error: type[Exception], says: str
) -> None:
    with pytest.raises(error, match=says):
        draw(tmp_path / "figure.png")
    assert not (tmp_path / "figure.png").exists()


def test_smoothing_keeps_a_constant_and_the_middle_of_a_power_law() -> None:
    assert training_curve.smooth(np.full(100, 0.3)) == pytest.approx(0.3)
    falling = np.exp(-np.arange(200) / 40)
    assert training_curve.smooth(falling)[50] == pytest.approx(falling[50])
