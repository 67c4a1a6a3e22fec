"""Triples: what they must be (DSFFNet, section 4.1), and in which order they come."""

from itertools import islice
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.bodies import load_body
from datagen.common.errors import DatasetError, RecipeError
from datagen.generate import generate
from datagen.mesh.geometry import bounding_box
from datagen.poses import Poses
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset, open_dataset
from tests.support.recipes import mixed_dataset, tiny_dataset
from training.data.triples import Block, BlockOrder, Strips, TripleOrder, epoch_triples
from training.data.vertex_bank import open_bank


def blocks(
    *, identities: int, poses: int, height: int, width: int, held: float = 4.5, batch: int = 4, seed: int = 0
) -> BlockOrder:
    """The order of a grid whose shards have so many identities and poses; ``held``: tiles that a block holds."""
    rows, columns = Strips(np.arange(identities) // height), Strips(np.arange(poses) // width)
    tile = Block(rows, columns, meshes=0, mesh_bytes=1).tile
    block = Block(rows, columns, meshes=int(held * tile) + 1, mesh_bytes=384)
    return BlockOrder(range(identities), range(poses), block, batch=batch, seed=seed)


@given(st.integers(2, 12), st.integers(2, 30), st.integers(0, 5), st.integers(0, 9))
def test_an_epoch_shows_every_cell_once_as_truth(identities: int, poses: int, seed: int, epoch: int) -> None:
    triples = epoch_triples(identities=identities, poses=poses, seed=seed, epoch=epoch)
    source, source_pose, target, target_pose = triples.T
    assert len({(t, p) for t, p in zip(target, source_pose, strict=True)}) == identities * poses == len(triples)
    assert (source != target).all() and (source_pose != target_pose).all()
    for values, count in ((source, identities), (target, identities), (source_pose, poses), (target_pose, poses)):
        assert values.min() >= 0 and values.max() < count


def test_epochs_and_seeds_differ_and_repeat() -> None:
    def triples(seed: int, epoch: int) -> np.ndarray:
        return epoch_triples(identities=4, poses=9, seed=seed, epoch=epoch)

    assert np.array_equal(triples(0, 0), triples(0, 0))
    assert not np.array_equal(triples(0, 0), triples(0, 1)) and not np.array_equal(triples(0, 0), triples(1, 0))


GRIDS = st.fixed_dictionaries(
    {
        "identities": st.integers(2, 20),
        "poses": st.integers(2, 40),
        "height": st.integers(1, 6),
        "width": st.integers(1, 9),
        "held": st.floats(4, 80),
        "batch": st.integers(1, 4),
        "seed": st.integers(0, 3),
    }
)


@given(GRIDS, st.integers(0, 9))
def test_blocks_show_every_cell_once_as_truth_from_the_meshes_of_its_tile(grid: dict[str, Any], epoch: int) -> None:
    order = blocks(**grid)
    triples = order.epoch(epoch)
    source, source_pose, target, target_pose = triples.T
    assert len({(t, p) for t, p in zip(target, source_pose, strict=True)}) == order.cells == len(triples)
    assert (source != target).all() and (source_pose != target_pose).all()
    for values, count in ((source, order.identities), (target_pose, order.poses)):
        assert values.min() >= 0 and values.max() < len(count)
    rows, columns = order.block.rows.of, order.block.columns.of
    near: dict[tuple[int, int], set[int]] = {}  # of a row of shards in a column: the rows that it is paired with
    for s, p, t, q in triples.tolist():
        near.setdefault((rows[t], columns[p]), set()).add(rows[s])
        near.setdefault((-1, columns[p]), set()).add(columns[q])
    assert all(len(others) <= 3 for others in near.values()), "a group has two strips, or three"
    assert np.array_equal(triples, blocks(**grid).epoch(epoch)), "a function of its arguments"


def test_a_triple_of_blocks_is_distributed_as_one_of_the_full_shuffle() -> None:
    """Where shards are equally large: every other identity and every other pose alike often, together, too."""
    order = blocks(identities=6, poses=8, height=2, width=2)
    epochs = np.concatenate([order.epoch(number) for number in range(1500)])
    source, source_pose, target, target_pose = epochs.T
    for own, other, count in ((target, source, 6), (source_pose, target_pose, 8)):
        times = np.bincount(own * count + other, minlength=count * count).reshape(count, count)
        expected = len(epochs) / count / (count - 1)
        off = np.abs(times[~np.eye(count, dtype=bool)] - expected)
        assert times.diagonal().sum() == 0 and off.max() < 5 * expected**0.5, times
    both = np.bincount((source - target) % 6 * 8 + (target_pose - source_pose) % 8, minlength=48).reshape(6, 8)[1:, 1:]
    assert np.abs(both - both.mean()).max() < 5 * both.mean() ** 0.5


def test_a_mesh_of_blocks_is_source_and_target_once_an_epoch_on_average() -> None:
    order = blocks(identities=6, poses=8, height=2, width=2)
    epochs = np.concatenate([order.epoch(number) for number in range(400)])
    for identity, pose in ((0, 1), (2, 3)):
        times = np.bincount(epochs[:, identity] * 8 + epochs[:, pose], minlength=48) / 400
        assert np.abs(times - 1).max() < 5 / 20


@given(GRIDS)
def test_blocks_need_few_meshes_at_a_time_and_each_shard_for_a_while(grid: dict[str, Any]) -> None:
    """A lane has the triples of its stretch of tiles, none put off by more than the reach."""
    order = blocks(**grid)
    steps, width = order.steps_per_epoch, order.batch // order.lanes
    rows, columns = order.block.rows, order.block.columns
    mesh = rows.sizes.max() * columns.sizes.max()
    triples = order.epoch(0)[: steps * order.batch].reshape(steps, order.lanes, width, 4)
    for lane in range(order.lanes):
        _, pose, target, _ = triples[:, lane].reshape(-1, 4).T
        shard = rows.of[target] * len(columns.sizes) + columns.of[pose]
        (_, first), (_, last) = (np.unique(way, return_index=True) for way in (shard, shard[::-1]))
        assert (len(shard) - last - first).max() <= order.reach + 9 * mesh + 1


SHUFFLED = TripleOrder(identities=[3, 5, 8], poses=range(10, 17), batch=12, seed=2)
BLOCK = Block(Strips(np.arange(3)), Strips(np.arange(7) // 2), meshes=90, mesh_bytes=1)
IN_BLOCKS = BlockOrder([3, 5, 8], range(10, 17), BLOCK, batch=12, seed=2)


@pytest.mark.parametrize("order", [SHUFFLED, IN_BLOCKS], ids=["shuffled", "blocks"])
@given(st.sampled_from([1, 2, 3, 6]), st.sampled_from([1, 2]), st.integers(0, 40))
def test_the_order_is_the_same_for_any_ranks_any_parts_and_any_start(
    order: TripleOrder, ranks: int, parts: int, first: int
) -> None:
    shares = [order.batches(first_step=first, rank=rank, ranks=ranks, parts=parts) for rank in range(ranks)]
    together = [[part for share in shares for part in next(share)] for _ in range(4)]
    assert {len(part) for step in together for part in step} == {12 // (ranks * parts)}
    expected = [whole for (whole,) in islice(order.batches(first_step=0), first, first + 4)]
    assert all(np.array_equal(np.concatenate(a), b) for a, b in zip(together, expected, strict=True))
    assert set(np.unique(np.concatenate(expected)[:, [0, 2]])) <= {3, 5, 8}
    assert set(np.unique(np.concatenate(expected)[:, [1, 3]])) <= set(range(10, 17))


@pytest.mark.parametrize(("ranks", "parts"), [(1, 1), (2, 1), (1, 3), (2, 3)])
def test_places_say_where_in_the_whole_batch_a_part_lies(ranks: int, parts: int) -> None:
    order = TripleOrder(identities=range(3), poses=range(7), batch=6, seed=0)
    (whole,) = next(order.batches(first_step=5))
    for rank in range(ranks):
        share = next(order.batches(first_step=5, rank=rank, ranks=ranks, parts=parts))
        for place, part in zip(order.places(rank=rank, ranks=ranks, parts=parts), share, strict=True):
            assert np.array_equal(whole[place : place + len(part)], part)


def test_an_epoch_ends_where_no_whole_batch_is_left() -> None:
    order = TripleOrder(identities=range(3), poses=range(7), batch=4, seed=0)
    assert (order.cells, order.steps_per_epoch) == (21, 5)
    steps = [whole for (whole,) in islice(order.batches(first_step=0), 10)]
    for epoch in (steps[:5], steps[5:]):
        assert len({(row[2], row[1]) for row in np.concatenate(epoch).tolist()}) == 20


def test_a_batch_larger_than_the_grid() -> None:
    with pytest.raises(DatasetError, match="has 4 cells, fewer than a batch of 8"):
        TripleOrder(identities=[0, 1], poses=range(2), batch=8, seed=0)


def test_a_grid_without_another_identity() -> None:
    with pytest.raises(DatasetError, match="has 1 identities in 9 poses"):
        TripleOrder(identities=[4], poses=range(9), batch=2, seed=0)


def test_lanes_are_whole_parts_of_a_batch_that_ranks_share() -> None:
    order = blocks(identities=16, poses=60, height=1, width=2, held=20, batch=8)  # 120 tiles
    assert order.lanes == 4
    whole = order.memory()
    assert [order.memory(rank=rank, ranks=4) for rank in range(4)] == [whole // 4] * 4
    assert [order.memory(rank=rank, ranks=3) for rank in range(3)] == [whole // 2, whole // 2, whole // 4]
    assert order.memory(rank=5, ranks=8) == whole // 4 and blocks(identities=2, poses=4, height=1, width=1).lanes == 1
    assert TripleOrder(range(3), range(7), batch=8, seed=0).memory() is None


@pytest.mark.parametrize(
    ("poses", "said"),
    [
        (80, r"block holds 30 meshes of 0.4 kB, but 4 tiles .* have 65. Set it to .* or"),
        (8, "all 64 meshes .* leave it"),
    ],
)
def test_a_block_that_is_too_small_for_the_shards_is_refused(poses: int, said: str) -> None:
    with pytest.raises(RecipeError, match=said):
        blocks(identities=8, poses=poses, height=2, width=2, held=1.85)


@pytest.mark.parametrize("last", [1, 3, 5, 10])
def test_what_lies_in_a_short_last_shard_is_drawn_no_more_often(last: int) -> None:
    columns = Strips(np.arange(50 + last) // 10)
    block = Block(Strips(np.arange(24) // 2), columns, meshes=500, mesh_bytes=1)
    order = BlockOrder(range(24), range(50 + last), block, batch=6, seed=0)
    drawn = np.bincount(np.concatenate([order.epoch(number)[:, 3] for number in range(30)]), minlength=50 + last)
    share = drawn[50:].mean() / drawn[:50].mean()
    assert 0.4 < share < 1.15 and drawn.min() > 0


def test_ranks_that_cannot_share_equally_share_all_of_a_batch() -> None:
    order = TripleOrder(identities=range(3), poses=range(7), batch=8, seed=0)
    (whole,) = next(order.batches(first_step=1))
    shares = [next(order.batches(first_step=1, rank=rank, ranks=3, parts=2)) for rank in range(3)]
    assert [[len(part) for part in share] for share in shares] == [[2, 1], [2, 1], [1, 1]]
    assert np.array_equal(np.concatenate([part for share in shares for part in share]), whole)
    assert [order.places(rank=rank, ranks=3, parts=2) for rank in range(3)] == [[0, 2], [3, 5], [6, 7]]
    assert [order.share(rank=rank, ranks=3) for rank in range(3)] == [9 / 8, 9 / 8, 6 / 8]


def test_more_ranks_than_triples_are_refused() -> None:
    order = TripleOrder(identities=range(3), poses=range(7), batch=8, seed=0)
    with pytest.raises(RecipeError, match=r"training\.batch 8 is too small to be shared by 3 ranks in 4 parts each"):
        order.batches(first_step=0, ranks=3, parts=4)


@pytest.mark.parametrize("recipe", [tiny_dataset(), mixed_dataset()], ids=["one body", "mixed bodies"])
def test_truth_has_the_targets_identity_parameters_and_the_sources_pose_parameters(
    recipe: DatasetRecipe, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """On the parameters that the dataset stores, and on meshes that the body model makes of them anew."""
    dataset = generate(recipe, str(tmp_path_factory.mktemp("legs") / "legs.zarr"))
    dataset = open_dataset(dataset.url)
    identities, poses = dataset.identities("training"), dataset.grid.poses("seen")
    (triples,) = next(TripleOrder(identities, poses, batch=len(identities) * len(poses), seed=3).batches(first_step=0))
    batch = open_bank(dataset, identities).batch(triples)
    rotations = dataset.rotations()
    for row, (source, source_pose, target, target_pose) in enumerate(triples.tolist()):
        assert not np.array_equal(dataset.parameters(source), dataset.parameters(target)), "another identity"
        assert not np.array_equal(rotations[source_pose], rotations[target_pose]), "another pose"
        for mesh, identity, pose in (
            (batch.source, source, source_pose),
            (batch.target, target, target_pose),
            (batch.truth, target, source_pose),
        ):
            expected = made_anew(dataset, identity, pose)
            np.testing.assert_allclose(mesh[row, : len(expected)].numpy(), expected, atol=2e-6)
            assert (mesh[row, len(expected) :] == 0).all()


def made_anew(dataset: Dataset, identity: int, pose: int) -> np.ndarray:
    """A normalised mesh [vertex, 3] from the stored parameters of an identity and of a pose."""
    tree = (tuple(dataset.attributes[name]) for name in ("joints", "joint_parents"))
    poses = Poses(*tree, dataset.rotations()[pose : pose + 1])
    (vertices,) = load_body(dataset.recipe.body).vertices(dataset.parameters(identity), poses)
    return bounding_box(vertices).normalise(vertices)
