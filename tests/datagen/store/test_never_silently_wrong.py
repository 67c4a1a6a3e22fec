"""Accidents that left, or could leave, a dataset that looks sound and is not."""

import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.bodies.leg import LegModel
from datagen.common.assets import Asset
from datagen.common.errors import BodyError, DatasetError, StorageError
from datagen.generate import append, ensure_shards, generate, inline, make_shard, repair, shards
from datagen.generate.plan import plan_of
from datagen.generate.shards import require_same_assets
from datagen.mesh.geometry import bounds
from datagen.recipe import DatasetRecipe
from datagen.store import manifest, open_dataset, writer
from datagen.store.schema import open_group
from datagen.store.verify import find_faults, require_recipe
from datagen.store.writer import ShardWriter
from tests.support.files import flip_bit, tree_hash
from tests.support.recipes import shards_of, tiny_dataset
from tests.support.shapes.meshes import npt_folder

OTHER = tiny_dataset(identities={"training": 3, "evaluation": 2, "seed": 5})


def unlock(url: Path) -> None:
    open_group(str(url), mode="r+").update_attributes({"status": "building"})


def test_vertices_that_are_in_no_face_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Anny's makehuman topology has them: the array is as wide as the body's meshes."""
    real = LegModel.vertices

    def with_loose_ones(self: LegModel, parameters: Any, poses: Any) -> Any:
        vertices = real(self, parameters, poses)
        return np.concatenate([vertices, vertices[:, :3]], axis=1)

    monkeypatch.setattr(LegModel, "vertices", with_loose_ones)
    monkeypatch.setattr(LegModel, "rig", lambda *_: None)  # its weights are those of the others
    made = generate(tiny_dataset(), str(tmp_path / "x.zarr"))
    assert made.vertex_count(0) == made.faces(0).max() + 1 + 3
    assert np.array_equal(made.vertices(0, 2), made.vertices(0)[2]) and not list(find_faults(made.url))


def test_a_shard_of_another_shape_is_not_written(spoilable: Path) -> None:
    shard, before = shards_of(tiny_dataset())[0], tree_hash(spoilable)
    for shape, fault in (((4, 31, 3), r"of shape \(31, 3\) instead of \(32, 3\)"), ((3, 32, 3), "instead of 1 x 4")):
        other = np.zeros(shape, np.float32)
        with pytest.raises(DatasetError, match=rf"came out with .*meshes {fault}"):
            ShardWriter(str(spoilable), tiny_dataset()).write(shard, [(other, bounds(other))])
    assert tree_hash(spoilable) == before


def test_a_complete_dataset_of_other_files_is_not_taken_for_this_one(tmp_path: Path) -> None:
    def imported(folder: str, size: float) -> DatasetRecipe:
        meshes = npt_folder(tmp_path / folder, identities=range(4), poses=range(4))
        (meshes / "0_0.ply").write_bytes((meshes / f"{int(size)}_{int(size)}.ply").read_bytes())
        body = {"family": "imported", "layout": "npt", "path": str(meshes)}
        poses = {"seen": 2, "unseen": 2, "distribution": {"name": "found"}}
        return tiny_dataset(body=body, poses=poses, identities={"training": 2, "evaluation": 2})

    url = str(tmp_path / "x.zarr")
    generate(imported("a", 1), url)
    before = tree_hash(url)
    with pytest.raises(DatasetError, match=r"was made from npt meshes .*, but here is npt meshes"):
        generate(imported("b", 2), url)
    assert tree_hash(url) == before


def test_a_late_task_of_another_recipe_writes_nothing(spoilable: Path) -> None:
    before, shard = tree_hash(spoilable), shards_of(OTHER)[0]
    with pytest.raises(DatasetError, match="is being made by another recipe now"):
        ensure_shards(str(spoilable), OTHER, [(shard, None)])
    with pytest.raises(DatasetError, match="is being made by another recipe now"):
        ShardWriter(str(spoilable), OTHER)
    assert tree_hash(spoilable) == before


def test_shards_without_a_root_are_not_adopted(spoilable: Path) -> None:
    (spoilable / "zarr.json").unlink()
    with pytest.raises(DatasetError, match=r"has lost its zarr\.json"):
        generate(OTHER, str(spoilable))


def test_a_removal_that_was_cut_short_still_knows_its_own(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Path] = []

    def dying(path: Path, **options: Any) -> None:
        if calls:
            raise KeyboardInterrupt
        calls.append(path)
        real(path, **options)

    real = shutil.rmtree
    monkeypatch.setattr(shutil, "rmtree", dying)
    with pytest.raises(KeyboardInterrupt):
        generate(OTHER, str(spoilable), fresh=True)
    monkeypatch.undo()
    with pytest.raises(DatasetError, match="another recipe"):
        generate(OTHER, str(spoilable))
    assert generate(OTHER, str(spoilable), fresh=True).recipe == OTHER


@pytest.mark.parametrize(
    "change",
    [('"seed": 0', '"seed": 1'), ('"Y up', '"Z up'), ('"metres"', '"inches"')],
    ids=["recipe", "frame", "units"],
)
def test_attributes_changed_by_hand_are_written_anew_from_the_given_recipe(
    dataset: str, spoilable: Path, change: tuple[str, str]
) -> None:
    root = spoilable / "zarr.json"
    changed = root.read_text().replace(*change)
    assert changed != root.read_text()
    root.write_text(changed)
    generate(tiny_dataset(), str(spoilable))
    assert tree_hash(spoilable) == tree_hash(dataset)


def test_repair_does_not_trust_a_recipe_that_was_changed_by_hand(spoilable: Path) -> None:
    root = spoilable / "zarr.json"
    root.write_text(root.read_text().replace('"seed": 0', '"seed": 1'))
    stored = open_group(str(spoilable)).attrs["recipe"]
    with pytest.raises(DatasetError, match=r"another recipe|not the one that it was made by"):
        repair(str(spoilable), DatasetRecipe.model_validate(stored), list(find_faults(str(spoilable))))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [('"seed": 0', '"seed": 5', "not the one that it was made by"), ('"Y up', '"Z up', "not as they were written")],
)
def test_a_recipe_is_not_taken_from_attributes_that_were_changed_by_hand(
    spoilable: Path, old: str, new: str, says: str
) -> None:
    root = spoilable / "zarr.json"
    root.write_text(root.read_text().replace(old, new))
    with pytest.raises(DatasetError, match=says):
        require_recipe(str(spoilable))


@pytest.mark.parametrize("content", [None, "", "\0\0\0"])
def test_a_dataset_that_lost_its_root_is_made_again_as_the_message_says(
    dataset: str, spoilable: Path, content: str | None
) -> None:
    root, url = spoilable / "zarr.json", str(spoilable)
    root.unlink() if content is None else root.write_text(content)
    again = rf"zarr\.json.* cannot be read.*: dsffnet generate --recipe RECIPE --out {url} --fresh"
    for use in (open_dataset, require_recipe, lambda url: generate(tiny_dataset(), url)):
        with pytest.raises(DatasetError, match=again):
            use(url)
    (spoilable / "grid" / "thesis.txt").write_text("precious")
    with pytest.raises(DatasetError, match="holds what is not a dataset"):
        generate(tiny_dataset(), url, fresh=True)
    (spoilable / "grid" / "thesis.txt").unlink()
    generate(tiny_dataset(), url, fresh=True)
    assert tree_hash(spoilable) == tree_hash(dataset)


def test_growing_from_what_is_no_longer_there_is_refused(spoilable: Path) -> None:
    """Two appends at once, on a store without a lock: the second does not overwrite the first."""
    from datagen.recipe import Growth
    from datagen.store.writer import begin

    append(str(spoilable), training=5)
    late = tiny_dataset().model_copy(update={"growth": (Growth(evaluation=2),)})
    with pytest.raises(DatasetError, match=r"another recipe \(data.growth"):
        begin(str(spoilable), plan_of(late), growing=True)
    assert open_dataset(str(spoilable)).grid.identity_count == 7


@pytest.mark.parametrize(
    "inside", ["thesis.txt", ".git/config", "pose/thesis.txt", "identity/x", "grid/x", "zarr.json"]
)
def test_fresh_removes_nothing_of_anybody_else(tmp_path: Path, inside: str) -> None:
    precious = tmp_path / "mine" / inside
    precious.parent.mkdir(parents=True)
    precious.write_text("{}")
    for fresh in (False, True):
        with pytest.raises(DatasetError, match="holds what is not a dataset"):
            generate(tiny_dataset(), str(tmp_path / "mine"), fresh=fresh)
    assert precious.read_text() == "{}"


def test_hidden_files_in_a_dataset_survive_its_removal(spoilable: Path) -> None:
    (spoilable / ".notes").write_text("mine")
    generate(OTHER, str(spoilable), fresh=True)
    assert (spoilable / ".notes").read_text() == "mine" and open_dataset(str(spoilable)).recipe == OTHER


@pytest.mark.parametrize("command", ["generate", "repair"])
def test_other_code_does_not_replace_a_committed_shard(
    spoilable: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    shard = shards_of(tiny_dataset())[0]
    (spoilable / shard.path).unlink()
    before = tree_hash(spoilable)
    other_code(monkeypatch)
    with pytest.raises(DatasetError, match="was made again, but not the same"):
        if command == "generate":
            generate(tiny_dataset(), str(spoilable))
        else:
            repair(str(spoilable), tiny_dataset(), list(find_faults(str(spoilable))))
    assert not (spoilable / shard.path).exists() and tree_hash(spoilable) == before
    monkeypatch.undo()
    repair(str(spoilable), tiny_dataset(), list(find_faults(str(spoilable))))


def other_code(monkeypatch: pytest.MonkeyPatch) -> None:
    real = LegModel.vertices
    monkeypatch.setattr(LegModel, "vertices", lambda self, parameters, poses: real(self, parameters, poses) * 1.01)


def test_what_is_refused_once_is_refused_again(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The dataset is being made anew from the first time on, as it has lost its faces."""
    whole = tree_hash(spoilable)
    flip_bit(spoilable / shards_of(tiny_dataset())[0].path)
    (spoilable / "topology/0/faces/c/0/0").unlink()
    other_code(monkeypatch)
    for _ in range(2):
        with pytest.raises(DatasetError, match="was made again, but not the same"):
            repair(str(spoilable), tiny_dataset(), list(find_faults(str(spoilable))))
    with pytest.raises(DatasetError, match="was made again, but not the same"):
        generate(tiny_dataset(), str(spoilable))
    monkeypatch.undo()
    generate(tiny_dataset(), str(spoilable))
    assert tree_hash(spoilable) == whole


def test_committed_bytes_outlive_a_manifest_that_is_cut_short(
    spoilable: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of its begin and of its end six arrays each are written, and the root's attributes."""
    whole = tree_hash(append(str(shutil.copytree(spoilable, tmp_path / "whole")), training=4).url)
    shard, real = shards_of(tiny_dataset())[0].path, manifest.put_array
    for cut in range(12):
        url, left = shutil.copytree(spoilable, tmp_path / f"{cut}"), [cut]

        def put(*given: Any, left: list[int] = left) -> None:
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
            real(*given)

        with monkeypatch.context() as patched:
            patched.setattr(manifest, "put_array", put)
            with pytest.raises(KeyboardInterrupt):
                append(str(url), training=4)
        (url / shard).unlink()
        with monkeypatch.context() as patched, pytest.raises(DatasetError, match="was made again, but not the same"):
            other_code(patched)
            append(str(url), training=4)
        assert not (url / shard).exists() and tree_hash(append(str(url), training=4).url) == whole


@pytest.mark.parametrize("damaged", ["", "empty", "twice"])
def test_what_verify_found_stays_doubted_after_a_repair_that_is_cut_short(spoilable: Path, damaged: str) -> None:
    def stopped(task: Any, arguments: list[Any]) -> Iterator[Any]:
        if task is ensure_shards:
            raise StorageError("no room")
        return inline(task, arguments)

    whole = tree_hash(append(str(shutil.copytree(spoilable, spoilable.parent / "whole")), training=4).url)
    with pytest.raises(StorageError):
        append(str(spoilable), training=4, run=stopped)
    flip_bit(spoilable / shards_of(tiny_dataset())[0].path)
    grown = open_group(str(spoilable)).attrs["recipe"]
    recipe = DatasetRecipe.model_validate(grown)
    with pytest.raises(StorageError):
        repair(str(spoilable), recipe, list(find_faults(str(spoilable))), run=stopped)
    note = spoilable / "manifest/so_far"
    if damaged == "empty":
        note.write_bytes(b"")
    elif damaged:  # a shard is listed twice, as two
        content = note.read_bytes()[32:]
        row = bytearray(content[: manifest._SO_FAR_ROW.itemsize])
        row[manifest._SO_FAR_ROW.fields["blake3"][1]] ^= 1
        content += bytes(row)
        note.write_bytes(hashlib.sha256(content).digest() + content)
    assert tree_hash(append(str(spoilable), training=4).url) == whole


def test_an_append_cut_short_while_it_begins_reads_no_shard_afterwards(
    spoilable: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what a writer leaves of the note of its shards that it was writing is removed at the end."""
    whole = tree_hash(append(str(shutil.copytree(spoilable, tmp_path / "whole")), training=4).url)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(writer, "_put_arrays", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        append(str(spoilable), training=4)
    (spoilable / f"manifest/so_far.{'0' * 32}.partial").write_bytes(b"half")
    looked, real = list[Any](), shards.existing_shard
    monkeypatch.setattr(shards, "existing_shard", lambda *given: looked.append(given[2]) or real(*given))
    assert tree_hash(append(str(spoilable), training=4).url) == whole
    assert looked and {identity for shard in looked for identity in shard.identities} == {5}


def test_a_note_that_a_killed_writer_left_of_a_complete_dataset_is_ignored_and_goes_with_the_next_append(
    spoilable: Path, tmp_path: Path
) -> None:
    whole = tree_hash(append(str(shutil.copytree(spoilable, tmp_path / "whole")), training=4).url)
    (spoilable / "manifest/so_far").write_bytes(b"as it was before the last shards")
    assert not list(find_faults(str(spoilable)))
    assert tree_hash(append(str(spoilable), training=4).url) == whole


def test_a_worker_with_other_assets_writes_nothing(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require_same_assets.cache_clear()
    shard = shards_of(tiny_dataset())[0]
    (spoilable / shard.path).unlink()
    monkeypatch.setattr(LegModel, "assets", (Asset("procedural leg", "Apache-2.0", "OTHER"),))
    with pytest.raises(DatasetError, match="was made from procedural leg 2, but here is procedural leg OTHER"):
        ensure_shards(str(spoilable), tiny_dataset(), [(shard, None)])
    assert not (spoilable / shard.path).exists()


def test_a_link_to_a_dataset_is_under_the_same_lock(spoilable: Path, tmp_path: Path) -> None:
    from datagen.store.location import writing_alone

    (tmp_path / "link.zarr").symlink_to(spoilable)
    unlock(spoilable)
    with writing_alone(str(spoilable)):
        for name in (str(tmp_path / "link.zarr"), f"file://{spoilable}", os.path.relpath(spoilable)):
            with pytest.raises(DatasetError, match="another process is writing"):
                generate(tiny_dataset(), name)


def test_a_file_url_is_a_folder(dataset: str, tmp_path: Path) -> None:
    generate(tiny_dataset(), f"file://{tmp_path}/x.zarr")
    assert tree_hash(tmp_path / "x.zarr") == tree_hash(dataset)


def test_a_lost_part_of_the_metadata_is_an_error_that_names_the_mending(spoilable: Path) -> None:
    opened = open_dataset(str(spoilable))
    lost = ["grid/training/0/vertices/zarr.json", "topology/0/faces/c/0/0", "grid/evaluation/0/parameters/zarr.json"]
    for path in lost:
        (spoilable / path).unlink()
    for read in (
        lambda: opened.vertices(1),
        lambda: opened.vertex_count(1),
        lambda: opened.faces(2),
        lambda: opened.parameters(3),
    ):
        with pytest.raises(DatasetError, match=r"missing or damaged.*--repair"):
            read()
    assert sorted(fault.path for fault in find_faults(str(spoilable))) == sorted(lost)


def test_a_body_that_changed_since_the_dataset_was_begun(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its meshes do not fit the arrays: an error, and nothing is written."""
    shard = shards_of(tiny_dataset())[0]
    real = LegModel.vertices
    monkeypatch.setattr(LegModel, "vertices", lambda self, parameters, poses: real(self, parameters, poses)[:, 1:])
    with pytest.raises(BodyError, match="identity 0 has 31 vertices in pose 0, and had 32 when the dataset was begun"):
        next(make_shard(tiny_dataset(), shard))


def test_a_root_that_cannot_be_parsed_names_the_way_out(spoilable: Path) -> None:
    (spoilable / "zarr.json").write_text((spoilable / "zarr.json").read_text()[:-40])
    with pytest.raises(DatasetError, match=r"not a readable dataset: .* cannot be read.*dsffnet generate .* --fresh"):
        open_dataset(str(spoilable))
    assert generate(tiny_dataset(), str(spoilable), fresh=True).recipe == tiny_dataset()
