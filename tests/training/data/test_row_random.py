"""Numbers of a row depend on its place, step, seed and purpose alone, and are as random as they should be."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor

from datagen.store import open_dataset
from tests.support.recipes import LEG, PARTS, tiny_training
from training.data.augmentation.augment import Augmentation, _drawn
from training.data.batch import Batch
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.data.rigs.posed_bodies import PosedBodies
from training.data.rigs.rig_table import RigTable
from training.data.row_random import Purpose, RowRandom, _hashed
from training.data.triples import TripleOrder
from training.data.vertex_bank import open_bank

ROWS = 64
Draw = Callable[[RowRandom, int], Tensor]
DRAWS: dict[str, Draw] = {
    "uniform": lambda random, count: random.uniform(Purpose.SOURCE_POINTS, count, 3),
    "normal": lambda random, count: random.normal(Purpose.NOISE, count, 3),
    "below": lambda random, count: random.below(Purpose.EDGES, 6890, count),
}
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def random_of(**changes: Any) -> RowRandom:
    values: dict[str, Any] = {"seed": 1, "step": 2, "first": 0, "rows": ROWS, "device": "cpu"}
    return RowRandom.of_batch(**values | changes)


def largest_correlation(*rows: Tensor) -> float:
    """Of any two rows of numbers."""
    return float(torch.corrcoef(torch.stack(rows).double()).fill_diagonal_(0).abs().max())


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS.keys())
def test_a_batch_drawn_in_parts_has_the_numbers_of_the_whole(draw: Draw) -> None:
    whole = draw(random_of(), 50)
    for sizes in ((32, 32), (1, 40, 23), (1,) * ROWS):
        first = torch.tensor((0, *sizes)).cumsum(0).tolist()
        parts = [draw(random_of(first=own, rows=rows), 50) for own, rows in zip(first[:-1], sizes, strict=True)]
        assert torch.equal(torch.cat(parts), whole)
    assert not torch.equal(draw(random_of(first=ROWS), 50), whole)


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS.keys())
def test_a_draw_is_the_same_each_time_and_on_the_host(draw: Draw) -> None:
    random = random_of()
    first = draw(random, 50)
    assert len(random) == len(random.on_host()) == len(first) == ROWS and random.device == torch.device("cpu")
    assert torch.equal(draw(random, 50), first) and torch.equal(draw(random_of(), 50), first)
    assert random.on_host().device == torch.device("cpu") and torch.equal(draw(random.on_host(), 50), first)


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS.keys())
def test_some_rows_have_the_numbers_they_have_among_all(draw: Draw) -> None:
    whole, rows = draw(random_of(), 50), torch.tensor([5, 0, 63, 5])
    some = random_of().of(rows)
    assert len(some) == 4 and torch.equal(draw(some, 50), whole[rows])
    assert torch.equal(draw(some.on_host(), 50), whole[rows])
    assert torch.equal(draw(some.of(torch.tensor([2])), 50), whole[63:])


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS.keys())
def test_a_rows_numbers_begin_alike_however_many_are_drawn(draw: Draw) -> None:
    many = draw(random_of(), 500)
    for count in (0, 1, 37, 499):
        torch.testing.assert_close(draw(random_of(), count), many[:, :count], rtol=0, atol=1e-6)
        if many.dtype == torch.int64 or draw is DRAWS["uniform"]:
            assert torch.equal(draw(random_of(), count), many[:, :count])
    assert torch.equal(random_of().uniform(Purpose.HOLE), random_of().uniform(Purpose.HOLE, 3)[:, 0])


def test_other_steps_seeds_places_and_purposes_have_unrelated_numbers() -> None:
    """Of 65536 numbers a correlation of 0.02 is five deviations off."""
    changes: list[dict[str, Any]] = [
        {},
        *({"step": step} for step in (0, 1, 3, 2**20)),
        *({"seed": seed} for seed in (0, 2, 3, 2**40)),
        *({"first": first} for first in (1, ROWS, 2**20)),
        {"seed": 2, "step": 1},
    ]
    drawn = [random_of(**its).uniform(Purpose.NOISE, 1024).flatten() for its in changes]
    drawn += [random_of().uniform(purpose, 1024).flatten() for purpose in Purpose if purpose != Purpose.NOISE]
    assert largest_correlation(*drawn) < 0.02
    assert max(float((one == other).double().mean()) for one, other in pairwise(drawn)) < 1e-3


def test_no_purpose_goes_on_where_another_ends() -> None:
    """Of so many numbers below 2^31 about one pair is equal by chance."""
    numbers = torch.cat([random_of(rows=1).below(purpose, 2**31 - 1, 4096)[0] for purpose in Purpose])
    assert len(set(numbers.tolist())) > len(numbers) - 20


def test_rows_and_the_numbers_of_a_row_are_unrelated() -> None:
    numbers = random_of().uniform(Purpose.SOURCE_SUBSET, 4096)
    assert largest_correlation(*numbers) < 6 / 4096**0.5
    assert largest_correlation(*random_of(rows=4096).uniform(Purpose.SOURCE_SUBSET, ROWS).T) < 6 / 4096**0.5
    shifted = [numbers[:, shift : 4000 + shift].flatten() for shift in (0, 1, 2, 3, 32)]
    assert largest_correlation(*shifted) < 0.01


def test_uniform_numbers_are_even_between_nought_and_one() -> None:
    numbers = random_of(rows=256).uniform(Purpose.SOURCE_POINTS, 2048, 2)
    assert numbers.shape == (256, 2048, 2) and numbers.dtype == torch.float32
    assert numbers.min() >= 0 and numbers.max() < 1 and torch.equal(numbers * 2**24, (numbers * 2**24).round())
    precise = numbers.double()
    assert precise.mean() == pytest.approx(1 / 2, abs=0.002) and precise.var() == pytest.approx(1 / 12, rel=0.01)
    histogram = torch.histc(numbers, 256, 0, 1).double()
    assert float((histogram / histogram.mean() - 1).square().sum() * histogram.mean()) == pytest.approx(255, abs=120)
    for dims in ((1, 2), (0, 2)):  # of each row, and at each index
        means = precise.mean(dim=dims)
        deviation = (len(means) / precise.numel() / 12) ** 0.5
        assert (means - 1 / 2).abs().max() < 6 * deviation and means.std() == pytest.approx(deviation, rel=0.2)


def test_normal_numbers_are_normal() -> None:
    numbers = random_of(rows=256).normal(Purpose.NOISE, 1024, 3)
    assert numbers.shape == (256, 1024, 3) and numbers.dtype == torch.float32 and numbers.isfinite().all()
    precise = numbers.double().flatten()
    moments = [float(precise.pow(power).mean()) for power in (1, 2, 3, 4)]
    assert moments[:3] == pytest.approx([0, 1, 0], abs=0.015) and moments[3] == pytest.approx(3, abs=0.05)
    assert 4 < precise.abs().max() < 6
    evenly = (torch.special.ndtr(precise) * 64).long().clamp_max(63).bincount(minlength=64).double()
    assert float((evenly / evenly.mean() - 1).square().sum() * evenly.mean()) == pytest.approx(63, abs=60)
    assert largest_correlation(*numbers.flatten(0, 1).T) < 0.01


def test_whole_numbers_are_even_below_their_limit() -> None:
    numbers = random_of().below(Purpose.EDGES, 7, 1000, 2)
    assert numbers.shape == (ROWS, 1000, 2) and numbers.dtype == torch.int64
    counts = numbers.flatten().bincount(minlength=7).double()
    assert len(counts) == 7 and (counts / counts.mean() - 1).abs().max() < 0.03
    assert random_of().below(Purpose.EDGES, 1, 100).count_nonzero() == 0
    large = random_of().below(Purpose.EDGES, 2**31 - 1, 1000)
    assert large.min() >= 0 and 0.999 * 2**31 < large.max() < 2**31 - 1
    assert random_of().below(Purpose.HOLE_MIDDLE, 7).shape == (ROWS,)


def test_each_row_has_a_limit_of_its_own() -> None:
    limits = torch.tensor([1, 2, 3, 10, 30, 6890])
    random = random_of(rows=6)
    numbers = random.below(Purpose.TARGET_AGAIN, limits, 3000, 2)
    assert numbers.shape == (6, 3000, 2)
    for own, limit, row in zip(numbers, limits.tolist(), range(6), strict=True):
        assert own.min() >= 0 and own.max() < limit
        assert torch.equal(own, random.below(Purpose.TARGET_AGAIN, limit, 3000, 2)[row])
        counts = (own.flatten() * min(limit, 10) // limit).bincount(minlength=min(limit, 10)).double()
        assert (counts / counts.mean() - 1).abs().max() < 0.2
    assert (random.below(Purpose.TARGET_AGAIN, limits) < limits).all()


@pytest.mark.parametrize("first", [0, 12345, 2**31 - 2**15, 2**32 - 2**16])
def test_hashes_of_different_numbers_differ_in_half_of_their_bits(first: int) -> None:
    numbers = torch.arange(first, first + 2**16)
    hashes = _hashed(numbers.clone())
    assert len(set(hashes.tolist())) == 2**16 and hashes.min() >= 0 and hashes.max() < 2**32
    bits = torch.arange(32)
    for flipped in range(32):
        changed = (_hashed(numbers ^ 1 << flipped) ^ hashes)[:, None] >> bits & 1
        assert 12 <= changed.sum(dim=1).double().mean() <= 20
        assert (changed.double().mean(dim=0) - 1 / 2).abs().max() < 0.1, "each of the bits, half of the time"


def test_hashes_are_those_of_plain_whole_numbers() -> None:
    """So that a training goes on as it began with other versions of torch, too."""

    def hashed(number: int) -> int:
        for shift, factor in ((16, 0x21F0AAAD), (15, 0x735A2D97)):
            number = (number ^ number >> shift) * factor % 2**32
        return number ^ number >> 15

    numbers = torch.arange(0, 2**32, 2**22 + 12345)
    assert _hashed(numbers.clone()).tolist() == [hashed(number) for number in numbers.tolist()]


@pytest.mark.gpu
@needs_cuda
def test_cuda_draws_the_same_bits() -> None:
    here, there = random_of(), random_of(device="cuda")
    rows = torch.tensor([5, 0, 63])
    limits = torch.arange(1, ROWS + 1) * 1000
    assert there.device.type == "cuda" and there.on_host().device.type == "cpu"
    for purpose in Purpose:
        drawn = there.uniform(purpose, 1000, 3)
        assert drawn.device.type == "cuda" and torch.equal(drawn.cpu(), here.uniform(purpose, 1000, 3))
        assert torch.equal(there.of(rows).uniform(purpose, 1000, 3), drawn[rows.cuda()])
        assert torch.equal(there.on_host().uniform(purpose, 1000, 3), drawn.cpu())
        assert torch.equal(there.below(purpose, 6890, 1000).cpu(), here.below(purpose, 6890, 1000))
        assert torch.equal(there.below(purpose, limits.cuda(), 1000).cpu(), here.below(purpose, limits, 1000))
        torch.testing.assert_close(there.normal(purpose, 1000).cpu(), here.normal(purpose, 1000), rtol=0, atol=1e-5)


def augmented(dataset: str, *, step: int, device: str) -> Batch:
    """A batch of the parts network with all that a recipe can do to it."""
    legs = open_dataset(dataset)
    identities = legs.identities("training")
    changes = {"turn": 25, "lean": 40, "source_holes": 0.5, "points": 0.5, "proportions": 0.2, "source_noise": 0.1}
    recipe = tiny_training(**{**PARTS, "augmentation": {"subset": 24, **changes}})
    (triples,) = next(TripleOrder(identities, legs.grid.poses("seen"), batch=16, seed=1).batches(first_step=step))
    batch = open_bank(legs, identities).batch(triples).to(device)
    return Augmentation(recipe, RigTable(BodiesAtRest(legs, identities), LEG, device=device))(
        triples, batch, step=step, first=0
    )


def alike(one: Batch, other: Batch) -> None:
    for name in ("source", "target", "truth"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=0, atol=1e-4)
    assert one.source_rows is not None and one.target_rows is not None and one.surfaces and other.surfaces
    assert other.source_rows is not None and torch.equal(one.source_rows, other.source_rows)
    assert other.target_rows is not None and torch.equal(one.target_rows, other.target_rows)
    assert torch.equal(one.surfaces[0].near, other.surfaces[0].near)


@pytest.mark.gpu
@needs_cuda
@pytest.mark.parametrize("most_sampled", [1024, 10], ids=["alike", "by area"])
@pytest.mark.parametrize("step", [2, 3, 5, 9])
def test_cuda_augments_as_the_cpu_does(
    dataset: str, monkeypatch: pytest.MonkeyPatch, step: int, most_sampled: int
) -> None:
    """At steps where it is not for rounding to say which of a round leg's vertices are the nearest to a hole."""
    monkeypatch.setattr("training.data.rigs.rig_table._DENSE", most_sampled)
    here, there = (augmented(dataset, step=step, device=device) for device in ("cpu", "cuda"))
    assert there.source.device.type == "cuda"
    alike(here, there.to("cpu"))


@pytest.mark.gpu
@needs_cuda
def test_cuda_recombines_poses_as_the_cpu_does(dataset: str) -> None:
    legs = open_dataset(dataset)
    identities = legs.identities("training")
    recipe = tiny_training(**{**PARTS, "augmentation": {"subset": 24, "turn": 25, "points": 0.5, "recombined": 0.5}})
    (triples,) = next(TripleOrder(identities, legs.grid.poses("seen"), batch=16, seed=1).batches(first_step=0))
    batch = open_bank(legs, identities).batch(triples)
    batches = []
    for device in ("cpu", "cuda"):
        bodies = BodiesAtRest(legs, identities)
        rigs, posed = RigTable(bodies, LEG, device=device), PosedBodies(bodies, device=device)
        batches.append(Augmentation(recipe, rigs, posed)(triples, batch.to(device), step=2, first=0).to("cpu"))
    alike(*batches)
    for one, other in zip(*(its.turns or () for its in batches), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)


@pytest.mark.parametrize("areas", [False, True])
def test_the_same_vertices_are_drawn_however_the_batch_is_padded(areas: bool) -> None:
    """Keys of 24 bits are often alike among thousands: what decides must not be how a library sorts."""
    counts = torch.tensor([[6_890]])
    for step in range(40):
        drawn = []
        for rows in (6_890, 40_000):
            random = RowRandom.of_batch(1, step, first=0, rows=1, device="cpu")
            about = torch.full((1, rows), 1e-4) if areas else None
            purposes = (Purpose.SOURCE_SUBSET, Purpose.SOURCE_AGAIN)
            drawn.append(_drawn(random, purposes, counts, rows, 512, areas=about))
        assert torch.equal(*drawn) and len(drawn[0].unique()) == 512 and int(drawn[0].max()) < 6_890
