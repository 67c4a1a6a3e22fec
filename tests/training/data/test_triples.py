"""Triples: what they must be (DSFFNet, section 4.1), and in which order they come."""

from itertools import islice

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
from training.data.triples import TripleOrder, epoch_triples
from training.data.vertex_bank import open_bank


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


@given(st.sampled_from([1, 2, 3, 6]), st.sampled_from([1, 2]), st.integers(0, 40))
def test_the_order_is_the_same_for_any_ranks_any_parts_and_any_start(ranks: int, parts: int, first: int) -> None:
    order = TripleOrder(identities=[3, 5, 8], poses=range(10, 17), batch=12, seed=2)
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
