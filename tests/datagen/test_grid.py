"""Splits, shards and evaluation triples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.grid import HOLE, MOST_MESHES, POSE_TYPES, Grid, GridArrays
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


def arrays_of(recipe: DatasetRecipe, topologies: int = 3) -> GridArrays:
    """The arrays of a grid whose identities take turns in so many topologies."""
    grid = Grid(recipe)
    return GridArrays(grid, [n % topologies for n in range(grid.identity_count)], [32] * topologies)


@given(recipes, st.integers(1, 3))
def test_shards_cover_every_mesh_once(recipe: DatasetRecipe, topologies: int) -> None:
    arrays = arrays_of(recipe, topologies)
    grid, shards = arrays.grid, arrays.shards()
    cells = [(identity, pose) for shard in shards for identity in shard.identities for pose in shard.poses]
    expected = [(who, pose) for who in range(grid.identity_count) for pose in grid.poses_of(who).tolist()]
    assert sorted(cells) == expected and len(cells) == sum(shard.rows for shard in shards) == grid.mesh_count
    assert len({shard.path for shard in shards}) == len(shards) == arrays.shard_count
    for identity in range(grid.identity_count):
        poses = grid.poses("seen") if grid.split(identity) == "training" else np.arange(grid.pose_count)
        assert grid.poses_of(identity).tolist() == poses.tolist()
    places, rows = arrays.places()
    assert (
        [tuple(place) for place in places.tolist()]
        == [shard.place for shard in shards]
        == sorted(shard.place for shard in shards)
    )
    assert rows.tolist() == [shard.rows for shard in shards]


@given(recipes)
def test_shards_lie_where_the_arrays_have_their_meshes(recipe: DatasetRecipe) -> None:
    arrays = arrays_of(recipe)
    for array in arrays.arrays:
        height, width = array.room
        assert 1 <= height * width <= max(width, recipe.store.poses_per_shard)
        assert height * width <= MOST_MESHES
        (first, end), *_ = arrays.grid.pose_spans(array.split)
        assert height == 1 or width == end - first, "several identities only where the poses of one fill no shard"
        for shard in array.shards():
            row, column = shard.place[2] * height, shard.place[3] * width
            assert array.identities[row : row + len(shard.identities)].tolist() == list(shard.identities)
            assert array.poses[column : column + len(shard.poses)].tolist() == list(shard.poses)
            for identity in shard.identities:
                found, place = arrays.row_of(identity)
                assert found is array and array.identities[place] == identity
        assert {pose: array.poses[column] for pose, column in array.columns.items()} == {p: p for p in array.columns}
        assert array.identities[-1] != HOLE != array.poses[-1]
    for who in (-1, arrays.grid.identity_count):
        with pytest.raises(KeyError):
            arrays.row_of(who)


@given(recipes)
def test_growing_leaves_everything_where_it_was(recipe: DatasetRecipe) -> None:
    step = Growth(training=2, evaluation=1, seen=3, unseen=4)
    old, new = arrays_of(recipe), arrays_of(recipe.model_copy(update={"growth": (*recipe.growth, step)}))
    before, after = old.grid, new.grid
    assert {shard.path: shard for shard in old.shards()}.items() <= {
        shard.path: shard for shard in new.shards()
    }.items()
    for identity in range(before.identity_count):
        assert before.split(identity) == after.split(identity)
        (array, row), (grown, place) = old.row_of(identity), new.row_of(identity)
        assert row == place and array.path == grown.path and array.room == grown.room
        assert np.array_equal(grown.poses[: len(array.poses)], array.poses)
    for pose_type in POSE_TYPES:
        lists = before.evaluation_triples(pose_type), after.evaluation_triples(pose_type)
        assert np.array_equal(lists[0], lists[1][: len(lists[0])]) and len(lists[1]) > len(lists[0])
    assert after.identity_count == before.identity_count + 3 and after.pose_count == before.pose_count + 7


@pytest.mark.parametrize(
    ("poses", "vertices", "room"),
    [(1000, 300, (1, 100)), (10, 300, (10, 10)), (30, 300, (3, 30)), (60, 300, (1, 60)), (400, 10**5, (1, 55)),
     (10, 10**5, (5, 10)), (3, 10**8, (1, 1))],
)  # fmt: skip
def test_a_shard_has_up_to_a_hundred_meshes_and_64_mebibytes(poses: int, vertices: int, room: tuple[int, int]) -> None:
    recipe = DatasetRecipe.model_validate({"body": {"family": "leg"}, "poses": {"seen": poses}})
    assert Grid(recipe).shard_shape("training", identities=16, vertices=vertices) == room


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
