"""Dressed targets: errors of skin and garments apart, beside what skinning alone leaves."""

from pathlib import Path

import numpy as np
import pytest

from datagen.generate import generate, inline
from datagen.store import Dataset
from tests.datagen.bodies.clothed.test_clothed_dataset import recipe
from training.evaluation.evaluate import evaluate
from training.evaluation.measure import NO_OPS, SKINNED
from training.evaluation.results import Row, read_rows, write_rows
from training.evaluation.tables import results, summary
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
    assert list(summary(bare).lines[0])[-1] == "normal" and "garment" not in str(results(bare, about="", emd_points=2))
    assert SKINNED in str(results(rows, about="", emd_points=2))


def test_rows_of_before_garments_were_measured_apart_are_read(rows: list[Row], tmp_path: Path) -> None:
    bare = [row for row in rows if row.target_identity == 3]
    write_rows(bare, tmp_path / "rows.csv")
    lines = (tmp_path / "rows.csv").read_text().splitlines()
    (tmp_path / "old.csv").write_text("\n".join(line.rsplit(",", 2)[0] for line in lines))
    assert read_rows(tmp_path / "old.csv") == read_rows(tmp_path / "rows.csv") == bare
