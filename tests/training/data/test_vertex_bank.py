"""The vertex bank: the same batches from memory and from a stream, which stays bounded."""

import re
import threading
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen.common import resources
from datagen.common.errors import DatasetError, RecipeError
from datagen.generate import generate
from datagen.store import Dataset, open_dataset, reader
from tests.support.files import flip_bit, truncate
from tests.support.recipes import mixed_dataset, tiny_dataset, tiny_training
from tests.training.data.test_batch import same
from training.data.batch import Batch
from training.data.cache_policy import Room, choose, room_of
from training.data.prefetch import Share
from training.data.triples import TripleOrder, order_of
from training.data.vertex_bank import VertexBank, open_bank
from training.objectives.losses import transfer_loss

CACHES = ("device", "stream")


@pytest.fixture(scope="module", params=["one body", "mixed bodies"])
def legs(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """180 or 300 training meshes: more than the fewest that a stream holds, 64."""
    recipe = tiny_dataset() if request.param == "one body" else mixed_dataset()
    recipe = recipe.model_copy(update={"poses": recipe.poses.model_copy(update={"seen": 60})})
    return open_dataset(generate(recipe, str(tmp_path_factory.mktemp("legs") / "legs.zarr")).url)


def training_bank(dataset: Dataset, cache: Any = "device", **options: Any) -> VertexBank:
    return open_bank(dataset, dataset.identities("training"), cache=cache, **options)


def steps(
    bank: VertexBank, dataset: Dataset, *, count: int, first: int = 0, parts: int = 2, order: TripleOrder | None = None
) -> list[tuple[Share, list[Batch]]]:
    order = order or TripleOrder(dataset.identities("training"), dataset.grid.poses("seen"), batch=12, seed=5)
    shares = islice(bank.prefetch(order.batches(first_step=first, parts=parts)), count)
    return [(share, [bank.batch(triples) for triples in share]) for share in shares]


def equal_steps(one: list[tuple[Share, list[Batch]]], other: list[tuple[Share, list[Batch]]]) -> bool:
    return len(one) == len(other) and all(
        all(np.array_equal(a, b) for a, b in zip(shares, others, strict=True))
        and all(same(a, b) for a, b in zip(batches, their, strict=True))
        for (shares, batches), (others, their) in zip(one, other, strict=True)
    )


def test_both_caches_give_the_same_bits_in_the_same_order(legs: Dataset) -> None:
    expected = steps(training_bank(legs), legs, count=36, first=4)
    for memory in (None, 0):  # all meshes, and 64 at a time
        streamed = training_bank(legs, "stream", memory=memory)
        assert streamed.place == "stream" and equal_steps(steps(streamed, legs, count=36, first=4), expected)
        assert all(same(streamed.batch(share[0]), batches[0]) for share, batches in expected[:5]), "not prefetched"
        streamed.close()


def test_blocks_give_the_same_bits_whatever_memory_holds(legs: Dataset) -> None:
    order = order_of(tiny_training(block="0.06MB", batch=12), legs)
    expected = steps(training_bank(legs), legs, count=36, first=4, order=order)
    for memory in (None, 0):  # the block, and 64 meshes
        streamed = training_bank(legs, "stream", memory=memory, block=order.memory())
        assert equal_steps(steps(streamed, legs, count=36, first=4, order=order), expected), streamed.where
        assert ("of the block: shards are read more" if memory == 0 else "read about once") in streamed.where
        streamed.close()


@pytest.mark.parametrize("shape", [(8, 64), (80, 4)], ids=["a shard of one identity", "of several"])
@pytest.mark.parametrize("ranks", [1, 2])
def test_blocks_read_each_shard_about_once_an_epoch(
    shape: tuple[int, int], ranks: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    identities, poses = shape
    counts = {"identities": {"training": identities, "evaluation": 0}, "poses": {"seen": poses, "unseen": 0}}
    recipe = tiny_dataset(**counts, triples={"count": 0}, store={"poses_per_shard": 4 if poses == 64 else 8})
    dataset = open_dataset(generate(recipe, str(tmp_path / "legs.zarr")).url)
    order = order_of(tiny_training(block="60kB", batch=8), dataset)
    asked: list[str] = []
    real = reader.read_bytes
    monkeypatch.setattr(reader, "read_bytes", lambda group, path, **how: asked.append(path) or real(group, path, **how))
    for rank in range(ranks):
        bank = training_bank(dataset, "stream", block=order.memory(rank=rank, ranks=ranks))
        epoch = islice(order.batches(first_step=0, rank=rank, ranks=ranks), order.steps_per_epoch)
        for share in bank.prefetch(epoch):  # which would read ahead into the next one, how far depends on the machine
            bank.batch(share[0])
        bank.close()
    assert len(dataset.sizes) == (128 if poses == 64 else 40) and set(asked) == set(dataset.sizes)
    assert len(asked) <= 1.2 * len(dataset.sizes), len(asked) / len(dataset.sizes)


@pytest.mark.gpu
def test_a_gpu_gets_the_same_bits_from_both_caches(legs: Dataset) -> None:
    expected = steps(training_bank(legs), legs, count=20)
    device = torch.device("cuda", 0)
    for cache, memory in (("device", None), ("stream", None), ("stream", 0)):
        bank = training_bank(legs, cache, device=device, memory=memory)
        found = steps(bank, legs, count=20)
        assert all(batch.truth.device == device for _, batches in found for batch in batches)
        there = [(share, [batch.to("cpu") for batch in batches]) for share, batches in found]
        assert equal_steps(there, expected), bank.where
        bank.close()


@pytest.mark.gpu
def test_a_gpu_that_holds_the_meshes_is_not_waited_for(legs: Dataset) -> None:
    """torch raises where the processor would wait for the GPU, in the batch and in both losses."""
    bank = training_bank(legs, "device", device="cuda")
    order = TripleOrder(legs.identities("training"), range(60), batch=12, seed=5)
    shares = list(islice(order.batches(first_step=0), 3))
    for step, (triples,) in enumerate(shares):  # the first works out how each topology's edges touch
        torch.cuda.set_sync_debug_mode("error" if step else "default")
        try:
            batch = bank.batch(triples)
            prediction = batch.target.clone().requires_grad_()
            loss, _ = transfer_loss(
                prediction, truth=batch.truth, target=batch.target, edges=batch.edges, counts=batch.target_counts
            )
            loss.backward()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    bank.close()


def test_a_stream_holds_no_more_than_it_may(legs: Dataset) -> None:
    bank = training_bank(legs, "stream", memory=0)
    assert len(bank) == 60 * len(legs.identities("training")) > 64
    steps(bank, legs, count=25)
    assert f"{12 * 64 * int(max(map(legs.vertex_count, legs.identities('training')))) / 1e3:,.1f} kB held" in bank.where
    bank.close()
    threads = [thread.name for thread in threading.enumerate()]
    assert not any(name.startswith(("stream", "lookahead")) for name in threads), threads


def test_a_batch_larger_than_a_streams_memory(legs: Dataset) -> None:
    bank = training_bank(legs, "stream", memory=0)
    (triples,) = next(TripleOrder(legs.identities("training"), range(60), batch=60, seed=0).batches(first_step=0))
    with pytest.raises(RecipeError, match=r"streaming has memory for 64 .*Lower training\.batch"):
        bank.batch(triples)
    bank.close()


def test_a_bank_knows_what_it_does_not_have(dataset: str) -> None:
    bank = training_bank(open_dataset(dataset))
    with pytest.raises(KeyError, match="identity 3 in pose 1"):
        bank.batch(np.array([[0, 0, 3, 1]]))
    with pytest.raises(KeyError, match="identity 1 in pose 9"):
        bank.batch(np.array([[0, 9, 1, 1]]))


@pytest.mark.parametrize("cache", CACHES)
@pytest.mark.parametrize("damage", [flip_bit, truncate, Path.unlink], ids=["bit flip", "truncated", "missing"])
def test_a_damaged_shard_is_the_datasets_own_error(spoilable: Path, cache: str, damage: Any) -> None:
    opened = open_dataset(str(spoilable))
    for shard in (spoilable / "grid/training/0/vertices/c/1").glob("*/0/0"):
        if shard.is_file():
            damage(shard)
    with pytest.raises(DatasetError, match=r"shard grid/training/0/vertices/c/1/0/0/0 is .*verify .* --repair"):
        steps(training_bank(opened, cache), opened, count=2)


@pytest.mark.parametrize(
    ("cache", "room", "place", "why"),
    [
        ("auto", Room("device memory", 80 * 10**9, 0.4), "device", r"device memory: 1.0 GB of 80.0 GB free$"),
        ("auto", Room("device memory", 2 * 10**9, 0.4), "stream", r"1.0 GB are too much for the device memory \(2.0"),
        ("auto", Room("memory", 21 * 10**8, 0.5), "device", r"memory: 1.0 GB of 2.1 GB free$"),
        ("auto", Room("memory", 19 * 10**8, 0.5), "stream", r"streamed, 1.0 GB in all: 1.0 GB are .* \(1.9 GB free"),
        ("auto", Room("memory", 10**10, 0.5, sharers=4), "device", r"\(4 processes: 4.0 GB\)$"),
        ("auto", Room("memory", 10**10, 0.5, sharers=8), "stream", r"8.0 GB are too much"),
        ("device", Room("memory", 11 * 10**8, 0.5), "device", r"memory: 1.0 GB of 1.1 GB free$"),
        ("stream", Room("memory", 10**11, 0.5), "stream", r"as the recipe says$"),
    ],
)
def test_meshes_that_take_more_than_their_share_are_streamed(cache: Any, room: Room, place: str, why: str) -> None:
    """A gigabyte of them; a place that was asked for is taken though it gets tight."""
    choice = choose(cache, 10**9, room)
    assert choice.place == place and re.search(why, choice.why), choice.why


def test_a_device_that_was_asked_for_and_is_too_small_is_refused() -> None:
    with pytest.raises(RecipeError, match=r"'device', but 1.0 GB are .*900.0 MB free.*training.cache=auto"):
        choose("device", 10**9, Room("memory", 9 * 10**8, 0.5))


def test_the_limit_of_a_container_counts(tmp_path: Path) -> None:
    for name, value in {"max": "8000", "current": "5000", "stat": "anon 3000\ninactive_file 1500\n"}.items():
        (tmp_path / f"memory.{name}").write_text(value)
    assert resources.container_memory(tmp_path) == 4500
    (tmp_path / "memory.max").write_text("max\n")
    assert resources.container_memory(tmp_path) > 10**15


def test_what_is_free_here_is_known() -> None:
    assert 0 < room_of(torch.device("cpu")).free < 10**15
