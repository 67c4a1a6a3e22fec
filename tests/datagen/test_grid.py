"""Splits, shards and evaluation triples."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from datagen.grid import Grid
from datagen.recipe import DatasetRecipe
from tests.support.recipes import tiny_dataset

recipes = st.builds(
    lambda training, evaluation, seen, unseen, size, seed: DatasetRecipe.model_validate(
        {
            "body": {"family": "leg"},
            "identities": {"training": training, "evaluation": evaluation},
            "poses": {"seen": seen, "unseen": unseen},
            "triples": {"count": 30, "seed": seed},
            "store": {"poses_per_shard": size},
        }
    ),
    st.integers(2, 9), st.integers(2, 9), st.integers(2, 30), st.integers(0, 20), st.integers(1, 40), st.integers(0, 9),
)  # fmt: skip


@given(recipes)
def test_shards_cover_every_row_once(recipe: DatasetRecipe) -> None:
    grid = Grid(recipe)
    for identity in range(grid.identity_count):
        rows = [row for shard in grid.shards_of(identity) for row in range(shard.start, shard.stop)]
        assert rows == list(range(len(grid.poses_of(identity))))
    assert sum(shard.rows for shard in grid.shards()) == grid.mesh_count
    assert len(set(grid.shards())) == len(grid.shards())


@given(recipes)
def test_evaluation_triples_obey_the_protocol(recipe: DatasetRecipe) -> None:
    grid = Grid(recipe)
    for pose_type in ("seen", "unseen"):
        triples = grid.evaluation_triples(pose_type)
        assert len(triples) == (0 if pose_type == "unseen" and recipe.poses.unseen == 0 else 30)
        for source, source_pose, target, target_pose in triples.tolist():
            assert source != target and source_pose != target_pose
            assert grid.split(source) == grid.split(target) == "evaluation"
            assert grid.pose_type(source_pose) == pose_type
            assert target_pose in grid.poses_of(target) and source_pose in grid.poses_of(target)


def test_triples_are_fixed_by_their_seed() -> None:
    first, again = (Grid(tiny_dataset()).evaluation_triples("seen") for _ in range(2))
    other = Grid(tiny_dataset(triples={"count": 5, "seed": 1})).evaluation_triples("seen")
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_training_identities_have_no_unseen_poses() -> None:
    grid = Grid(tiny_dataset())
    assert list(grid.poses_of(0)) == list(range(6)) and list(grid.poses_of(3)) == list(range(10))
