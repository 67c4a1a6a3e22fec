"""Generation as a pure function: any order, any interruption, any number of writers give the same bytes."""

import importlib.metadata
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datagen import generate as generation
from datagen.common.errors import BodyError, DatasetError
from datagen.generate import ensure_shards, generate, inline, make_shard, shards
from datagen.generate.plan import head_of, plan_of
from datagen.recipe import DatasetRecipe
from datagen.store import open_dataset
from datagen.store.location import writing_alone
from datagen.store.manifest import commit, table_of
from datagen.store.objects import read_bytes, write_bytes
from datagen.store.schema import open_group
from datagen.store.verify import find_faults
from tests.support.files import tree_hash
from tests.support.recipes import mixed_dataset, shards_of, tiny_dataset, vertices_of


class Interrupted(Exception):
    pass


def interrupted_runner(order: list[int], stop_after: int) -> generation.Runner:
    """Makes shards one by one in a given order and dies after some of them."""

    def run(task: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        if task is not ensure_shards:
            yield from inline(task, arguments)
            return
        alone = [(url, recipe, [wanted]) for url, recipe, some in arguments for wanted in some]
        for count, place in enumerate(place for place in order if place < len(alone)):
            if count == stop_after:
                raise Interrupted
            yield task(*alone[place])
        raise Interrupted

    return run


@given(st.permutations(range(12)), st.integers(0, 11), st.integers(0, 3))
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_order_and_any_interruption_give_the_same_bytes(
    dataset: str, tmp_path_factory: pytest.TempPathFactory, order: list[int], stop_after: int, again: int
) -> None:
    assert len(shards_of(tiny_dataset())) == 12
    url = str(tmp_path_factory.mktemp("interrupted") / "leg.zarr")
    for stop in (stop_after, again):
        with pytest.raises(Interrupted):
            generate(tiny_dataset(), url, run=interrupted_runner(order, stop))
        with pytest.raises(DatasetError, match="incomplete"):
            open_dataset(url)
    generate(tiny_dataset(), url)
    assert tree_hash(url) == tree_hash(dataset)


def test_an_existing_shard_is_not_made_again(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_group(str(spoilable), mode="r+").attrs["status"] = "building"
    made: list[Any] = []
    monkeypatch.setattr(shards, "make_shard", lambda recipe, shard: made.append(shard) or make_shard(recipe, shard))
    (spoilable / "grid/training/0/vertices/c/1/1/0/0").unlink()
    generate(tiny_dataset(), str(spoilable))
    assert [(shard.identities, shard.poses) for shard in made] == [((1,), range(4, 6))]


@pytest.mark.parametrize("at_once", [1, 64, 96])
def test_meshes_made_few_at_a_time_give_the_same_bytes(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    """One, two and three of a shard's four poses."""
    monkeypatch.setattr(shards, "VERTICES_AT_ONCE", at_once)
    shard = shards_of(tiny_dataset())[0]
    assert [len(some) for some, _ in make_shard(tiny_dataset(), shard)] == {1: [1] * 4, 64: [2, 2], 96: [3, 1]}[at_once]
    assert tree_hash(generate(tiny_dataset(), str(tmp_path / "leg.zarr")).url) == tree_hash(dataset)


@pytest.mark.parametrize("recipe", [tiny_dataset(store={"poses_per_shard": 20}), mixed_dataset()])
def test_blocks_do_not_show_where_shards_hold_several_identities_or_topologies_differ(
    recipe: DatasetRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = generate(recipe, str(tmp_path / "whole.zarr")).url
    monkeypatch.setattr(shards, "VERTICES_AT_ONCE", 64)
    assert tree_hash(generate(recipe, str(tmp_path / "blocks.zarr")).url) == tree_hash(whole)


def test_two_generators_on_one_dataset(tmp_path: Path) -> None:
    url = str(tmp_path / "leg.zarr")
    with writing_alone(url), pytest.raises(DatasetError, match="another process is writing to"):
        generate(tiny_dataset(), url)
    assert not Path(url).exists()


@pytest.mark.parametrize("cut", [0, 1])
def test_two_generators_on_a_store_without_a_lock(dataset: str, monkeypatch: pytest.MonkeyPatch, cut: int) -> None:
    """One that has begun meanwhile writes its empty manifest over the finished one's, with or without the root."""
    url, real, seen = f"memory://{uuid4().hex}.zarr", generation.finish, list[DatasetError]()

    def finish(*given: Any, **how: Any) -> None:
        real(*given, **how)
        if not seen:
            group = open_group(url, mode="r+")
            root = read_bytes(group, "zarr.json") or b""
            commit(group, table_of([]), {"status": "building"})
            if cut:  # the manifest is written before the root
                write_bytes(group, "zarr.json", root)
            with pytest.raises(DatasetError) as caught:
                open_dataset(url)
            seen.append(caught.value)

    monkeypatch.setattr(generation, "finish", finish)
    made = generate(tiny_dataset(), url)
    assert ["status 'building'", "not the one that was committed"][cut] in str(seen[0])
    assert np.array_equal(made.vertices(3), open_dataset(dataset).vertices(3)) and not list(find_faults(url))


def test_sigkill_while_writing(dataset: str, tmp_path: Path) -> None:
    """Killed at several moments, then finished by the same command: the undisturbed bytes."""
    url = tmp_path / "leg.zarr"
    code = (
        "from datagen.generate import generate; from tests.support.recipes import shards_of, tiny_dataset; import sys;"
        "generate(tiny_dataset(), sys.argv[1])"
    )
    for shards_before_kill in (1, 3, 6):
        process = subprocess.Popen([sys.executable, "-c", code, str(url)], cwd=Path(__file__).parents[3])
        while process.poll() is None and len(list(url.rglob("vertices/c/*/*/0/0"))) < shards_before_kill:
            time.sleep(0.002)
        assert process.poll() is None, "it ended before it could be killed"
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    generate(tiny_dataset(), str(url))
    assert tree_hash(url) == tree_hash(dataset) and not list(find_faults(str(url)))


def test_concurrent_writers_of_different_shards(dataset: str, tmp_path: Path) -> None:
    """What Ray's tasks do, with threads: each writes whole shards, and nothing is lost."""

    def threaded(task: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        results: list[Any] = [None] * len(arguments)
        threads = [
            threading.Thread(target=lambda i=i, a=a: results.__setitem__(i, task(*a))) for i, a in enumerate(arguments)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return iter(results)

    generate(tiny_dataset(), str(tmp_path / "leg.zarr"), run=threaded)
    assert tree_hash(tmp_path / "leg.zarr") == tree_hash(dataset)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_body_that_gives_non_finite_meshes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: float) -> None:
    from datagen.bodies.leg import LegModel

    real = LegModel.vertices

    def broken(self: LegModel, parameters: Any, poses: Any) -> Any:
        vertices = real(self, parameters, poses)
        vertices[-1, 0, 0] = bad
        return vertices

    monkeypatch.setattr(LegModel, "vertices", broken)
    with pytest.raises(BodyError, match=r"identity 0 .*in pose 3\."):
        generate(tiny_dataset(), str(tmp_path / "leg.zarr"))


def test_a_body_that_gives_a_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from datagen.bodies.leg import LegModel

    real = LegModel.vertices
    monkeypatch.setattr(LegModel, "vertices", lambda self, parameters, poses: real(self, parameters, poses) * 0)
    with pytest.raises(BodyError, match="degenerate"):
        generate(tiny_dataset(), str(tmp_path / "leg.zarr"))


def test_more_identities_leave_the_first_ones_as_they_were() -> None:
    small, large = tiny_dataset(), tiny_dataset(identities={"training": 5, "evaluation": 2})
    for number in (0, 2):
        small_shard, large_shard = (shards_of(recipe)[number * 2] for recipe in (small, large))
        assert np.array_equal(vertices_of(small, small_shard), vertices_of(large, large_shard))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"identities": {"training": 3, "evaluation": 1}}, "only 0 of seen poses and 0 of unseen poses"),
        ({"triples": {"count": 90}}, "asks for 90 evaluation triples, but there are only 72 of unseen poses"),
        ({"identities": {"training": 3, "evaluation": 1}, "triples": {"count": 0}}, ""),
        ({}, ""),
    ],
)
def test_too_few_evaluation_triples_are_warned_of(
    caplog: pytest.LogCaptureFixture, changes: dict[str, Any], says: str
) -> None:
    plan_of(tiny_dataset(**changes))
    assert len(caplog.messages) == bool(says) and says in "".join(caplog.messages)


def test_packages_that_are_not_installed_are_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine with a GPU and no body models."""
    installed = importlib.metadata.version

    def version(name: str) -> str:
        if name == "anny":
            raise importlib.metadata.PackageNotFoundError(name)
        return installed(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    packages = head_of("memory://x", tiny_dataset()).provenance["packages"]
    assert "anny" not in packages and packages["numpy"] == np.__version__
