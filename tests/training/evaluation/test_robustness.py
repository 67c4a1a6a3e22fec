"""Robustness: rows of a disturbed source, what is skipped, what is kept, tables and pictures of them."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from PIL import Image

from datagen.common.errors import DatasetError
from datagen.generate import generate
from datagen.store import open_dataset
from tests.support.recipes import tiny_dataset
from tests.support.reports.pictures import caught
from training.data.batch import read_batch
from training.evaluation.disturbances import DISTURBANCES, Disturbance
from training.evaluation.measure import LoadedMethod, score
from training.evaluation.results import Score, kept_rows, write_csv
from training.evaluation.robustness import (
    NO_OP,
    Level,
    RobustnessRow,
    amounts_table,
    cases_of,
    curve,
    doubled,
    limits_table,
    measured,
    no_op,
)
from training.networks import NETWORKS
from training.objectives.metrics import point_mesh_distance
from training.reports.plots import robustness as module
from training.reports.plots.robustness import disturbance_picture, robustness_curves
from training.viz.style import method_colors

BY_NAME = {its.name: its for its in DISTURBANCES}
SOME = [BY_NAME["noise"], BY_NAME["subset"], BY_NAME["scale"]]


def network(name: str = "dsffnet", **options: object) -> torch.nn.Module:
    widths = {"encoder_widths": (8, 8, 8)}
    torch.manual_seed(0)
    made = NETWORKS[name](**(widths | ({"decoder_widths": (8, 8, 8)} if name == "dsffnet" else {}) | options))
    with torch.no_grad():
        for weight in made.parameters():
            weight.add_(0.1 * torch.randn_like(weight))  # alpha and beta begin at 0, where the source plays no part
    return made.eval()


@pytest.fixture(scope="module")
def method() -> LoadedMethod:
    return LoadedMethod("DSFFNet", network(), step=3, place="here")


@pytest.fixture(scope="module")
def rows(_pristine: Path, method: LoadedMethod) -> list[RobustnessRow]:
    return [row for some in measured([method], cases_of(open_dataset(str(_pristine)), 3), SOME) for row in some]


def test_undisturbed_rows_are_what_evaluation_measures(
    dataset: str, method: LoadedMethod, rows: list[RobustnessRow]
) -> None:
    opened = open_dataset(dataset)
    batch = read_batch(opened, opened.evaluation_triples("unseen")[:3])
    with torch.no_grad():
        output = method.network(source=batch.source, target=batch.target)
    undisturbed = [row for row in rows if row.disturbance == "noise" and row.amount == 0]
    assert [row.pmd for row in undisturbed] == pytest.approx(
        point_mesh_distance(output, batch.truth).tolist(), rel=1e-4
    )
    nothing = [row.pmd for row in rows if row.method == NO_OP]
    assert nothing == pytest.approx(point_mesh_distance(batch.target, batch.truth).tolist(), rel=1e-4)
    assert no_op(rows) == pytest.approx(np.mean(nothing))


def test_noise_changes_the_output_and_scale_does_not(rows: list[RobustnessRow]) -> None:
    noise, scale = curve(rows, "DSFFNet", "noise"), curve(rows, "DSFFNet", "scale")
    assert [level.amount for level in noise] == list(BY_NAME["noise"].amounts)
    assert abs(noise[-1].mean - noise[0].mean) > 1e-5 * noise[0].mean
    assert [level.mean for level in scale] == pytest.approx([scale[0].mean] * len(scale), rel=1e-4)


def test_triples_are_the_fixed_unseen_ones_and_counts_the_sources(dataset: str, rows: list[RobustnessRow]) -> None:
    listed = open_dataset(dataset).evaluation_triples("unseen")[:3].tolist()
    for row in rows:
        triple = [row.source_identity, row.source_pose, row.target_identity, row.target_pose]
        assert triple == listed[row.triple]
        assert row.source_vertices == (max(round(32 * (1 - row.amount)), 3) if row.disturbance == "subset" else 32)


def test_what_is_there_is_not_measured_again(dataset: str, method: LoadedMethod, rows: list[RobustnessRow]) -> None:
    cases = cases_of(open_dataset(dataset), 3)
    kept = [row for row in rows if row.key != ("DSFFNet", "subset", 0.5)]
    (missing,) = measured([method], cases, SOME, done=kept)
    assert [(row.key, row.triple, row.pmd) for row in missing] == [
        (row.key, row.triple, row.pmd) for row in rows if row not in kept
    ]


def test_a_network_that_needs_equal_counts_gets_no_other(dataset: str) -> None:
    origin = LoadedMethod("NPT", network("npt", variant="origin"), 0, "", equal_counts="it pairs vertices")
    found = [row for some in measured([origin], cases_of(open_dataset(dataset), 2), SOME) for row in some]
    assert {row.disturbance for row in found} == {"", "noise", "scale"}
    more = [replace(row, method="X", disturbance="subset") for row in found]
    assert any("not taken" in line for line in limits_table([*found, *more]).lines)


def test_a_dataset_without_triples_is_refused_with_what_to_do(tmp_path: Path) -> None:
    data = generate(tiny_dataset(identities={"training": 2, "evaluation": 0}), str(tmp_path / "none.zarr"))
    with pytest.raises(DatasetError, match=r"no evaluation triples.*data\.identities\.evaluation"):
        cases_of(data, 3)


def test_rows_come_back_from_their_file(tmp_path: Path, rows: list[RobustnessRow]) -> None:
    write_csv(rows, tmp_path / "rows.csv", RobustnessRow)
    back = kept_rows(tmp_path / "rows.csv", RobustnessRow)
    assert [replace(row, earth_mover=0) for row in back] == [replace(row, earth_mover=0) for row in rows]
    assert np.isnan([row.earth_mover for row in back]).all() and kept_rows(tmp_path / "none.csv", RobustnessRow) == []


def test_tables_say_where_the_error_has_doubled(rows: list[RobustnessRow]) -> None:
    levels = [Level(0, 2.0, 1.9, 2.1), Level(0.1, 3.9, 3.8, 4.0), Level(0.2, 4.0, 3.9, 4.1)]
    assert doubled(levels) == 0.2 and doubled(levels[:2]) is None
    line = next(line for line in amounts_table(rows).lines if list(line[:2]) == ["Noise", "0.1"])
    last = curve(rows, "DSFFNet", "noise")[-1]
    assert last.low < last.mean < last.high
    assert list(line[2:4]) == [f"{last.mean * 1e4:.2f}", f"{last.low * 1e4:.2f} to {last.high * 1e4:.2f}"]
    assert any("never" in line for line in limits_table(rows).lines)


def test_scores_are_zero_for_the_truth_and_the_earth_mover_is_optional(dataset: str) -> None:
    (case,) = cases_of(open_dataset(dataset), 1)
    truth = np.asarray(case.truth.vertices - case.truth.vertices.mean(0))
    found = score(truth, truth, case.target.faces, half=1.0, emd_points=8)
    assert all(getattr(found, each.name) == pytest.approx(0, abs=1e-9) for each in fields(Score))
    moved = score(truth + 0.1, truth, case.target.faces, half=2.0)
    assert moved.millimetres == pytest.approx(1000 * 2 * 0.1 * np.sqrt(3)) and np.isnan(moved.earth_mover)


def test_curves_and_picture_are_drawn(
    tmp_path: Path, dataset: str, method: LoadedMethod, rows: list[RobustnessRow], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Image.open(robustness_curves(rows, tmp_path / "curves.png", title="tiny")) as picture:
        colors = np.asarray(picture.convert("RGB")).reshape(-1, 3)
        line = [round(255 * level) for level in to_rgb(method_colors([method.name])[method.name])]
        assert (np.abs(colors.astype(int) - line).sum(1) < 12).sum() > 200, "the method's line is there"
    chosen: list[tuple[Disturbance, float]] = [(BY_NAME["noise"], 0.1), (BY_NAME["area"], 1)]
    (case,) = cases_of(open_dataset(dataset), 1)
    path = disturbance_picture(case, [method], chosen, tmp_path / "noise.png", title="a title " * 20)
    with Image.open(path) as picture:
        blue = np.asarray(picture.convert("RGB")).astype(int)
        assert ((blue[..., 2] - blue[..., 0]) > 40).sum() > 500, "sources stand there, points too"
    figures, noisy = caught(monkeypatch, module), [row for row in rows if row.disturbance in ("", "noise")]
    both = [*noisy, *(replace(row, method="another network of a long name") for row in noisy)]
    robustness_curves(both, "unused.png", title="one panel")
    figures[0].draw_without_rendering()
    words = figures[0].legends[0].get_window_extent()
    assert words.x0 >= 0 and words.x1 <= figures[0].bbox.x1, "a narrow figure cuts nothing of its legend"
    with pytest.raises(ValueError, match="no rows"):
        robustness_curves([], tmp_path / "none.png", title="")
