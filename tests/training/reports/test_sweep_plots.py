"""Curves of several runs: time from the journal itself, names that never overlap, the best one highlighted."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from training.evaluation.run_curves import RunCurve, run_curve
from training.reports.plots import sweep as sweep_figures
from training.reports.plots.sweep import spread, sweep_figure

UNSEEN = "evaluation/pmd_unseen"


def curve(name: str, *pmd: float, seconds: float = 1.0, finished: bool = True) -> RunCurve:
    steps = 10.0 * np.arange(1, len(pmd) + 1)
    return RunCurve(name, steps, seconds * steps, np.array(pmd), finished)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    made: list[Figure] = []

    def keep(figure: Figure, path: str) -> Path:
        made.append(figure)
        return Path(path)

    monkeypatch.setattr(sweep_figures, "saved", keep)
    return made


def names(figure: Figure, panel: int = 0) -> list[str]:
    """The names beside a panel, from the top down."""
    texts = [text for text in figure.axes[panel].texts if text.get_transform() == figure.axes[panel].transAxes]
    return [text.get_text() for text in sorted(texts, key=lambda text: -text.get_position()[1])]


def test_seconds_come_from_the_throughput_so_that_a_pause_between_commands_does_not_count() -> None:
    rows = [
        {"step": 10, "time": 100.0, "meshes_per_second": 40.0},
        {"step": 20, "time": 102.0, "meshes_per_second": 40.0, UNSEEN: 0.3},
        {"step": 30, "time": 9000.0, "meshes_per_second": 80.0, UNSEEN: float("nan")},
        {"step": 40, "time": 9001.0, "meshes_per_second": 80.0, UNSEEN: 0.2},
    ]
    found = run_curve(rows, UNSEEN, batch=8, name="a")
    assert found.steps.tolist() == [20, 40] and found.pmd.tolist() == [0.3, 0.2]
    assert found.seconds == pytest.approx([4.0, 6.0])
    assert len(run_curve([], UNSEEN, batch=8)) == 0


def test_the_first_evaluation_at_a_level_or_below() -> None:
    found = curve("a", 0.5, 0.2, 0.4, 0.1, seconds=2.0)
    assert found.first_reached(0.2) == (20.0, 40.0) and found.first_reached(0.05) is None
    assert found.final == 0.1 and curve("b").final == float("inf")


@pytest.mark.parametrize("heights", [[0.1, 0.1, 0.1], [0.0, 0.5, 0.51, 0.52, 0.9], [0.0, 0.001], [0.7]])
def test_spread_keeps_order_and_a_gap_and_moves_nothing_that_has_room(heights: list[float]) -> None:
    placed = spread(np.array(heights), 0.05)
    assert (np.diff(placed) >= 0.05 - 1e-9).all() and placed[0] >= 0
    for place, height in enumerate(heights):
        if all(abs(height - other) > 0.2 for other in heights[:place] + heights[place + 1 :]):
            assert placed[place] == pytest.approx(height)


def test_lines_are_named_in_the_order_of_their_ends_and_the_lowest_is_bold(drawn: list[Figure]) -> None:
    sweep_figure([curve("high", 0.5, 0.4), curve("low", 0.6, 0.01), curve("middle", 0.5, 0.3)], "unused.png")
    (figure,) = drawn
    for panel in (0, 1):
        assert names(figure, panel) == ["4000.0  high", "3000.0  middle", "100.0  low"]
        bold = [text.get_text() for text in figure.axes[panel].texts if text.get_weight() == "bold"]
        assert bold == ["100.0  low"] and figure.axes[panel].get_yscale() == "log"
    thick = max(figure.axes[0].get_lines(), key=lambda line: line.get_linewidth())
    assert np.asarray(thick.get_ydata()) == pytest.approx([6000, 100])


def test_a_run_that_did_not_finish_is_never_the_best(drawn: list[Figure]) -> None:
    sweep_figure([curve("done", 0.5, 0.4), curve("broken", 0.5, 0.2, finished=False)], "unused.png")
    bold = [text.get_text() for text in drawn[0].axes[0].texts if text.get_weight() == "bold"]
    assert bold == ["4000.0  done"] and "2000.0  broken (unfinished)" in names(drawn[0])


def test_many_runs_with_one_end_have_names_that_do_not_overlap(drawn: list[Figure]) -> None:
    sweep_figure([curve(f"trial-{i}", 0.5, 0.1) for i in range(20)], "unused.png")
    axes = drawn[0].axes[0]
    heights = sorted(text.get_position()[1] for text in axes.texts if text.get_text())
    points = np.diff(heights) * axes.get_window_extent().height / drawn[0].dpi * 72
    assert len(heights) == 20 and points.min() > 7, "a line of seven-point letters"


def test_levels_are_drawn_unless_all_lie_below_them(drawn: list[Figure]) -> None:
    sweep_figure([curve("a", 0.5, 0.1)], "unused.png", levels={"twice": 0.2, "far above": 3.0})
    words = [text.get_text() for text in drawn[0].axes[0].texts]
    assert "twice" in words and "far above" not in words


def test_what_a_log_scale_cannot_show_is_left_out_and_nothing_at_all_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no run has a PMD"):
        sweep_figure([curve("a"), curve("b", 0.0, float("nan"))], tmp_path / "none.png")
    path = sweep_figure([curve("$x_{", 0.0, 0.1, float("inf"), 0.05), curve("b")], tmp_path / "sub" / "some.png")
    with Image.open(path) as picture:
        assert picture.width > 1000 and np.asarray(picture).std() > 5
    assert [file.name for file in path.parent.iterdir()] == ["some.png"]
