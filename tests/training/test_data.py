"""Triples: what they must be (DSFFNet, section 4.1), and in which order they come."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from datagen.errors import DatasetError
from datagen.mesh import bounding_box
from datagen.store import open_dataset
from training.data import TripleOrder, VertexBank, epoch_triples


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


@given(st.sampled_from([1, 2, 3, 6]), st.integers(0, 40))
def test_the_order_is_the_same_for_any_number_of_ranks_and_any_start(ranks: int, first: int) -> None:
    order = TripleOrder(identities=[3, 5, 8], poses=range(7), batch=6, seed=2)
    shares = [order.batches(first_step=first, rank=rank, ranks=ranks) for rank in range(ranks)]
    together = [np.concatenate([next(share) for share in shares]) for _ in range(8)]
    alone = order.batches(first_step=0)
    expected = [next(alone) for _ in range(first + 8)][first:]
    assert all(np.array_equal(a, b) for a, b in zip(together, expected, strict=True))
    assert set(np.unique(np.concatenate(together)[:, [0, 2]])) <= {3, 5, 8}


def test_a_batch_larger_than_the_grid() -> None:
    with pytest.raises(DatasetError, match="has 4 cells, fewer than a batch of 8"):
        TripleOrder(identities=[0, 1], poses=range(2), batch=8, seed=0)


def test_batches_hold_the_right_normalised_meshes(dataset: str) -> None:
    opened = open_dataset(dataset)
    bank = VertexBank(opened, opened.identities("evaluation"))
    batch = bank.batch(np.array([[3, 8, 4, 1], [4, 0, 3, 9]]))

    def unit(identity: int, pose: int) -> torch.Tensor:
        vertices = opened.vertices(identity, pose)
        return torch.from_numpy(bounding_box(vertices).normalise(vertices))

    for row, (source, source_pose, target, target_pose) in enumerate([(3, 8, 4, 1), (4, 0, 3, 9)]):
        assert torch.equal(batch.source[row], unit(source, source_pose))
        assert torch.equal(batch.target[row], unit(target, target_pose))
        assert torch.equal(batch.truth[row], unit(target, source_pose)), "the target's identity in the source's pose"
    assert batch.truth.abs().max() <= 1 + 1e-6
