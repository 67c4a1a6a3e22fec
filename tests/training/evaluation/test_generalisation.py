"""Generalisation: truth between kinds that share poses, none between others; rows, grid and pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.text import Text
from PIL import Image

from datagen.common.errors import DatasetError
from datagen.generate import generate
from tests.support.recipes import tiny_dataset
from tests.support.reports.pictures import caught
from training.evaluation.generalisation import (
    NO_OP,
    GeneralisationRow,
    MeshKind,
    cases_between,
    grid_of,
    grid_table,
    have_truth,
    measured,
    pairs_with_truth,
)
from training.evaluation.measure import LoadedMethod
from training.evaluation.results import kept_rows, write_csv
from training.networks import NETWORKS
from training.reports.plots import generalisation as module
from training.reports.plots.generalisation import Shown, generalisation_picture, heat_map


def leg(folder: Path, rings: int, **poses: int) -> MeshKind:
    recipe = tiny_dataset(
        body={"family": "leg", "rings": rings, "segments": 4},
        identities={"training": 0, "evaluation": 3},
        poses={"seen": 4, "unseen": 0, **poses},
        triples={"count": 4},
    )
    data = generate(recipe, str(folder / f"{rings}-{len(poses)}.zarr"))
    return MeshKind(f"leg {4 * rings}{' other' * len(poses)}", data, recipe.poses.model_dump_json())


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> list[MeshKind]:
    folder = tmp_path_factory.mktemp("kinds")
    return [leg(folder, 8), leg(folder, 12), leg(folder, 6, seed=9)]


@pytest.fixture(scope="module")
def method() -> LoadedMethod:
    torch.manual_seed(0)
    return LoadedMethod(
        "DSFFNet", NETWORKS["dsffnet"](encoder_widths=(8, 8, 8), decoder_widths=(8, 8, 8)).eval(), 1, ""
    )


@pytest.fixture(scope="module")
def rows(kinds: list[MeshKind], method: LoadedMethod) -> list[GeneralisationRow]:
    return [row for some in measured([method], kinds, triples=4) for row in some]


def test_truth_is_known_between_kinds_of_the_same_poses_only(kinds: list[MeshKind]) -> None:
    one, two, other = kinds
    assert have_truth(one, two) and not have_truth(one, other)
    assert pairs_with_truth(kinds) == [(one, one), (one, two), (two, one), (two, two), (other, other)]


def test_the_truth_is_the_target_in_its_own_mesh_in_the_sources_pose(kinds: list[MeshKind]) -> None:
    one, two, _ = kinds
    for case in cases_between(one, two, 4):
        source, source_pose, target, target_pose = case.triple
        np.testing.assert_array_equal(case.source.vertices, one.dataset.vertices(source, source_pose))
        np.testing.assert_array_equal(case.target.vertices, two.dataset.vertices(target, target_pose))
        np.testing.assert_array_equal(case.truth.vertices, two.dataset.vertices(target, source_pose))
        np.testing.assert_array_equal(case.truth.faces, two.dataset.faces(target))
        assert (len(case.source.vertices), len(case.truth.vertices)) == (32, 48)


def test_rows_and_grid_cover_every_pair_with_a_truth(kinds: list[MeshKind], rows: list[GeneralisationRow]) -> None:
    names = [kind.name for kind in kinds]
    assert len(rows) == 4 * (5 + 3), "five pairs, and the no-op within each of three kinds"
    assert {(row.source_vertices, row.target_vertices) for row in rows if row.source_kind != row.target_kind} == {
        (32, 48),
        (48, 32),
    }
    grid = grid_of(rows, names, "DSFFNet")
    assert np.isnan(grid).tolist() == [[False, False, True], [False, False, True], [True, True, False]]
    between = [row.pmd for row in rows if (row.source_kind, row.target_kind) == (names[0], names[1])]
    assert grid[0, 1] == pytest.approx(np.mean(between))
    table = grid_table(rows, names, "DSFFNet").lines
    assert list(table[1]).count("–") == 1 and f"{grid[0, 1] * 1e4:.1f}" in table[1] and NO_OP in table[-1]


def test_what_is_there_is_not_measured_again(
    kinds: list[MeshKind], method: LoadedMethod, rows: list[GeneralisationRow], tmp_path: Path
) -> None:
    write_csv(rows, tmp_path / "rows.csv", GeneralisationRow)
    again = [
        row
        for some in measured([method], kinds, triples=4, done=kept_rows(tmp_path / "rows.csv", GeneralisationRow))
        for row in some
    ]
    assert again == []


def test_a_network_that_needs_equal_counts_gets_no_other(kinds: list[MeshKind], method: LoadedMethod) -> None:
    equal = replace(method, equal_counts="it pairs vertices")
    found = [row for some in measured([equal], kinds[:2], triples=2) for row in some if row.method != NO_OP]
    assert found and all(row.source_vertices == row.target_vertices for row in found)


def test_a_kind_without_triples_is_refused(tmp_path: Path) -> None:
    data = generate(tiny_dataset(identities={"training": 2, "evaluation": 1}), str(tmp_path / "one.zarr"))
    kind = MeshKind("one", data, "")
    with pytest.raises(DatasetError, match="no evaluation triples"):
        cases_between(kind, kind, 3)


def test_heat_map_and_picture_are_drawn(
    tmp_path: Path,
    kinds: list[MeshKind],
    method: LoadedMethod,
    rows: list[GeneralisationRow],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = [kind.name for kind in kinds]
    with Image.open(heat_map(rows, names, tmp_path / "heat.png", title="tiny", trained=[names[1]])) as picture:
        pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(int)
        assert (np.abs(pixels - (209, 70, 47)).sum(1) < 12).sum() > 300, "the trained kind is framed"
        assert (np.abs(pixels - (236, 238, 241)).sum(1) < 3).sum() > 5000, "what has no truth is grey"
    both = [*rows, *(replace(row, method=f"{row.method} again") for row in rows if row.method != NO_OP)]
    with Image.open(heat_map(both, names, tmp_path / "two.png", title="tiny", trained=[names[1]] * 2)) as wide:
        assert wide.width > 1.4 * picture.width
    case = cases_between(kinds[0], kinds[1], 1)[0]
    shown = [Shown("with", case), Shown("without", case, truth_known=False)]
    with Image.open(generalisation_picture(shown, [method], tmp_path / "pairs.png", title="tiny")) as picture:
        last = np.asarray(picture.convert("RGB"))[:, -226:-16].astype(int)
    top, bottom = np.array_split(last[90:], 2)
    assert (top[:240].min(-1) < 240).sum() > 500 > (bottom[20:240].min(-1) < 200).sum(), "truth above, none below"
    figures = caught(monkeypatch, module)
    heat_map(rows, names[:2], "unused.png", title="a title of some words; " * 6)
    figures[0].draw_without_rendering()
    (title,) = [text for text in figures[0].findobj(Text) if text.get_text().startswith("a title")]
    assert title.get_window_extent().x1 <= figures[0].bbox.x1, "a narrow figure cuts nothing of its title"
    with pytest.raises(ValueError, match="no numbers"):
        heat_map([], names, tmp_path / "none.png", title="")
