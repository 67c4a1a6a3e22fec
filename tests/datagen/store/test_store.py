"""The dataset on disk: its contract, and what happens when it is spoiled. Named after the accidents."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr
from blake3 import blake3

from datagen.common.errors import DatasetError, StorageError
from datagen.generate import ensure_shards, generate, repair
from datagen.store import open_dataset
from datagen.store.codec import ShardCodec
from datagen.store.schema import attributes_of, open_group
from datagen.store.verify import describe, find_faults
from tests.support.files import flip_bit, tree_hash, truncate
from tests.support.layout import layout
from tests.support.recipes import shards_of, tiny_dataset, vertices_of
from workflows.cli.main import main

GOLDEN = Path(__file__).parents[2] / "golden" / "dataset_layout.json"


def first_shard(url: Path) -> Path:
    return url / shards_of(tiny_dataset())[0].path


def test_layout_on_disk_is_the_documented_one(dataset: str) -> None:
    """Tree, shapes, dtypes, chunks, codecs. After a meant change: python -m tests.support.layout"""
    assert layout(dataset) == json.loads(GOLDEN.read_text())


def test_what_is_read_is_what_was_made(dataset: str) -> None:
    opened = open_dataset(dataset)
    grid, recipe = opened.grid, opened.recipe
    assert recipe == tiny_dataset()
    for shard in opened.arrays.shards():
        vertices = [opened.vertices(identity, shard.poses) for identity in shard.identities]
        assert np.array_equal(vertices, vertices_of(recipe, shard))
    assert np.array_equal(opened.vertices(4, 9), opened.vertices(4)[9])
    assert np.array_equal(opened.evaluation_triples("unseen"), grid.evaluation_triples("unseen"))
    assert opened.identities("evaluation") == [3, 4]


def test_dimensions_are_named(dataset: str) -> None:
    names = zarr.open_group(dataset, mode="r")["grid/training/0/vertices"].metadata.dimension_names
    assert names == ("identity", "pose", "vertex", "coordinate")


def test_zarr_alone_reads_every_array(dataset: str) -> None:
    """As anybody does who has another program: the same values, along axes that are named and numbered."""
    opened, group = open_dataset(dataset), zarr.open_group(dataset, mode="r")
    for array in opened.arrays.arrays:
        found = {name: group[f"{array.path}/{name}"][...] for name in ("vertices", "identity", "pose", "parameters")}
        for row, identity in enumerate(found["identity"]):
            assert np.array_equal(found["vertices"][row], opened.vertices(identity, found["pose"]))
            assert np.array_equal(found["parameters"][row], opened.parameters(identity))
    assert np.array_equal(group["topology/0/faces"][...], opened.faces(0))
    assert np.array_equal(group["pose/parameters"][...], opened.rotations())
    assert group["grid/topology"][...].tolist() == [0] * 5 and group["topology/vertex_count"][...].tolist() == [32]
    rows = group["manifest/rows"][...], group["manifest/bytes"][...], group["manifest/blake3"][...]
    assert [(row.rows, row.bytes, bytes.fromhex(row.blake3)) for row in opened.committed.shards] == [
        (*sizes, digest.tobytes()) for *sizes, digest in zip(*rows, strict=True)
    ]
    for row in opened.committed.shards:
        assert blake3((Path(dataset) / row.path).read_bytes()).hexdigest() == row.blake3


def test_meshes_are_pinned_to_the_byte(dataset: str) -> None:
    """A change of these bytes is a change of what recipes mean: raise the version of the body's asset with it."""
    digests = sorted(row.blake3 for row in open_dataset(dataset).committed.shards)
    assert hashlib.sha256("".join(f"{digest}\n" for digest in digests).encode()).hexdigest() == (
        "924152349283489600ca8097b97a7dd76931adf0eb01e4a570fe2b23dda57be1"
    )
    assert open_dataset(dataset).uuid == "7c026b12-065c-53ce-9a58-62a1fddbcbac"


def test_several_identities_of_few_poses_share_a_shard(tmp_path: Path, dataset: str) -> None:
    """The same meshes, encoded the same, in fewer objects; read singly, in part and whole."""
    made = generate(tiny_dataset(store={"poses_per_shard": 14}), str(tmp_path / "x.zarr"))
    other = open_dataset(dataset)
    assert [(shard.identities, len(shard.poses)) for shard in made.arrays.shards()] == [
        ((0, 1), 6),
        ((2,), 6),
        ((3,), 10),
        ((4,), 10),
    ]
    for identity in range(5):
        whole = other.vertices(identity)
        assert np.array_equal(made.vertices(identity), whole)
        assert np.array_equal(made.vertices(identity, [5, 0]), whole[[5, 0]])
        assert np.array_equal(made.vertices(identity, 3), whole[3])
    codec = ShardCodec(2, 6, 32, "lz4", 5)
    file = (tmp_path / "x.zarr" / made.committed.shards[0].path).read_bytes()
    chunks = [
        file[start : start + size]
        for start, size in codec.places(codec.decode_index(file[-codec.index_bytes :]), codec.rows_of(2, 6))
    ]
    old = [shard for shard in other.committed.shards if shard.path.startswith("grid/training/0/vertices/c/0/")]
    assert b"".join(chunks[:4]) == (Path(dataset) / old[0].path).read_bytes()[: sum(map(len, chunks[:4]))]


def test_identities_that_are_many_are_few_objects(tmp_path: Path) -> None:
    recipe = tiny_dataset(identities={"training": 300, "evaluation": 0}, store={"poses_per_shard": 60})
    made = generate(recipe, str(tmp_path / "x.zarr"))
    objects = sum(path.is_file() for path in (tmp_path / "x.zarr").rglob("*"))
    assert len(made.committed.shards) == 30 and objects < 1.2 * 30 + 100


def test_making_it_twice_gives_the_same_bytes(dataset: str, tmp_path: Path) -> None:
    generate(tiny_dataset(), str(tmp_path / "again.zarr"))
    assert tree_hash(tmp_path / "again.zarr") == tree_hash(dataset)


def test_a_complete_dataset_is_not_touched_again(spoilable: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in spoilable.rglob("*")}
    generate(tiny_dataset(), str(spoilable))
    assert {path: path.stat().st_mtime_ns for path in spoilable.rglob("*")} == before


def test_accidental_shard_delete(spoilable: Path) -> None:
    opened = open_dataset(str(spoilable))
    first_shard(spoilable).unlink()
    with pytest.raises(DatasetError, match=r"shard grid/training/0/vertices/c/0/0/0/0 is missing.*verify .* --repair"):
        open_dataset(str(spoilable))
    with pytest.raises(DatasetError, match="grid/training/0/vertices/c/0/0/0/0 is missing"):
        opened.vertices(0)


def test_truncated_shard(spoilable: Path) -> None:
    truncate(first_shard(spoilable))
    with pytest.raises(DatasetError, match=r"grid/training/0.* bytes instead of"):
        open_dataset(str(spoilable))


@pytest.mark.parametrize("at", [0.1, 0.5, 0.999])
def test_bit_flip_in_a_shard_is_an_error_and_never_wrong_data(spoilable: Path, at: float) -> None:
    flip_bit(first_shard(spoilable), at=at)
    opened = open_dataset(str(spoilable))
    with pytest.raises(DatasetError, match=r"grid/training/0/vertices/c/0/0/0/0 is damaged.*--repair"):
        opened.vertices(0)
    assert [fault.path for fault in find_faults(str(spoilable))] == ["grid/training/0/vertices/c/0/0/0/0"]


@pytest.mark.parametrize("spoil", [flip_bit, truncate, Path.unlink])
def test_repair_brings_the_very_same_bytes_back_and_touches_no_other_shard(
    dataset: str, spoilable: Path, spoil
) -> None:
    others = {path: path.stat().st_mtime_ns for path in spoilable.rglob("c/*/*/0/0")}
    spoil(first_shard(spoilable))
    others.pop(first_shard(spoilable))
    repair(str(spoilable), tiny_dataset(), list(find_faults(str(spoilable))))
    assert tree_hash(spoilable) == tree_hash(dataset)
    assert {path: path.stat().st_mtime_ns for path in others} == others


def small_objects(url: Path) -> list[Path]:
    files = (path for path in url.rglob("*") if path.is_file() and "/vertices/c/" not in str(path))
    return [path for path in sorted(files) if path != url / "zarr.json"]


@pytest.mark.parametrize("spoil", [flip_bit, Path.unlink], ids=["bit flip", "loss"])
def test_every_other_object_that_is_spoiled_is_found_and_mended(dataset: str, spoilable: Path, spoil) -> None:
    assert len(small_objects(spoilable)) > 40
    for path in small_objects(spoilable):
        spoil(path)
        faults = list(find_faults(str(spoilable)))
        name = str(path.relative_to(spoilable))
        expected = "manifest/zarr.json" if name.startswith("manifest/") else name  # it is one thing, in some objects
        assert [fault.path for fault in faults if not fault.shard][:1] == [expected], path
        repair(str(spoilable), tiny_dataset(), faults)
        assert tree_hash(spoilable) == tree_hash(dataset), path


def test_attributes_changed_by_hand_are_refused_and_mended(dataset: str, spoilable: Path) -> None:
    text = (spoilable / "zarr.json").read_text()
    (spoilable / "zarr.json").write_text(text.replace('"Y up, facing', '"Z up, facing', 1))
    with pytest.raises(DatasetError, match=r"attributes \(zarr.json\) are not as they were written.*--repair"):
        open_dataset(str(spoilable))
    faults = list(find_faults(str(spoilable)))
    assert [fault.path for fault in faults] == ["zarr.json"]
    repair(str(spoilable), tiny_dataset(), faults)
    assert tree_hash(spoilable) == tree_hash(dataset)


@pytest.mark.parametrize("name", ["rows", "bytes", "extent", "blake3", "object_sha256"])
def test_a_manifest_that_is_not_the_committed_one(spoilable: Path, name: str) -> None:
    array = zarr.open_array(spoilable / "manifest" / name)
    array[0] = array[0] + 1
    with pytest.raises(DatasetError, match="its manifest is not the one that was committed"):
        open_dataset(str(spoilable))


def test_what_a_killed_writer_left_of_a_file_is_removed(dataset: str, spoilable: Path) -> None:
    open_group(str(spoilable), mode="r+").attrs["status"] = "building"
    (spoilable / "grid/training/0/vertices/c/1/0/0/0.1234abcd.partial").write_bytes(b"half a shard")
    generate(tiny_dataset(), str(spoilable))
    assert tree_hash(spoilable) == tree_hash(dataset)


def test_provenance_names_what_made_the_part_that_was_there(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from datagen.generate import append, plan

    before = open_dataset(str(spoilable)).attributes["provenance"]
    monkeypatch.setattr(plan, "git", lambda *_: "another")
    after = append(str(spoilable), training=4).attributes["provenance"]
    assert after["git_commit"] == "another" and after["earlier"] == [before]


def test_unfinished_dataset_is_refused_but_can_be_described(spoilable: Path) -> None:
    group = open_group(str(spoilable), mode="r+")
    group.attrs["status"] = "building"
    first_shard(spoilable).unlink()
    with pytest.raises(DatasetError, match="is incomplete"):
        open_dataset(str(spoilable))
    assert describe(str(spoilable))["shards"].startswith("11 of 12 written")


def test_no_dataset_there(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no dataset at .*dsffnet generate"):
        open_dataset(str(tmp_path / "none.zarr"))


def test_a_zarr_group_of_somebody_else(tmp_path: Path) -> None:
    zarr.create_group(str(tmp_path / "other.zarr"))
    with pytest.raises(DatasetError, match="not a dataset of this project"):
        open_dataset(str(tmp_path / "other.zarr"))


def test_format_version_from_the_future(spoilable: Path) -> None:
    open_group(str(spoilable), mode="r+").attrs["format_version"] = 99
    with pytest.raises(DatasetError, match="format version 99, this program reads 4; update"):
        open_dataset(str(spoilable))


@pytest.mark.parametrize("version", [2, 3])
def test_older_formats_are_refused_with_the_command_that_makes_them_anew(
    spoilable: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], version: int
) -> None:
    """Every command, in one line; the one that it names makes the dataset, and with the same uuid."""
    before = open_dataset(str(spoilable)).uuid
    open_group(str(spoilable), mode="r+").attrs["format_version"] = version
    old, new = {2: ("grid", "identity"), 3: ("manifest/blake3", "manifest/sha256")}[version]
    shutil.move(spoilable / old, spoilable / new)
    kept = tree_hash(spoilable)
    advice = f"dsffnet generate --recipe {spoilable} --out NEW.zarr"
    for command in (
        "generate --local --recipe smoke --out {}", "append {} --training-identities 9 --local", "verify {}",
        "verify {} --repair", "inspect {}", "export {} --layout obj --out unused",
    ):  # fmt: skip
        with pytest.raises(SystemExit):
            main(command.format(spoilable).split())
        (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
        assert f"{spoilable} has format version {version}, this program reads 4; make it anew: {advice}" in line
    assert tree_hash(spoilable) == kept
    main(advice.replace("NEW.zarr", f"{tmp_path}/new.zarr --local").split()[1:])
    assert open_dataset(str(tmp_path / "new.zarr")).uuid == before
    assert generate(tiny_dataset(), str(spoilable), fresh=True).uuid == before and not (spoilable / new).exists()


def test_recipe_changed_between_runs(spoilable: Path) -> None:
    before = tree_hash(spoilable)
    changed = tiny_dataset(identities={"training": 3, "evaluation": 2, "seed": 5})
    with pytest.raises(DatasetError, match=r"another recipe \(data.identities.seed: 0 there, 5 here\).*--fresh"):
        generate(changed, str(spoilable))
    assert tree_hash(spoilable) == before
    generate(changed, str(spoilable), fresh=True)
    assert open_dataset(str(spoilable)).recipe == changed


def test_disk_full_is_one_error_and_earlier_shards_stay(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import zarr.storage._local as local

    shard = shards_of(tiny_dataset())[1]
    (spoilable / shard.path).unlink()
    before = tree_hash(spoilable)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(local, "_put", full)
    with pytest.raises(StorageError, match="No space left on device"):
        ensure_shards(str(spoilable), tiny_dataset(), [(shard, None)])
    monkeypatch.undo()
    assert tree_hash(spoilable) == before


def test_the_uuid_says_whether_two_datasets_hold_the_same(dataset: str, tmp_path: Path) -> None:
    same = generate(tiny_dataset(), str(tmp_path / "same.zarr"))
    other = generate(tiny_dataset(triples={"count": 6}), str(tmp_path / "other.zarr"))
    assert open_dataset(dataset).uuid == same.uuid != other.uuid


def test_statistics_are_those_of_all_meshes(dataset: str) -> None:
    opened = open_dataset(dataset)
    everything = np.concatenate([opened.vertices(i).reshape(-1, 3) for i in range(5)])
    statistics = attributes_of(opened.group)["statistics"]
    assert np.allclose(statistics["minimum"], everything.min(0)) and np.allclose(
        statistics["maximum"], everything.max(0)
    )
    assert statistics["meshes"] == opened.grid.mesh_count == 38


def test_made_in_part_then_copied_elsewhere_it_is_finished_there(dataset: str, spoilable: Path, tmp_path: Path) -> None:
    open_group(str(spoilable), mode="r+").attrs["status"] = "building"
    shutil.rmtree(spoilable / "manifest")
    shutil.rmtree(spoilable / "grid/evaluation")
    moved = tmp_path / "moved.zarr"
    shutil.move(spoilable, moved)
    generate(tiny_dataset(), str(moved))
    assert tree_hash(moved) == tree_hash(dataset)


def test_a_dataset_is_never_written_among_other_files_nor_removed_with_them(dataset: str, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(DatasetError, match=r"holds what is not a dataset \(thesis.txt\)"):
        generate(tiny_dataset(), str(tmp_path))
    made = tmp_path / "leg.zarr"
    shutil.copytree(dataset, made)
    (made / "notes.txt").write_text("mine")
    with pytest.raises(DatasetError, match=r"notes.txt"):
        generate(tiny_dataset(), str(made), fresh=True)
    assert (made / "notes.txt").exists() and (tmp_path / "thesis.txt").exists()


def test_a_file_where_the_dataset_should_go(tmp_path: Path) -> None:
    (tmp_path / "x.zarr").write_text("a file")
    with pytest.raises(DatasetError, match="is a file"):
        generate(tiny_dataset(), str(tmp_path / "x.zarr"), fresh=True)


def test_other_assets_are_refused_when_going_on(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from datagen.bodies.leg import LegModel
    from datagen.common.assets import Asset

    open_group(str(spoilable), mode="r+").attrs["status"] = "building"
    monkeypatch.setattr(LegModel, "assets", (Asset("procedural leg", "Apache-2.0", "3"),))
    with pytest.raises(DatasetError, match="was made from procedural leg 2, but here is procedural leg 3"):
        generate(tiny_dataset(), str(spoilable))
