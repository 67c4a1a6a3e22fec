"""Figure 4 shows the journals' numbers in PMD; the ablation's figure shows means, intervals and ratios of rows."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure
from PIL import Image

from datagen.common.errors import CheckpointError
from training.evaluation.evaluate import Row
from training.reports.plots import ablation as ablation_module
from training.reports.plots import convergence as convergence_module
from training.reports.plots.ablation import ablation_figure
from training.reports.plots.convergence import convergence_figure, learning_of
from training.viz.style import METHOD_COLORS


def run_of(folder: Path, *, level: float, steps: int = 40, **more: float) -> Path:
    """A run whose batches have PMD `level` / step, evaluated every tenth step at twice that on unseen poses."""
    folder.mkdir(parents=True)
    (folder / "recipe.yaml").write_text(yaml.safe_dump({"batch": 8, "reconstruction_weight": 1000.0}))
    lines = []
    for step in range(1, steps + 1):
        line = {"step": step, "loss/reconstruction": 3 * level / step, "meshes_per_second": 16.0, **more}
        if step % 10 == 0:
            line |= {"evaluation/pmd_seen": level / step, "evaluation/pmd_unseen": 2 * level / step}
        lines.append(json.dumps(line))
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are drawn, instead of files."""
    made: list[Figure] = []
    for module in (convergence_module, ablation_module):
        monkeypatch.setattr(module, "saved", lambda figure, path: (made.append(figure), Path(path))[1])
    return made


def texts(figure: Figure, panel: int) -> list[str]:
    return [text.get_text() for text in figure.axes[panel].texts if text.get_text()]


def test_pmd_of_training_is_a_third_of_the_unweighted_reconstruction_loss(tmp_path: Path) -> None:
    learned = learning_of("ours", run_of(tmp_path / "run", level=0.01))
    assert learned.training.pmd == pytest.approx(0.01 / np.arange(1, 41))
    assert learned.unseen.pmd == pytest.approx(0.02 / np.array([10, 20, 30, 40]))
    assert learned.unseen.seconds == pytest.approx([5, 10, 15, 20]), "8 triples a step at 16 a second"


def test_both_panels_show_thin_training_and_thick_evaluation_named_at_the_end(
    tmp_path: Path, drawn: list[Figure]
) -> None:
    runs = {name: run_of(tmp_path / name, level=level) for name, level in (("NPT", 0.04), ("DSFFNet", 0.01))}
    convergence_figure(runs, "unused.png", title="bodies", baselines={"target unchanged": 0.05})
    figure = drawn[0]
    for panel in (0, 1):
        assert texts(figure, panel) == ["target unchanged", "5  DSFFNet", "20  NPT"]
        axes = figure.axes[panel]
        assert axes.get_yscale() == "log"
        curves = [line for line in axes.get_lines() if len(np.asarray(line.get_xdata())) > 2]
        widths = {line.get_color(): [] for line in curves}
        for line in curves:
            widths[line.get_color()].append((len(np.asarray(line.get_xdata())), line.get_linewidth()))
        assert set(widths) == {METHOD_COLORS["NPT"], METHOD_COLORS["DSFFNet"]}
        for found in widths.values():
            (thin,), thick = [w for n, w in found if n == 40], [w for n, w in found if n == 4]
            assert len(thick) == 2 and thin < min(thick)
    assert figure.axes[0].get_xlim()[1] > 40 > figure.axes[1].get_xlim()[1] > 20


def test_a_run_without_evaluations_shows_its_training_and_gaps_are_borne(tmp_path: Path, drawn: list[Figure]) -> None:
    folder = run_of(tmp_path / "short", level=0.01, steps=9)
    with open(folder / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"step": 10, "loss/reconstruction": float("nan"), "meshes_per_second": 16.0}) + "\n")
    convergence_figure({"ours": folder}, "unused.png")
    assert texts(drawn[0], 0) == ["11.1  ours"]


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"nowhere \(ours\) is no folder of a run"):
        convergence_figure({"ours": tmp_path / "nowhere"}, tmp_path / "figure.png")
    with pytest.raises(ValueError, match="none was given"):
        convergence_figure({}, tmp_path / "figure.png")
    with pytest.raises(ValueError, match="no run has a PMD"):
        convergence_figure({"ours": run_of(tmp_path / "zero", level=0.0)}, tmp_path / "figure.png")


def rows_of(method: str, pmd: float, *, pose_types: tuple[str, ...] = ("seen", "unseen"), count: int = 8) -> list[Row]:
    """Rows whose PMD is `pmd` +- a tenth, doubled on unseen poses."""
    return [
        Row(method, kind, n, 0, 0, 1, 1, *[pmd * (1 + 0.1 * (-1) ** n) * (1 + (kind == "unseen"))] * 7)
        for kind in pose_types
        for n in range(count)
    ]


def test_each_method_has_a_dot_its_value_and_its_ratio_to_the_full_network(drawn: list[Figure]) -> None:
    ablation_figure([*rows_of("w/o L_edge", 0.006), *rows_of("DSFFNet", 0.002)], "unused.png")
    assert [axes.get_title(loc="left") for axes in drawn[0].axes] == ["PMD (1e-4)", "CD (1e-4)", "EMD (1e-3)"]
    assert texts(drawn[0], 0) == ["20", "60  ×3.00", "40", "120  ×3.00", "DSFFNet", "w/o L_edge"]
    dots: list[Any] = [line for line in drawn[0].axes[0].get_lines() if line.get_marker() == "o"]
    places = {(float(line.get_xdata()[0]), line.get_color()) for line in dots}
    assert sorted(round(x) for x, _ in places) == [20, 40, 60, 120]
    assert {color for _, color in places} == {METHOD_COLORS["DSFFNet"], METHOD_COLORS["w/o L_edge"]}


def test_one_pose_type_and_no_reference_are_no_trouble(tmp_path: Path, drawn: list[Figure]) -> None:
    ablation_figure(rows_of("$x_{", 0.002, pose_types=("seen",)), "unused.png")
    assert texts(drawn[0], 0) == ["20", "$x_{"]


def test_no_rows_and_values_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one row"):
        ablation_figure([], tmp_path / "figure.png")
    with pytest.raises(ValueError, match="pmd of broken on seen poses must be finite"):
        ablation_figure(rows_of("broken", float("nan")), tmp_path / "figure.png")


def test_files_are_written_whole(tmp_path: Path) -> None:
    figures = tmp_path / "figures"
    convergence_figure({"ours": run_of(tmp_path / "run", level=0.01)}, figures / "4.png", title="$x_{")
    ablation_figure(rows_of("DSFFNet", 0.002), figures / "table-3.png", title="$x_{")
    for path in sorted(figures.iterdir()):
        with Image.open(path) as picture:
            assert picture.width > 1000 and np.asarray(picture).std() > 5
    assert [path.name for path in sorted(figures.iterdir())] == ["4.png", "table-3.png"]
