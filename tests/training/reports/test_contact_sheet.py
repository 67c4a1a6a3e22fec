"""A contact sheet shows every kind of identity and pose that a dataset holds."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from datagen.generate import append, generate
from tests.support.recipes import tiny_dataset
from training.reports.contact_sheet import chosen, draw_contact_sheet, identity_groups, pose_groups
from training.viz.mesh_grid import mesh_grid


def test_each_group_gives_some_and_larger_ones_more() -> None:
    assert chosen([range(1000), range(1000, 1004), range(1004, 1004)], 6) == [0, 249, 499, 749, 999, 1000]
    assert chosen([range(2), range(2, 4)], 9) == [0, 1, 2, 3]
    assert chosen([range(5), range(5, 6), range(6, 8), range(8, 20)], 2) == [0, 8]


def test_unseen_and_appended_poses_are_shown_and_what_is_not_there_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = str(tmp_path / "leg.zarr")
    generate(tiny_dataset(), url)
    dataset = append(url, training=5, seen=12, unseen=6)
    shown: dict[str, Any] = {}

    def noted(page, path, *, columns, **more):  # type: ignore[no-untyped-def]
        shown.update(rows=page, columns=columns)
        return mesh_grid(page, path, columns=columns, **more)

    monkeypatch.setattr("training.reports.contact_sheet.mesh_grid", noted)
    picture = imread(draw_contact_sheet(dataset, tmp_path / "sheet.png"))
    kinds = {"seen", "unseen", "seen,\nappended", "unseen,\nappended"}
    assert {label.partition("\n")[2] for label in shown["columns"]} == kinds
    assert {row.label.partition("\n")[2] for row in shown["rows"]} == {"training", "evaluation", "training,\nappended"}
    for row in shown["rows"]:
        expected = ["unseen" in column and "training" in row.label for column in shown["columns"]]
        assert [panel == "not in the dataset" for panel in row.panels] == expected
    assert picture.shape[1] > 1500 and np.ptp(picture) > 0.5


def test_groups_are_of_each_step() -> None:
    from datagen.grid import Grid
    from datagen.recipe import Growth

    recipe = tiny_dataset()
    grown = recipe.model_copy(update={"growth": (Growth(training=2, unseen=3),)})
    grid = Grid(grown)
    assert [number for group in sorted(pose_groups(grid), key=lambda g: g.start) for number in group] == list(
        range(grid.pose_count)
    )
    assert {grid.pose_type(number) for number in pose_groups(grid)[-1]} == {"unseen"}
    assert sorted(number for group in identity_groups(grid) for number in group) == list(range(grid.identity_count))
