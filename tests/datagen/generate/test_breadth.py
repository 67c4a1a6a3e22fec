"""Many identities: what each costs the driver; how many tasks, objects and requests they take; what is not redone."""

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
import zarr
from zarr.storage import FsspecStore

from datagen import generate as generation
from datagen.common.errors import DatasetError, StorageError
from datagen.generate import append, ensure_shards, generate, identities, inline, plan, shards
from datagen.generate.identities import describe_identities, joined
from datagen.recipe import DatasetRecipe
from datagen.store import open_dataset, reader, writer
from datagen.store.manifest import SoFar
from datagen.store.verify import find_faults
from tests.support.files import flip_bit, tree_hash
from tests.support.recipes import mixed_dataset, tiny_dataset


def broad(training: int, **changes: Any) -> DatasetRecipe:
    """Legs of 12 vertices in two poses, 10 identities a shard."""
    return tiny_dataset(
        **{
            "body": {"family": "leg", "rings": 4, "segments": 3},
            "identities": {"training": training, "evaluation": 0},
            "poses": {"seen": 2, "unseen": 0},
            "store": {"poses_per_shard": 20},
            **changes,
        }
    )


class Watched:
    """A runner in this process that notes its tasks, and stops after some of their results."""

    def __init__(self, *, stop_after: int | None = None) -> None:
        self.tasks: list[tuple[Any, ...]] = []
        self._left = stop_after

    def __call__(self, task: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        self.tasks += [(task.__name__, *each[2:]) for each in arguments]
        for result in inline(task, arguments):
            if task is ensure_shards and self._left is not None:
                if not self._left:
                    raise KeyboardInterrupt
                self._left -= 1
            yield result

    def of(self, name: str) -> list[Any]:
        """What the tasks of a name were given."""
        return [given for task, *given in self.tasks if task == name]


def test_memory_grows_by_little_with_each_identity() -> None:
    """What is kept of one: its parameters, its joints, its part of a shard; some 0.15 kB."""

    def taken(training: int) -> tuple[int, int]:
        tracemalloc.start()
        planned = plan.plan_of(broad(training))
        kept = planned, planned.arrays.shards()
        now, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(kept[1]) == training // 10
        return now, most

    taken(10)  # imports and caches
    few, many = taken(100), taken(500)
    assert (many[0] - few[0]) / 400 < 300 and (many[1] - few[1]) / 400 < 300


def test_a_task_makes_several_small_shards_and_each_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Watched()
    monkeypatch.setattr(shards, "_FEWEST_TASKS", 4)
    made = generate(broad(600), str(tmp_path / "x.zarr"), run=run)
    wanted = [shard.place for (some,) in run.of("ensure_shards") for shard, _ in some]
    assert wanted == [row.place for row in made.committed.shards] and len(wanted) == 60
    assert 4 <= len(run.of("ensure_shards")) <= 5
    objects = sum(path.is_file() for path in (tmp_path / "x.zarr").rglob("*"))
    assert objects <= 1.1 * 60 + 100


def test_shards_of_dear_meshes_are_tasks_of_their_own() -> None:
    recipe = tiny_dataset(body={"family": "clothed"})
    assert recipe.body.seconds_a_mesh * 4 > 0.5
    wanted = [(shard, None) for shard in plan.plan_of(tiny_dataset()).arrays.shards()]
    assert [len(some) for some in shards.batches(recipe, wanted)] == [1] * len(wanted)


def test_identities_described_in_blocks_in_any_order_are_those_described_at_once() -> None:
    recipe = mixed_dataset()
    blocks = [describe_identities("", recipe, numbers) for numbers in (range(6, 8), range(3), range(3, 6))]
    together, alone = joined(blocks), describe_identities("", recipe, range(8))
    assert together.topology_numbers.tolist() == alone.topology_numbers.tolist() == [0, 1, 2, 0, 1, 2, 0, 1]
    assert together.rig_numbers.tolist() == alone.rig_numbers.tolist()
    assert together.parameters.tobytes() == alone.parameters.tobytes()
    for one, other in zip(together.rigs, alone.rigs, strict=True):
        for name in ("weights", "kinds", "joints", "corrections"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


@pytest.mark.parametrize("task", ["describe_identities", "draw_rotations"])
def test_tasks_have_ended_when_what_they_give_cannot_be_used(task: str) -> None:
    """Before shards are made, too: whoever gets the error may begin again at once."""
    running = list[str]()

    def run(asked: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        running.append(asked.__name__)
        try:
            yield from inline(asked, arguments)
        finally:
            running.remove(asked.__name__)

    def shown(results: Iterator[tuple[int, Any]], **_: Any) -> Iterator[Any]:
        for _, result in results:
            if running == [task]:
                raise KeyboardInterrupt
            yield result

    recipe = tiny_dataset(identities={"training": 1100, "evaluation": 1}, poses={"seen": 1100, "unseen": 1})
    with pytest.raises(KeyboardInterrupt) as caught:
        plan.plan_of(recipe, run=run, progress=shown)
    assert caught.value and not running  # the error still refers to what was under way


@pytest.mark.parametrize("stop_after", [0, 2])
def test_what_was_made_before_an_interruption_is_neither_described_nor_read_again(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop_after: int
) -> None:
    url = str(tmp_path / "leg.zarr")
    with pytest.raises(KeyboardInterrupt):
        generate(tiny_dataset(), url, run=Watched(stop_after=stop_after))
    again, looked = Watched(), list[Any]()
    real = shards.existing_shard
    monkeypatch.setattr(shards, "existing_shard", lambda *given: looked.append(given[2].place) or real(*given))
    generate(tiny_dataset(), url, run=again)
    assert not again.of("describe_identities") and not again.of("draw_rotations")
    assert len(looked) == 12 - stop_after == len(again.of("ensure_shards"))
    assert tree_hash(url) == tree_hash(dataset)


def test_a_note_of_the_shards_so_far_is_kept_for_a_process_that_is_killed(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generation, "_SAVE_SECONDS", 0.0)
    monkeypatch.setattr(generation, "_SAVE_SHARE", 0)
    saved, real, url = list[int](), generation.save, str(tmp_path / "leg.zarr")

    def dying(url: str, recipe: DatasetRecipe, so_far: SoFar) -> None:
        if len(saved) == 3:
            raise SystemExit  # and no more is written
        saved.append(len(so_far.sound))
        real(url, recipe, so_far)

    monkeypatch.setattr(generation, "save", dying)
    with pytest.raises(SystemExit):
        generate(tiny_dataset(), url)
    assert saved == [1, 2, 3]
    monkeypatch.undo()
    run = Watched()
    generate(tiny_dataset(), url, run=run)
    assert sum(len(some) for (some,) in run.of("ensure_shards")) == 9 and tree_hash(url) == tree_hash(dataset)


def test_tasks_have_ended_when_the_lock_is_given_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a manifest of the shards so far cannot be saved, say, while others are being made."""
    seen, real = list[str](), generation.writing_alone

    @contextmanager
    def alone(url: str) -> Iterator[None]:
        with real(url):
            try:
                yield
            finally:
                seen.append("lock given back")

    def running(task: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        try:
            yield from inline(task, arguments)
        finally:
            if task is ensure_shards:
                seen.append("tasks ended")

    def full(url: str, recipe: DatasetRecipe, rows: Any) -> None:
        raise StorageError("the disk is full")

    monkeypatch.setattr(generation, "_SAVE_SECONDS", 0.0)
    monkeypatch.setattr(generation, "writing_alone", alone)
    monkeypatch.setattr(generation, "save", full)
    with pytest.raises(StorageError, match="the disk is full"):
        generate(tiny_dataset(), str(tmp_path / "leg.zarr"), run=running)
    assert seen == ["tasks ended", "lock given back"]


def test_few_poses_are_kept_for_the_next_identities_however_many_a_shard_has(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = tiny_dataset().poses.model_dump_json()
    monkeypatch.setattr(shards, "_kept", {})
    monkeypatch.setattr(shards, "_KEPT_POSES", 20)
    small = [shards._poses(recipe, range(start, start + 5)) for start in range(0, 20, 5)]
    assert all(shards._poses(recipe, range(start, start + 5)) is small[start // 5] for start in range(0, 20, 5))
    large = shards._poses(recipe, range(12))
    assert shards._poses(recipe, range(12)) is large and sum(map(len, shards._kept.values())) == 17
    shards._poses(recipe, range(30))
    assert not shards._kept, "not even one that is larger than all that is kept"


def test_a_shard_that_shrank_since_is_made_again_and_one_of_its_size_is_found_by_verify(
    dataset: str, tmp_path: Path
) -> None:
    url = tmp_path / "leg.zarr"
    with pytest.raises(KeyboardInterrupt):
        generate(tiny_dataset(), str(url), run=Watched(stop_after=3))
    first, second = (url / row.path for row in open_dataset(dataset).committed.shards[:2])
    first.write_bytes(first.read_bytes()[:-9])
    flip_bit(second)
    generate(tiny_dataset(), str(url))
    assert [fault.path for fault in find_faults(str(url))] == [str(second.relative_to(url))]


def test_appending_describes_and_looks_at_what_is_new_alone(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, described, asked = Watched(), list[int](), list[str]()
    real, sizes, leftovers = identities.identity_parameters, writer.stored_sizes, writer.list_leftovers
    there = {row.path for row in open_dataset(str(spoilable)).committed.shards}
    monkeypatch.setattr(writer, "stored_sizes", lambda group, paths: asked.extend(paths) or sizes(group, paths))
    looked, read_sizes = list[int](), reader.stored_sizes
    monkeypatch.setattr(
        reader, "stored_sizes", lambda group, paths: looked.append(len(paths)) or read_sizes(group, paths)
    )
    monkeypatch.setattr(writer, "list_leftovers", lambda group, paths: asked.extend(paths) or leftovers(group, paths))
    monkeypatch.setattr(identities, "identity_parameters", lambda *given: described.append(given[2]) or real(*given))
    append(str(spoilable), training=4, unseen=6, run=run)
    assert described == [5]
    assert {identity for (some,) in run.of("ensure_shards") for shard, _ in some for identity in shard.identities} == {
        3, 4, 5,  # the evaluation identities in the new poses
    }  # fmt: skip
    assert run.of("draw_rotations") == [[range(10, 12)]]
    new = {row.path for row in open_dataset(str(spoilable)).committed.shards} - there
    assert new and set(asked) == new
    assert looked[0] == len(there) and len(looked) == 2, "as it is opened to grow, and here to see what is new"


def test_a_grown_dataset_on_a_store_without_a_lock_is_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    url, looked, sizes = f"memory://{uuid4().hex}.zarr", list[int](), reader.stored_sizes
    generate(tiny_dataset(), url)
    monkeypatch.setattr(reader, "stored_sizes", lambda group, paths: looked.append(len(paths)) or sizes(group, paths))
    grown = append(url, training=4)
    assert len(looked) == 2 and looked[1] == len(grown.committed.shards) > looked[0]


def test_a_new_shard_that_is_gone_before_the_end_is_not_committed(spoilable: Path) -> None:
    def losing(task: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        yield from inline(task, arguments)
        if task is shards.ensure_shards:
            (spoilable / arguments[0][2][0][0].path).unlink()

    with pytest.raises(DatasetError, match="was changed by somebody else"):
        append(str(spoilable), training=4, run=losing)
    assert zarr.open_group(spoilable, mode="r").attrs["status"] == "building"
    append(str(spoilable), training=4)
    assert not list(find_faults(str(spoilable)))


def test_appending_refuses_what_changed_since_it_was_committed(spoilable: Path) -> None:
    flip_bit(spoilable / "rig/0/joints/c/0/0/0")
    before = tree_hash(spoilable)
    with pytest.raises(DatasetError, match=r"rig/0/joints/c/0/0/0: its hash .*verify .* --repair"):
        append(str(spoilable), training=4)
    assert tree_hash(spoilable) == before


def test_opening_takes_few_requests_however_many_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    url, asked = f"memory://{uuid4().hex}.zarr", list[str]()
    generate(broad(600), url)
    for name in ("get", "getsize", "exists", "list_prefix"):
        _counted(monkeypatch, name, asked)
    assert len(open_dataset(url).committed.shards) == 60
    assert len(asked) < 30 and "getsize" not in asked


def _counted(monkeypatch: pytest.MonkeyPatch, name: str, asked: list[str]) -> None:
    real = getattr(FsspecStore, name)

    def ask(self: FsspecStore, *given: Any, **options: Any) -> Any:
        asked.append(name)
        return real(self, *given, **options)

    monkeypatch.setattr(FsspecStore, name, ask)
