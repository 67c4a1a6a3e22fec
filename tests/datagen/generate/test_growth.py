"""Appending to a dataset: what is there stays, and the result is what the grown recipe makes from nothing."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.bodies import load_body
from datagen.common.errors import DatasetError
from datagen.generate import append, ensure_shards, generate, inline, repair
from datagen.store import open_dataset
from datagen.store.verify import find_faults
from tests.support.files import tree_hash
from tests.support.recipes import mixed_dataset, tiny_dataset


def shard_files(url: Path) -> dict[str, int]:
    return {str(path.relative_to(url)): path.stat().st_mtime_ns for path in url.rglob("vertices/c/*/*/0/0")}


GROWTH: list[dict[str, int]] = [
    {"training": 5},
    {"evaluation": 3},
    {"seen": 9},
    {"unseen": 11},
    {"training": 4, "seen": 7, "unseen": 5},
]


@pytest.mark.parametrize("totals", GROWTH, ids=str)
def test_it_equals_the_grown_recipe_made_from_nothing_and_touches_no_shard(
    spoilable: Path, tmp_path: Path, totals: dict[str, int]
) -> None:
    before, old = shard_files(spoilable), open_dataset(str(spoilable))
    meshes = {identity: old.vertices(identity) for identity in range(5)}
    grown = append(str(spoilable), **totals)
    after = shard_files(spoilable)
    assert before.items() <= after.items() and len(after) > len(before)
    fresh = generate(grown.recipe, str(tmp_path / "fresh.zarr"))
    assert tree_hash(spoilable) == tree_hash(tmp_path / "fresh.zarr") and fresh.uuid == grown.uuid != old.uuid
    for identity, vertices in meshes.items():
        assert np.array_equal(grown.vertices(identity, old.grid.poses_of(identity)), vertices)
    assert not list(find_faults(str(spoilable)))


def test_growing_twice(spoilable: Path, tmp_path: Path) -> None:
    append(str(spoilable), seen=9)
    grown = append(str(spoilable), training=6, unseen=7)
    counts = grown.grid.identity_count, grown.grid.pose_count
    assert counts == (8, 16) and len(grown.recipe.growth) == 2
    generate(grown.recipe, str(tmp_path / "fresh.zarr"))
    assert tree_hash(spoilable) == tree_hash(tmp_path / "fresh.zarr")
    assert len(grown.evaluation_triples("seen")) == 15, "each step adds a list, the first stays as it was"


def test_the_same_totals_again_change_nothing(spoilable: Path) -> None:
    append(str(spoilable), training=5)
    before = {path: path.stat().st_mtime_ns for path in spoilable.rglob("*")}
    append(str(spoilable), training=5)
    assert {path: path.stat().st_mtime_ns for path in spoilable.rglob("*")} == before


class Interrupted(Exception):
    pass


@pytest.mark.parametrize("stop_after", [0, 1, 4])
def test_interrupted_it_goes_on_with_the_same_call(spoilable: Path, tmp_path: Path, stop_after: int) -> None:
    other = tmp_path / "undisturbed.zarr"
    shutil.copytree(spoilable, other)
    append(str(other), seen=9, training=4)

    def dying(task: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        if task is not ensure_shards:
            yield from inline(task, arguments)
            return
        for number, wanted in enumerate(wanted for _, _, some in arguments for wanted in some):
            if number >= stop_after:
                raise Interrupted
            yield task(*arguments[0][:2], [wanted])

    with pytest.raises(Interrupted):
        append(str(spoilable), seen=9, training=4, run=dying)
    with pytest.raises(DatasetError, match="incomplete"):
        open_dataset(str(spoilable))
    append(str(spoilable), seen=9, training=4)
    assert tree_hash(spoilable) == tree_hash(other)


def test_what_a_killed_repair_left_beside_an_old_shard_goes_with_the_repair_that_is_given_again(
    spoilable: Path, tmp_path: Path
) -> None:
    """An append does not look at shards that were there; the one that was being repaired is faulty still."""
    other = tmp_path / "undisturbed.zarr"
    shutil.copytree(spoilable, other)
    append(str(other), training=4)
    shard = spoilable / "grid/training/0/vertices/c/1/0/0/0"
    shard.write_bytes(bytes(shard.stat().st_size))
    shard.with_name("0.1234abcd.partial").write_bytes(b"half")
    append(str(spoilable), training=4)
    repair(str(spoilable), open_dataset(str(spoilable)).recipe, list(find_faults(str(spoilable))))
    assert tree_hash(spoilable) == tree_hash(other)


def test_identities_of_one_rig_keep_their_own_weights(tmp_path: Path) -> None:
    """Legs of 30 vertices each, meshed in two ways: one rig with two kinds of weights, also of those appended."""
    recipe = mixed_dataset()
    made = append(generate(recipe, str(tmp_path / "legs.zarr")).url, training=9)
    body, joints = load_body(recipe.body), tuple(made.attributes["joints"])
    kinds = [len(made.rigs(number).weights) for number in range(len(made.attributes["rigs"]))]
    assert kinds == [1, 2]
    for identity in range(made.grid.identity_count):
        rig, own = made.rig(identity), body.rig(made.parameters(identity), joints)
        assert rig is not None and own is not None
        assert np.array_equal(rig.weights, own.weights) and np.array_equal(rig.joints, own.joints)


def test_what_killed_writers_left_goes_with_an_append_that_is_given_again(spoilable: Path, tmp_path: Path) -> None:
    """Beside shards that were there, beside new ones and beside anything else."""
    other = tmp_path / "undisturbed.zarr"
    shutil.copytree(spoilable, other)
    append(str(other), training=4)
    beside = ["grid/training/0/vertices/c/1/0/0/0", "grid/training/0/identity/c/0", "zarr"]
    for path in beside:
        (spoilable / f"{path}.1234abcd.partial").write_bytes(b"half")

    def killed(task: Any, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        if task is not ensure_shards:
            yield from inline(task, arguments)
            return
        for url, _, some in arguments:
            for shard, _ in some:
                left = Path(url) / f"{shard.path}.1234abcd.partial"
                left.parent.mkdir(parents=True, exist_ok=True)
                left.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        append(str(spoilable), training=4, run=killed)
    append(str(spoilable), training=4)
    assert tree_hash(spoilable) == tree_hash(other)


def test_fewer_than_there_are_is_refused(spoilable: Path) -> None:
    before = tree_hash(spoilable)
    with pytest.raises(DatasetError, match=r"has 3 training, more than 2; appending does not take away"):
        append(str(spoilable), training=2)
    assert tree_hash(spoilable) == before


def test_an_unfinished_dataset_is_finished_first(spoilable: Path) -> None:
    from datagen.store.schema import open_group

    open_group(str(spoilable), mode="r+").attrs["status"] = "building"
    with pytest.raises(DatasetError, match=r"is incomplete.*Finish it"):
        append(str(spoilable), training=7)


def test_the_recipe_it_was_first_made_by_does_not_shrink_it(spoilable: Path) -> None:
    append(str(spoilable), training=5)
    before = tree_hash(spoilable)
    with pytest.raises(DatasetError, match=r"data.growth"):
        generate(tiny_dataset(), str(spoilable))
    assert tree_hash(spoilable) == before


def test_training_sees_appended_identities_and_poses(spoilable: Path) -> None:
    """The bank and the order of triples go by pose number, also where a pose's row is another number."""
    from training.data.triples import TripleOrder
    from training.data.vertex_bank import open_bank

    grown = append(str(spoilable), training=4, seen=9)
    identities = grown.identities("training")
    assert identities == [0, 1, 2, 5] and grown.grid.poses("seen").tolist() == [0, 1, 2, 3, 4, 5, 10, 11, 12]
    bank = open_bank(grown, identities)
    triples = next(TripleOrder(identities, grown.grid.poses("seen"), batch=36, seed=0).batches(first_step=0))[0]
    truth = {(target, pose) for _, pose, target, _ in triples.tolist()}
    assert truth == {(identity, pose) for identity in identities for pose in grown.grid.poses("seen").tolist()}
    batch = bank.batch(triples)
    for place, (_, pose, target, _) in enumerate(triples.tolist()):
        vertices = grown.vertices(target, pose)
        low, high = vertices.min(0), vertices.max(0)
        expected = (vertices - (low + high) / 2) / ((high - low).max() / 2)
        assert np.allclose(batch.truth[place].numpy(), expected, atol=1e-6)
