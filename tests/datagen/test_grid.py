"""Splits, shards and evaluation triples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.grid import POSE_TYPES, Grid
from datagen.recipe import DatasetRecipe, Growth
from tests.support.recipes import tiny_dataset

recipes = st.builds(
    lambda training, evaluation, seen, unseen, size, seed, growth: DatasetRecipe.model_validate(
        {
            "body": {"family": "leg"},
            "identities": {"training": training, "evaluation": evaluation},
            "poses": {"seen": seen, "unseen": unseen},
            "triples": {"count": 30, "seed": seed},
            "store": {"poses_per_shard": size},
            "growth": [dict(zip(("training", "evaluation", "seen", "unseen"), step, strict=True)) for step in growth],
        }
    ),
    st.integers(2, 9), st.integers(2, 9), st.integers(2, 30), st.integers(0, 20), st.integers(1, 40), st.integers(0, 9),
    st.lists(st.tuples(*[st.integers(0, 5)] * 4), max_size=2),
)  # fmt: skip


@given(recipes)
def test_shards_cover_every_mesh_once(recipe: DatasetRecipe) -> None:
    grid = Grid(recipe)
    for identity in range(grid.identity_count):
        rows = [row for shard in grid.shards_of(identity) for row in range(shard.start, shard.stop)]
        poses = grid.rows_of(identity)[rows]
        assert poses.tolist() == grid.poses_of(identity).tolist()
        assert [grid.row_of(identity, pose) for pose in poses] == rows
        expected = grid.poses("seen") if grid.split(identity) == "training" else np.arange(grid.pose_count)
        assert sorted(poses) == expected.tolist()
    assert sum(shard.rows for shard in grid.shards()) == grid.mesh_count
    assert len(set(grid.shards())) == len(grid.shards())


@given(recipes)
def test_shards_begin_where_the_store_has_them(recipe: DatasetRecipe) -> None:
    grid = Grid(recipe)
    for shard in grid.shards():
        size = grid.rows_per_shard(grid.split(shard.identity))
        assert shard.start == shard.number * size and 0 < shard.rows <= size


@given(recipes)
def test_growing_leaves_everything_where_it_was(recipe: DatasetRecipe) -> None:
    before = Grid(recipe)
    step = Growth(training=2, evaluation=1, seen=3, unseen=4)
    after = Grid(recipe.model_copy(update={"growth": (*recipe.growth, step)}))
    assert set(before.shards()) <= set(after.shards())
    for identity in range(before.identity_count):
        assert before.split(identity) == after.split(identity)
        rows = before.rows_of(identity)
        assert np.array_equal(after.rows_of(identity)[: len(rows)], rows)
    for pose_type in POSE_TYPES:
        lists = before.evaluation_triples(pose_type), after.evaluation_triples(pose_type)
        assert np.array_equal(lists[0], lists[1][: len(lists[0])]) and len(lists[1]) > len(lists[0])
    assert after.identity_count == before.identity_count + 3 and after.pose_count == before.pose_count + 7


@given(recipes)
def test_evaluation_triples_obey_the_protocol(recipe: DatasetRecipe) -> None:
    grid = Grid(recipe)
    for pose_type in POSE_TYPES:
        triples = grid.evaluation_triples(pose_type)
        base = 0 if pose_type == "unseen" and recipe.poses.unseen == 0 else 30
        assert base <= len(triples) <= 30 * len(grid.steps)
        for source, source_pose, target, target_pose in triples.tolist():
            assert source != target and source_pose != target_pose
            assert grid.split(source) == grid.split(target) == "evaluation"
            assert grid.pose_type(source_pose) == pose_type
            assert target_pose in grid.poses_of(target) and source_pose in grid.poses_of(target)


@pytest.mark.parametrize("evaluation, seen, unseen", [(1, 6, 4), (0, 6, 4), (2, 1, 0)])
def test_where_no_triple_can_be_the_list_is_empty(evaluation: int, seen: int, unseen: int) -> None:
    counts = {"identities": {"training": 3, "evaluation": evaluation}, "poses": {"seen": seen, "unseen": unseen}}
    assert Grid(tiny_dataset(**counts)).evaluation_triples("seen").shape == (0, 4)


def test_triples_are_fixed_by_their_seed() -> None:
    first, again = (Grid(tiny_dataset()).evaluation_triples("seen") for _ in range(2))
    other = Grid(tiny_dataset(triples={"count": 5, "seed": 1})).evaluation_triples("seen")
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_training_identities_have_no_unseen_poses() -> None:
    grid = Grid(tiny_dataset())
    assert list(grid.poses_of(0)) == list(range(6)) and list(grid.poses_of(3)) == list(range(10))
