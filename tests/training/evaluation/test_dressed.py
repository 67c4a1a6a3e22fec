"""Dressed targets: errors of skin and garments apart, beside what skinning alone leaves."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.generate import generate, inline
from datagen.mesh.geometry import bounding_box
from datagen.store import Dataset
from tests.datagen.bodies.clothed.test_clothed_dataset import recipe
from training.evaluation.document import cell_of
from training.evaluation.evaluate import evaluate
from training.evaluation.measure import NO_OPS, SKINNED, score
from training.evaluation.results import Row, read_rows, write_rows
from training.evaluation.tables import PARTS, by_part, columns_of, emphasised, results, summary
from training.inference.mesh_reading import normalised
from training.recipes.training import EvaluationRecipe


@pytest.fixture(scope="module")
def people(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Identities 2 (dressed) and 3 (bare) to evaluate, in two poses of each kind."""
    of = recipe(identities={"training": 2, "evaluation": 2}, poses={"seen": 2, "unseen": 2}, triples={"count": 4})
    return generate(of, str(tmp_path_factory.mktemp("dressed") / "mixed.zarr"))


@pytest.fixture(scope="module")
def rows(people: Dataset) -> list[Row]:
    return evaluate([], people.url, EvaluationRecipe(emd_points=16, chunk=3), tasks=inline)


def test_skinning_moves_skin_exactly_and_leaves_what_cloth_does(rows: list[Row]) -> None:
    skinned = [row for row in rows if row.method == SKINNED]
    assert {row.target_identity for row in skinned} == {2, 3}
    for row in skinned:
        if row.target_identity == 2:
            assert row.garment_millimetres > 3 and row.skin_millimetres < 0.01
        else:
            assert row.millimetres < 0.01 and row.skin_millimetres == row.garment_millimetres == 0


def test_the_parts_together_are_the_whole(rows: list[Row], people: Dataset) -> None:
    labels = people.part(2)
    assert labels is not None
    share = (labels > 0).mean()
    for row in rows:
        if row.target_identity == 2:
            whole = share * row.garment_millimetres + (1 - share) * row.skin_millimetres
            assert whole == pytest.approx(row.millimetres, rel=1e-5)


def test_tables_have_columns_of_the_parts_over_dressed_targets_alone(rows: list[Row]) -> None:
    heading, *lines = summary(rows).lines
    assert list(heading[-2:]) == ["skin mm", "garment mm"]
    assert [line[1] for line in lines if line[0] == "unseen"] == [NO_OPS[0], SKINNED]
    wanted = np.mean([row.garment_millimetres for row in rows
                      if (row.method, row.pose_type, row.target_identity) == (SKINNED, "unseen", 2)])  # fmt: skip
    assert lines[-1][-1] == f"{wanted:.1f}"
    bare = [row for row in rows if row.target_identity == 3]
    assert list(summary(bare).lines[0])[-1] == "normal" and by_part(bare).lines[1:] == []
    assert "garment" not in str(results(bare, about="", emd_points=2))
    assert SKINNED in str(results(rows, about="", emd_points=2))


def test_each_part_is_measured_as_a_mesh_of_its_own(rows: list[Row], people: Dataset) -> None:
    labels, faces = people.part(2), people.faces(2)
    assert labels is not None
    row = next(row for row in rows if (row.method, row.target_identity) == (NO_OPS[0], 2))
    truth, output = (people.vertices(2, pose).astype(np.float64) for pose in (row.source_pose, row.target_pose))
    half = bounding_box(truth).half
    for part, name in enumerate(PARTS):
        own = (labels > 0) == bool(part)
        kept = own[faces].all(axis=1)
        alone = score(
            normalised(output)[own], normalised(truth)[own], (own.cumsum() - 1)[faces[kept]], half=half, emd_points=16
        )
        for column in columns_of(name):
            whole = getattr(alone, column.field.removeprefix(f"{name}_"))
            assert getattr(row, column.field) == pytest.approx(whole, rel=1e-3), column


def test_a_table_of_the_parts_stands_beside_the_summary(rows: list[Row]) -> None:
    heading, *lines = emphasised(by_part(rows)).lines
    assert [cell_of(cell).text for cell in heading[:4]] == ["poses", "part", "method", "PMD x1e-4"]
    assert len(lines) == 2 * 2 * 2  # kinds of poses, parts, controls: target unchanged and skinned
    wanted = np.mean([1e4 * row.skin_pmd for row in rows
                      if (row.method, row.pose_type, row.target_identity) == (NO_OPS[0], "seen", 2)])  # fmt: skip
    assert [cell_of(cell).text for cell in lines[0][:4]] == ["seen", "skin", NO_OPS[0], f"{wanted:.2f}"]
    assert any(part == by_part(rows) for part in results(rows, about="", emd_points=2))


def test_the_best_of_skin_and_of_garments_are_told_apart(rows: list[Row]) -> None:
    dressed = [row for row in rows if row.target_identity == 2 and row.pose_type == "seen"]
    made = [replace(row, method="ours" if row.method == SKINNED else "theirs") for row in dressed]
    _, *lines = emphasised(by_part(made)).lines
    bold = [(cell_of(line[1]).text, cell_of(line[2]).text) for line in lines if cell_of(line[3]).bold]
    assert bold == [("skin", "ours"), ("garment", "ours")]


def test_rows_have_columns_of_garments_where_there_are_any(rows: list[Row], tmp_path: Path) -> None:
    bare = [row for row in rows if row.target_identity == 3]
    for some, name, has in ((bare, "bare.csv", False), (rows, "all.csv", True)):
        write_rows(some, tmp_path / name)
        assert ("garment_pmd" in (tmp_path / name).read_text()) == has
        assert read_rows(tmp_path / name) == some
