"""Figures of several methods: layout, errors on one scale, the best one marked, files that are whole or absent."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from datagen.common.arrays import Floats
from datagen.common.errors import StorageError
from datagen.mesh.geometry import Mesh
from tests.support.reports.pictures import caught, octahedron, pixels
from training.viz import comparison_figure as module
from training.viz.close_up import CloseUp
from training.viz.comparison_figure import comparison_figure
from training.viz.render.camera import Camera
from training.viz.style import ERROR_COLORS, METHOD_COLORS, error_colors, method_colors
from training.viz.transfer_example import Comparison, best_of, camera_of, error_limit, placed, vertex_errors

PANEL = (120, 140)
SIDE, HEAD, TITLE = 20, 100, 46


def comparison(title: str = "pose 1 to identity 2", **errors: float) -> Comparison:
    """A transfer whose outputs are each off by so many metres at every vertex."""
    truth = octahedron(0.8, (5, 7, -3))
    outputs = {name: Mesh(truth.vertices + np.array([0, error, 0]), truth.faces) for name, error in errors.items()}
    metrics = {name: f"off by {error}" for name, error in errors.items()}
    return Comparison(title, octahedron(0.4), octahedron(0.8, (2, 0, 0)), outputs, truth, metrics)


def column(picture: np.ndarray, number: int) -> np.ndarray:
    left = SIDE + number * PANEL[0]
    return picture[HEAD + TITLE :, left : left + PANEL[0]]


def hue(cut: np.ndarray) -> np.ndarray:
    """Return the mean colour of what is not near white or grey."""
    return cut[np.ptp(cut, axis=-1) > 40].mean(0)


def words(figure: Figure) -> dict[str, str]:
    """Text -> its weight."""
    return {text.get_text(): text.get_weight() for text in figure.texts}


def test_errors_are_distances_and_shapes_must_agree() -> None:
    errors = vertex_errors(comparison(ours=0.25, theirs=0.5))
    assert errors["ours"] == pytest.approx(0.25) and errors["theirs"] == pytest.approx(0.5)
    wrong = replace(comparison(ours=0.1), truth=Mesh(np.zeros((5, 3)), np.zeros((0, 3), int)))
    with pytest.raises(ValueError, match=r"output \(6, 3\) of ours and truth \(5, 3\)"):
        vertex_errors(wrong)
    assert vertex_errors(replace(comparison(ours=0.1), truth=None)) == {}


def test_error_colours_grow_darker_to_the_limit_and_stay_there() -> None:
    colors = error_colors(np.linspace(0, 2, 41), limit=1.0)
    lightness = colors @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness[:21]) < 0).all() and (colors[20:] == ERROR_COLORS[-1]).all()
    assert (colors[0] == ERROR_COLORS[0]).all()


def test_the_best_has_the_least_mean_square_and_one_method_is_not_best() -> None:
    steady, spiky = np.full(4, 1.0), np.array([0.0, 0, 0, 3.0])
    assert spiky.mean() < steady.mean()
    assert best_of({"spiky": spiky, "steady": steady}) == "steady", "PMD squares, so a lower mean does not win"
    assert best_of({"steady": steady}) is None and best_of({}) is None


def test_meshes_stand_on_the_ground_and_outputs_keep_their_offset_from_the_truth() -> None:
    meshes = placed(comparison(ours=0.3))
    for role in ("source", "target", "truth"):
        assert meshes[role].vertices[:, 1].min() == pytest.approx(0)
        assert (meshes[role].vertices.min(0) + meshes[role].vertices.max(0))[[0, 2]] == pytest.approx([0, 0])
    offset = meshes["output ours"].vertices - meshes["truth"].vertices
    assert offset == pytest.approx(np.tile([0, 0.3, 0], (6, 1)))


def test_the_source_is_drawn_at_the_size_of_the_truth() -> None:
    meshes = placed(comparison(ours=0.1))
    assert np.ptp(meshes["source"].vertices, axis=0) == pytest.approx(1.6), "it is 0.8 large itself"
    assert np.ptp(meshes["target"].vertices, axis=0) == pytest.approx(1.6)


def test_an_output_that_strays_far_does_not_shrink_the_others() -> None:
    near, far = (camera_of(placed(comparison(ours=0.0, theirs=error))) for error in (0.4, 400.0))
    distances = [float(np.linalg.norm(np.subtract(camera.eye, camera.target))) for camera in (near, far)]
    assert distances[1] < 1.2 * distances[0]


def test_the_limit_of_the_error_scale_is_shared_and_one_bad_method_does_not_set_it() -> None:
    rows = [comparison(ours=0.01), comparison(ours=0.05)]
    assert error_limit(rows) == pytest.approx(5.0)  # centimetres
    assert error_limit([comparison(ours=0.0)]) > 0
    assert error_limit([comparison(a=0.01, b=0.02, broken=9.0)]) == pytest.approx(2.0)


def test_methods_keep_their_colours_whoever_stands_beside_them() -> None:
    assert method_colors(["mine", "DSFFNet"])["DSFFNet"] == method_colors(["DSFFNet", "NPT"])["DSFFNet"]
    others = method_colors([*METHOD_COLORS, "mine", "hers"])
    assert len(set(others.values())) == len(others)


def test_roles_have_their_colours_and_errors_of_all_rows_share_one_scale(tmp_path: Path) -> None:
    rows = [comparison(ours=0.001), comparison(ours=0.02), comparison(ours=0.04)]
    picture = pixels(comparison_figure(rows, tmp_path / "figure.png", panel=PANEL))
    source, target, output = (hue(column(picture, number)) for number in range(3))
    assert source[2] > source[0] + 50 and target[0] > target[2] + 50 and output[1] > output[0] + 40
    assert np.ptp(column(picture, 3)[:-120], axis=-1).max() < 40, "the truth is grey"
    error = column(picture, 4)[:-112]  # the colour bar is below
    filled = np.flatnonzero((np.ptp(error, axis=-1) > 40).any(1))
    starts = [part[0] for part in np.split(filled, np.flatnonzero(np.diff(filled) > 20) + 1)]
    ends = [part[-1] for part in np.split(filled, np.flatnonzero(np.diff(filled) > 20) + 1)]
    small, middle, large = (hue(error[a:b]).sum() for a, b in zip(starts, ends, strict=True))
    assert small > middle + 60 > large + 120, "a larger error is darker than a smaller one in another row"


def test_several_methods_have_their_errors_below_and_the_better_is_paler(tmp_path: Path) -> None:
    picture = pixels(comparison_figure([comparison(worse=0.4, better=0.02)], tmp_path / "f.png", panel=PANEL))
    assert picture.shape[1] == 5 * PANEL[0] + 2 * SIDE
    lower = slice(PANEL[1], PANEL[1] + 60)  # both strips are less than a panel high
    worse, better = (column(picture, number)[lower] for number in (2, 3))
    assert better[better.min(-1) < 240].mean() > worse[worse.min(-1) < 240].mean() + 30


def test_methods_have_their_numbers_the_best_in_bold_and_without_a_truth_there_are_no_errors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    figures, row = caught(monkeypatch, module), comparison(NPT=0.4, DSFFNet=0.02, CoreNet=0.1)
    for shown in ([row], [replace(row, truth=None)], [row, comparison(NPT=0.3)]):  # the last lacks some methods
        comparison_figure(shown, "unused.png", panel=PANEL)
    weights, without, _ = map(words, figures)
    assert weights["off by 0.02"] == "bold" and weights["off by 0.4"] == weights["off by 0.1"] == "normal"
    assert {"NPT", "DSFFNet", "CoreNet", "Source", "Target", "Ground truth"} <= set(weights)
    assert not {"Ground truth", "Error", "mean error of a vertex (cm)"} & set(without)
    assert {"NPT", "DSFFNet", "off by 0.1"} <= set(without)


def test_bold_is_the_least_of_the_numbers_it_stands_among(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bars show mean errors, the words under the pictures PMD, which squares."""
    figures, row = caught(monkeypatch, module), comparison(steady=0.1, spiky=0.0)
    row.outputs["spiky"].vertices[0] += (0, 0.3, 0)
    comparison_figure([row], "unused.png", panel=PANEL)
    weights = words(figures[0])
    assert weights["10.00"] == weights["off by 0.0"] == "normal"
    assert weights["5.00"] == weights["off by 0.1"] == "bold"


def long_body(shift: float = 0.0) -> Mesh:
    body = octahedron()
    return Mesh(body.vertices * (0.3, 0.6, 1.5) + (shift, 0, 0), body.faces)


def test_a_long_body_is_seen_from_the_side_whatever_a_broken_output_looks_like() -> None:
    wide = Mesh(long_body().vertices[:, [2, 1, 0]], long_body().faces)
    shown = Comparison("horse", long_body(), long_body(), {"broken": wide}, long_body())
    turn = camera_of(placed(shown)).axes()[2]
    assert np.degrees(np.arctan2(turn[0], turn[2])) == pytest.approx(62)
    upright = camera_of(placed(comparison(ours=0.0))).axes()[2]
    assert np.degrees(np.arctan2(upright[0], upright[2])) == pytest.approx(28)


def strip(count: int = 200) -> Mesh:
    """A thin strip of triangles along x, from 0 to 1."""
    x = np.repeat(np.linspace(0, 1, count), 2)
    points = np.stack([x, 0.01 * (np.arange(2 * count) % 2), np.zeros(2 * count)], 1)
    return Mesh(points, np.stack([np.arange(2 * count - 2) + k for k in range(3)], 1))


def test_the_close_up_is_where_methods_differ_not_where_all_are_wrong_nor_where_one_has_left_it() -> None:
    truth = strip()
    both_wrong, differ, gone = (np.abs(truth.vertices[:, 0] - place) < 0.06 for place in (0.1, 0.5, 0.9))

    def off_by(error: Floats) -> Mesh:
        return Mesh(truth.vertices + error[:, None] * (0, 0, 1), truth.faces)

    outputs = [off_by(0.1 * both_wrong + 0.05 * differ + 3.0 * gone), off_by(0.1 * both_wrong)]
    assert CloseUp.of(truth, outputs).centre[0] == pytest.approx(0.5, abs=0.05)
    all_gone = CloseUp.of(truth, [off_by(3.0 + gone), off_by(3.0 + 0 * gone)]).centre
    assert all_gone[0] == pytest.approx(0.9, abs=0.06) and all_gone[2] == pytest.approx(2.3, abs=0.15)


def test_the_mark_in_the_whole_picture_is_what_the_close_up_shows() -> None:
    whole = Camera(eye=(0.5, 0, 5), target=(0.5, 0, 0), field_of_view=20)
    near = CloseUp(np.array([0.7, 0.1, 0.0]), 0.1)
    marked = near.marked(np.full((200, 400, 3), 255, np.uint8), whole)
    rows, columns = np.nonzero((marked < 255).any(-1))
    pixel = 2 * 5 * np.tan(np.radians(10)) / 200
    assert (rows.min() + rows.max()) / 2 == pytest.approx(100 - 0.1 / pixel, abs=1)
    assert (columns.min() + columns.max()) / 2 == pytest.approx(200 + 0.2 / pixel, abs=1)
    assert np.ptp(rows) == pytest.approx(0.2 / pixel, abs=2) and np.ptp(columns) == pytest.approx(
        0.8 / 3 / pixel, abs=2
    )
    seen = near.camera(whole)
    away = np.linalg.norm(np.subtract(seen.eye, seen.target))
    assert seen.eye == whole.eye and np.tan(np.radians(seen.field_of_view / 2)) * away == pytest.approx(0.1)


def test_nothing_to_draw_and_vertices_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one"):
        comparison_figure([], tmp_path / "figure.png")
    broken = comparison(ours=0.1)
    broken.outputs["ours"].vertices[2] = np.nan
    with pytest.raises(ValueError, match="1 of 6 vertices of the output ours are not finite"):
        comparison_figure([broken], tmp_path / "figure.png")
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_figure_and_no_litter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = comparison_figure([comparison(ours=0.1)], tmp_path / "figure.png", panel=PANEL)
    before = path.read_bytes()

    def full_disk(*_: object, **__: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(Figure, "savefig", full_disk)
    with pytest.raises(StorageError, match="No space"):
        comparison_figure([comparison(ours=0.5)], path, panel=PANEL)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
