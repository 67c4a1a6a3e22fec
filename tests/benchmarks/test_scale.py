"""Laws of the simulated scheduler."""

from dataclasses import replace
from itertools import pairwise

import pytest

from benchmarks.datagen.scale import BODIES, Work, simulate

WORK = Work(meshes=100, driver=0.001, make=0.5, send=0.05, store=0.002, finish=0.0001)


WORKS = [body.work for body in BODIES.values()]


@pytest.mark.parametrize("work", WORKS, ids=BODIES)
def test_one_cpu_takes_the_sum(work: Work) -> None:
    """The driver works ahead of a CPU, but for the first shard; and alone after the last."""
    outcome = simulate(work, 50, nodes=1, cpus=1)
    assert outcome.seconds == pytest.approx(work.driver + 50 * (work.alone + work.finish))
    assert outcome.bottleneck == "CPUs"


@pytest.mark.parametrize("work", [WORK, *WORKS])
def test_more_nodes_are_never_slower(work: Work) -> None:
    taken = [simulate(work, 2000, nodes=nodes, cpus=4).seconds for nodes in (1, 2, 3, 5, 8, 20, 50, 100, 500)]
    assert all(after <= before * (1 + 1e-9) for before, after in pairwise(taken))


@pytest.mark.parametrize(
    ("slow", "bound", "each"),
    [
        ({"driver": 0.1}, "driver", 0.1),
        ({"store": 0.1}, "object store", 0.1),
        ({"send": 5.0}, "network", 5.0 / 20),
        ({}, "CPUs", WORK.alone / (20 * 4)),
    ],
)
def test_the_slowest_server_sets_the_pace(slow: dict[str, float], bound: str, each: float) -> None:
    """Beyond what one of them can do nothing helps; and it is named."""
    work, shards = replace(WORK, finish=0.0, **slow), 8000
    outcome = simulate(work, shards, nodes=20, cpus=4)
    assert outcome.bottleneck == bound
    assert outcome.seconds == pytest.approx(shards * each, rel=0.1)
    assert outcome.busy[bound] > 0.85 and all(share <= 1 + 1e-9 for share in outcome.busy.values())


def test_a_driver_that_is_slow_is_no_faster_with_more_nodes() -> None:
    work = replace(WORK, driver=0.05, finish=0.0)
    few, many = (simulate(work, 4000, nodes=nodes, cpus=4) for nodes in (10, 100))
    assert few.bottleneck == many.bottleneck == "driver"
    assert many.seconds == pytest.approx(few.seconds, rel=0.02)
