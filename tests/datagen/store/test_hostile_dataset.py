"""A dataset that somebody made to do harm: one clear line, nothing outside touched, memory bounded, and what can be
repaired is repaired."""

import contextlib
import errno
import os
import resource
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import zarr
from numcodecs import Zstd

from datagen.common.errors import DatasetError, DsffnetError
from datagen.generate import append, generate, repair
from datagen.store import arrays, open_dataset
from datagen.store.arrays import put_array
from datagen.store.object_names import is_leftover, is_member
from datagen.store.objects import LocalObjects
from datagen.store.schema import open_group
from datagen.store.verify import describe, find_faults, require_recipe
from tests.support.damage.datasets import edit, sealed
from tests.support.files import tree_hash
from tests.support.recipes import tiny_dataset
from workflows.cli.main import main

SHARD = "grid/training/0/vertices/c/0/0/0/0"
FACES = "topology/0/faces"
DEEP = "[" * 100_000 + "]" * 100_000

Attack = Callable[[Path], object]


@pytest.fixture
def victim(tmp_path: Path) -> Iterator[Path]:
    """A folder beside the dataset; whatever happens, it stays as it was."""
    folder = tmp_path / "victim"
    (folder / "below").mkdir(parents=True)
    for name in ("thesis.txt", "below/zarr.json", "c/0/0/0"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text('{"precious": 1}')
    before = tree_hash(folder)
    yield folder
    assert tree_hash(folder) == before


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """A gigabyte of address space more than now, and no more: what takes memory without a bound fails here."""
    before, now = resource.getrlimit(resource.RLIMIT_AS), psutil.Process().memory_info().vms
    resource.setrlimit(resource.RLIMIT_AS, (now + 2**30, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def told(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    """Exit status and last line of a command; it writes no traceback."""
    status = 0
    try:
        main([str(word) for word in words])
    except SystemExit as end:
        status = int(end.code or 0)
    written = capsys.readouterr()
    assert "Traceback" not in written.err
    return status, (written.err if status else written.out).strip().splitlines()[-1]


def objects(*paths: str) -> Attack:
    """The manifest names other objects, too."""
    return lambda url: sealed(url, manifest=lambda content: content["objects"].update(dict.fromkeys(paths, "0" * 64)))


def attributes(**values: Any) -> Attack:
    return lambda url: sealed(url, attributes=lambda found: found.update(values))


def in_recipe(section: str, **values: Any) -> Attack:
    return lambda url: sealed(url, attributes=lambda found: found["recipe"][section].update(values))


def document(path: str, *, rehashed: bool = True, **values: Any) -> Attack:
    """Other values in an object's metadata."""

    def attack(url: Path) -> None:
        edit(url / path, lambda found: found.update(values))
        if rehashed:
            sealed(url)

    return attack


def text(path: str, content: str) -> Attack:
    return lambda url: (url / path).write_text(content)


def link(path: str, to: str) -> Attack:
    """A link in the place of an object or a folder; ``to`` is relative to the dataset's parent, or absolute."""

    def attack(url: Path) -> None:
        if (url / path).is_dir():
            shutil.rmtree(url / path)
        else:
            (url / path).unlink()
        (url / path).symlink_to(url.parent / to)

    return attack


def pipe(path: str) -> Attack:
    return lambda url: ((url / path).unlink(), os.mkfifo(url / path))


def folder(path: str) -> Attack:
    return lambda url: ((url / path).unlink(), (url / path).mkdir())


def other_faces(url: Path) -> None:
    zarr.open_array(url / FACES)[0] = [0, 1, 99]
    sealed(url)


def other_triples(url: Path) -> None:
    zarr.open_array(url / "evaluation/seen")[0] = [3, 0, 4, -7]
    sealed(url)


def manifest(name: str, first: Any) -> Attack:
    """Other values in the first row of a column of the manifest."""

    def change(content: dict[str, Any]) -> None:
        content[name][: len(first)] = first

    return lambda url: sealed(url, manifest=change)


def one_less(url: Path) -> None:
    sealed(url, manifest=lambda content: content.update({k: v[1:] for k, v in content.items() if k != "objects"}))


def numbers(path: str, first: int) -> Attack:
    """Another number at the first place of an array."""

    def attack(url: Path) -> None:
        zarr.open_array(url / path)[0] = first
        sealed(url)

    return attack


def many_vertices(url: Path) -> None:
    """Meshes of 10^8 vertices, said so in every place."""
    path = "grid/training/0/vertices/zarr.json"
    numbers("topology/vertex_count", 10**8)(url)
    shaped("grid/evaluation/0/vertices/zarr.json", 2, 10, 10**8, 3)(url)
    shaped(path, 3, 6, 10**8, 3)(url)


def bomb(url: Path) -> None:
    """A gigabyte and a half of zeros in the place of the faces, compressed to some kilobytes."""
    faces = np.zeros((2**27, 3), np.int32)
    edit(url / FACES / "zarr.json", lambda found: found.update(shape=list(faces.shape)))
    edit(url / FACES / "zarr.json", lambda found: found["chunk_grid"]["configuration"].update(chunk_shape=faces.shape))
    (url / FACES / "c/0/0").write_bytes(Zstd(3).encode(faces))
    sealed(url)


def shaped(path: str, *shape: int) -> Attack:
    """Another shape in an array's metadata, chunks included."""

    def attack(url: Path) -> None:
        def change(found: dict[str, Any]) -> None:
            chunk = found["chunk_grid"]["configuration"]
            found["shape"], chunk["chunk_shape"] = shape, [chunk["chunk_shape"][0], *shape[1:]]
            if found["codecs"][0]["name"] == "sharding_indexed":
                chunk["chunk_shape"][:2] = [1, 4]
                found["codecs"][0]["configuration"]["chunk_shape"] = [1, 1, *shape[2:]]
            else:
                chunk["chunk_shape"] = shape

        edit(url / path, change)
        if not path.startswith("manifest/"):
            sealed(url)

    return attack


HOSTILE = [
    pytest.param(objects("../victim"), id="objects: .."),
    pytest.param(objects("../victim/thesis.txt"), id="objects: a file of somebody's"),
    pytest.param(objects("grid/../../victim"), id="objects: .. inside"),
    pytest.param(lambda url: objects(str(url.parent / "victim"))(url), id="objects: absolute"),
    pytest.param(objects(""), id="objects: the dataset itself"),
    pytest.param(objects("grid"), id="objects: a folder of the dataset"),
    pytest.param(objects("zarr.json\0"), id="objects: NUL"),
]


@pytest.mark.parametrize("attack", HOSTILE)
def test_names_that_no_object_has_are_refused_and_nothing_is_touched(
    spoilable: Path, victim: Path, capsys: pytest.CaptureFixture[str], attack: Attack
) -> None:
    attack(spoilable)
    before = tree_hash(spoilable)
    for command in (("verify", spoilable, "--repair"), ("append", spoilable, "--training-identities", 5, "--local")):
        status, line = told(capsys, *command)
        assert status == 1 and "none of its objects. Do not trust" in line, line
    with pytest.raises(DsffnetError, match="none of its objects"):
        open_dataset(str(spoilable))
    assert tree_hash(spoilable) == before


REPAIRED = [
    # names
    pytest.param(numbers("grid/topology", 7), id="a topology that is not there"),
    pytest.param(numbers("grid/topology", -1), id="topology -1"),
    pytest.param(numbers("rig/number", 7), id="a rig that is not there"),
    pytest.param(numbers("rig/0/kind", -1), id="kind of weights -1"),
    pytest.param(attributes(rigs=[{"names": ["a"], "parents": [0], "drivers": [0]}]), id="a part that hangs on itself"),
    pytest.param(attributes(rigs=[{"names": ["a"], "parents": [-1], "drivers": [24]}]), id="a driver of no joint"),
    pytest.param(
        attributes(rigs=[{"names": ["a"] * 3000, "parents": [*range(-1, 2999)], "drivers": [0] * 3000}]),
        id="a chain of 3000 parts",
    ),
    # links, devices, pipes
    pytest.param(link(SHARD, "victim/thesis.txt"), id="shard: link out"),
    pytest.param(link(SHARD, "/dev/zero"), id="shard: /dev/zero"),
    pytest.param(pipe(SHARD), id="shard: pipe"),
    pytest.param(folder(SHARD), id="shard: folder"),
    pytest.param(link("manifest/zarr.json", "/dev/zero"), id="manifest: /dev/zero"),
    pytest.param(link("manifest/zarr.json", "victim/thesis.txt"), id="manifest: link out"),
    pytest.param(link("grid/training/0/vertices/zarr.json", "victim/below/zarr.json"), id="array: link out"),
    pytest.param(pipe("pose/parameters/zarr.json"), id="array: pipe"),
    pytest.param(link(f"{FACES}/c/0/0", "/dev/zero"), id="faces: /dev/zero"),
    # numbers
    pytest.param(shaped(f"{FACES}/zarr.json", 10**13, 3), id="faces: 109 TiB"),
    pytest.param(shaped("pose/parameters/zarr.json", 10**12, 52, 3), id="poses: 10^12"),
    pytest.param(shaped("grid/training/0/vertices/zarr.json", 3, 6, 10**8, 3), id="vertices: 10^8"),
    pytest.param(shaped("grid/training/0/vertices/zarr.json", 3, 6, 10**30, 3), id="vertices: 10^30"),
    pytest.param(shaped("grid/training/0/vertices/zarr.json", 10**12, 6, 32, 3), id="identities: 10^12"),
    pytest.param(many_vertices, id="vertices: 10^8, wherever they are named"),
    pytest.param(numbers("topology/vertex_count", 0), id="no vertices"),
    pytest.param(numbers("topology/vertex_count", 2**31 - 1), id="vertex count: 2^31"),
    pytest.param(shaped("grid/topology/zarr.json", 10**12), id="topologies: 10^12"),
    pytest.param(shaped("rig/0/weights/zarr.json", 10**9, 32, 2), id="weights: 10^9 kinds"),
    pytest.param(shaped("rig/0/joints/zarr.json", 5, 3, 3), id="joints of three parts"),
    pytest.param(shaped("manifest/blake3/zarr.json", 10**12, 32), id="manifest: 10^12 rows"),
    pytest.param(bomb, id="faces: a bomb"),
    pytest.param(other_faces, id="faces out of range"),
    pytest.param(other_triples, id="triples out of range"),
    # types
    pytest.param(document("grid/training/0/vertices/zarr.json", data_type="float64"), id="vertices: float64"),
    pytest.param(document("grid/training/0/vertices/zarr.json", codecs=[{"name": "bytes"}]), id="vertices: codec"),
    pytest.param(document("grid/training/0/vertices/zarr.json", shape="x"), id="vertices: shape x"),
    pytest.param(document("grid/training/0/vertices/zarr.json", node_type="group"), id="vertices: a group"),
    pytest.param(document(f"{FACES}/zarr.json", codecs=5), id="faces: codecs 5"),
    pytest.param(text(f"{FACES}/zarr.json", DEEP), id="faces: deep JSON"),
    pytest.param(text("manifest/zarr.json", DEEP), id="manifest: deep JSON"),
    pytest.param(text("manifest/zarr.json", "[]"), id="manifest: a list"),
    pytest.param(manifest("place", [[0, 0, -1, 0]]), id="manifest: place -1"),
    pytest.param(manifest("place", [[2, 0, 0, 0]]), id="manifest: a third split"),
    pytest.param(manifest("place", [[0, 0, 2**31 - 1, 0]]), id="manifest: place 2^31"),
    pytest.param(manifest("rows", [-4]), id="manifest: rows -4"),
    pytest.param(manifest("bytes", [-1]), id="manifest: bytes -1"),
    pytest.param(manifest("bytes", [2**62]), id="manifest: bytes 2^62"),
    pytest.param(one_less, id="manifest: one missing"),
    pytest.param(
        document("manifest/zarr.json", rehashed=False, attributes={"objects": {"zarr.json": 1}}), id="manifest: objects"
    ),
    pytest.param(document("manifest/zarr.json", rehashed=False, attributes={"objects": [5]}), id="manifest: a number"),
    pytest.param(document("manifest/zarr.json", rehashed=False, attributes={"objects": []}), id="manifest: no objects"),
    pytest.param(document("manifest/rows/zarr.json", rehashed=False, data_type="float64"), id="manifest: rows float64"),
    pytest.param(document("manifest/rows/zarr.json", rehashed=False, shape=5), id="manifest: shape 5"),
    pytest.param(attributes(joints=5), id="attributes: joints 5"),
    pytest.param(attributes(joint_parents=["x"]), id="attributes: parents"),
    pytest.param(attributes(joint_parents=[99] * 22), id="attributes: parents out of range"),
    pytest.param(attributes(joint_parents=[*range(1, 24), -1]), id="attributes: parents after their children"),
    pytest.param(attributes(body=[]), id="attributes: body"),
    pytest.param(attributes(provenance="x"), id="attributes: provenance"),
    pytest.param(attributes(statistics={"minimum": "x"}), id="attributes: statistics"),
    pytest.param(attributes(uuid=None), id="attributes: uuid"),
]


@pytest.mark.parametrize("attack", REPAIRED)
def test_what_can_be_repaired_is_one_line_that_names_the_repair(
    dataset: str, spoilable: Path, victim: Path, capsys: pytest.CaptureFixture[str], attack: Attack
) -> None:
    attack(spoilable)
    with bounded():
        with pytest.raises(DatasetError) as caught:
            read_all(str(spoilable))
        assert "\n" not in str(caught.value) and "--repair" in str(caught.value), caught.value
        status, line = told(capsys, "verify", spoilable, "--repair")
    assert status == 0 and "is whole again" in line, line
    assert not any(path.is_symlink() for path in spoilable.rglob("*"))
    assert meshes(spoilable) == meshes(Path(dataset))
    read_all(str(spoilable))


@pytest.mark.parametrize(
    "attack",
    [
        pytest.param(document("topology/0/zarr.json", rehashed=False, attributes=[]), id="attributes: a list"),
        pytest.param(link("grid/training/0/zarr.json", "/dev/zero"), id="/dev/zero"),
        pytest.param(link("topology/0/zarr.json", "victim/thesis.txt"), id="link out"),
        pytest.param(text("grid/training/0/zarr.json", DEEP), id="deep JSON"),
        pytest.param(pipe("grid/training/0/identity/c/0"), id="the numbers of identities: pipe"),
        pytest.param(numbers("grid/evaluation/0/pose", 5), id="other numbers of poses, sealed"),
    ],
)
def test_what_only_others_read_is_repaired_too(
    dataset: str, spoilable: Path, victim: Path, capsys: pytest.CaptureFixture[str], attack: Attack
) -> None:
    """Metadata of groups and the numbers along the axes are for other programs; this one knows them."""
    attack(spoilable)
    with bounded():
        read_all(str(spoilable))
        assert told(capsys, "verify", spoilable)[0] == 1
        status, line = told(capsys, "verify", spoilable, "--repair")
    assert status == 0 and "is whole again" in line, line
    assert tree_hash(spoilable) == tree_hash(dataset)


def read_all(url: str) -> None:
    """Read everything that a training does."""
    opened = open_dataset(url)
    for identity in range(opened.grid.identity_count):
        opened.vertices(identity)
        opened.faces(identity)
        opened.parameters(identity)
        opened.rig(identity)
    opened.rotations()
    opened.evaluation_triples("seen")
    opened.evaluation_triples("unseen")


def meshes(url: Path) -> dict[str, bytes]:
    """Bytes of all that is not metadata."""
    paths = (path for path in url.rglob("*") if path.is_file() and path.name != "zarr.json")
    return {str(path.relative_to(url)): path.read_bytes() for path in paths}


REFUSED = [
    pytest.param(link("zarr.json", "/dev/zero"), "leads out", id="root: /dev/zero"),
    pytest.param(link("zarr.json", "victim/thesis.txt"), "leads out", id="root: link out"),
    pytest.param(pipe("zarr.json"), "not a regular", id="root: pipe"),
    pytest.param(text("zarr.json", DEEP), "cannot be read", id="root: deep JSON"),
    pytest.param(text("zarr.json", "[]"), "cannot be read", id="root: a list"),
    pytest.param(document("zarr.json", rehashed=False, attributes=[1]), "cannot be read", id="root: attributes a list"),
    pytest.param(document("zarr.json", rehashed=False, node_type="x"), "cannot be read", id="root: node type"),
    pytest.param(attributes(format_version="9" * 10**6), "format version", id="root: a long version"),
    pytest.param(attributes(recipe=5), "does not understand", id="recipe: 5"),
    pytest.param(in_recipe("identities", training=10**12), "identities", id="recipe: 10^12 identities"),
    pytest.param(in_recipe("poses", seen=3 * 10**7), "poses", id="recipe: 3*10^7 poses"),
    pytest.param(in_recipe("poses", seen=10**15), "poses", id="recipe: 10^15 poses"),
    pytest.param(in_recipe("triples", count=10**12), "triples", id="recipe: 10^12 triples"),
    pytest.param(
        lambda url: sealed(url, attributes=lambda found: found["recipe"].update(growth=[{}] * 2000)),
        "2,001 steps",
        id="recipe: 2000 steps",
    ),
]


@pytest.mark.parametrize("status", ["complete", "building"])
@pytest.mark.parametrize(("attack", "says"), REFUSED)
def test_a_root_that_cannot_be_believed_is_refused(
    spoilable: Path, victim: Path, capsys: pytest.CaptureFixture[str], attack: Attack, says: str, status: str
) -> None:
    sealed(spoilable, attributes=lambda found: found.update(status=status))
    attack(spoilable)
    with bounded():
        for look in (describe, require_recipe, lambda url: list(find_faults(url))):
            with pytest.raises(DsffnetError, match=says) as caught:
                look(str(spoilable))
            assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000
        code, line = told(capsys, "verify", spoilable, "--repair")
    assert code == 1 and line.startswith("error: ")


def test_a_grid_that_the_manifest_does_not_have_is_not_listed(spoilable: Path) -> None:
    in_recipe("poses", seen=100_000)(spoilable)
    with pytest.raises(DatasetError, match="does not list the shards that its recipe has"):
        open_dataset(str(spoilable))


def test_metadata_that_claims_to_be_consolidated_is_not_believed(dataset: str, spoilable: Path) -> None:
    fake = {"kind": "inline", "must_understand": False, "metadata": {"topology": {"node_type": "array"}}}
    document("zarr.json", consolidated_metadata=fake)(spoilable)
    assert np.array_equal(open_dataset(str(spoilable)).vertices(0), open_dataset(dataset).vertices(0))


@pytest.mark.parametrize("member", ["grid", "grid/training/0", "grid/training/0/vertices", "topology", "manifest"])
def test_nothing_is_written_or_removed_through_a_folder_that_leads_out(
    spoilable: Path, victim: Path, capsys: pytest.CaptureFixture[str], member: str
) -> None:
    link(member, "victim")(spoilable)
    status, line = told(capsys, "verify", spoilable, "--repair")
    assert status == 1 and "leads out" in line
    sealed_building = lambda: edit(spoilable / "zarr.json", lambda found: found["attributes"].update(status="building"))  # noqa: E731
    sealed_building()
    with pytest.raises(DsffnetError, match="leads out"):
        generate(tiny_dataset(), str(spoilable))
    with pytest.raises(DsffnetError):
        append(str(spoilable), training=5)


@pytest.mark.parametrize(
    "member", ["pose", "grid/training/0", "grid/training/0/vertices/c", "evaluation/seen/zarr.json"]
)
def test_fresh_removes_links_and_not_what_they_lead_to(
    dataset: str, spoilable: Path, victim: Path, member: str
) -> None:
    link(member, "victim")(spoilable)
    generate(tiny_dataset(), str(spoilable), fresh=True)
    assert tree_hash(spoilable) == tree_hash(dataset)


def test_a_folder_in_a_shards_place_that_holds_something_is_left_alone(spoilable: Path) -> None:
    folder(SHARD)(spoilable)
    (spoilable / SHARD / "thesis.txt").write_text("precious")
    with pytest.raises(DatasetError, match="move it away"):
        repair(str(spoilable), tiny_dataset(), list(find_faults(str(spoilable))))
    assert (spoilable / SHARD / "thesis.txt").read_text() == "precious"


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ESTALE])
@pytest.mark.parametrize("path", [SHARD, f"{FACES}/c/0/0", "grid/training/0/vertices/zarr.json"])
def test_an_object_that_cannot_be_read_is_a_fault_like_another(
    dataset: str,
    spoilable: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    path: str,
    number: int,
) -> None:
    """A bad sector: that file cannot be read as long as it lies there."""
    real, bad = LocalObjects.read, (spoilable / path).stat()

    def read(self: LocalObjects, asked: str, **options: Any) -> bytes | None:
        if asked == path and (spoilable / path).exists() and (spoilable / path).stat() == bad:
            raise OSError(number, os.strerror(number))
        return real(self, asked, **options)

    monkeypatch.setattr(LocalObjects, "read", read)
    with pytest.raises(DatasetError, match=rf"{path} .*{os.strerror(number)}.*--repair"):
        read_all(str(spoilable))
    main(["verify", str(spoilable), "--repair"])
    shown = capsys.readouterr().out
    assert f"fault: {path}: cannot be read" in shown and "is whole again" in shown
    assert tree_hash(spoilable) == tree_hash(dataset)


def test_a_shard_whose_header_lies_is_damaged_and_never_half_filled(spoilable: Path) -> None:
    """Blosc believes the sizes in its header, and a mesh smaller than its place leaves the rest as memory was."""
    import struct

    from datagen.common.errors import ShardDamage
    from datagen.store.codec import ShardCodec

    codec, small = ShardCodec(1, 1, 40, "lz4", 5), ShardCodec(1, 1, 32, "lz4", 5)
    file = small.encode([np.ones((1, 32, 3), np.float32)], 1, 1)
    with pytest.raises(ShardDamage, match="384 bytes instead of 480"):
        codec.decode(file, codec.rows_of(1, 1))
    chunk, out = bytearray(file[: -small.index_bytes]), np.empty((32, 3), np.float32)
    chunk[12:16] = struct.pack("<I", 10**6)
    with pytest.raises(ShardDamage):
        small.decode_mesh(bytes(chunk), out)


@pytest.mark.parametrize(
    "path", ["", "/etc/passwd", "..", "grid/../zarr.json", "grid", "grid/training/0/vertices/c", "zarr.json/",
             "grid/training/٣/zarr.json", "grid/other/0/zarr.json", "grid/training/0/vertices/c/0/0/0/1",
             "identity/0000/zarr.json", "manifest/c/0", "topology/0/faces/c/0/0/0", "./zarr.json", "a/zarr.json"]
)  # fmt: skip
def test_paths_that_no_object_has(path: str) -> None:
    assert not is_member(path)


def test_every_file_of_a_dataset_is_one_of_its_objects(dataset: str) -> None:
    files = [str(path.relative_to(dataset)) for path in Path(dataset).rglob("*") if path.is_file()]
    assert len(files) > 40 and all(map(is_member, files))
    leftovers = [f"{path.removesuffix('.json')}.0123abcd.partial" for path in files if path.endswith("zarr.json")]
    assert leftovers and all(map(is_leftover, leftovers)), "what a killed writer leaves of any of them is removed"


def test_an_array_that_no_reader_takes_is_not_written(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "LARGEST_CHUNK", 100)
    with pytest.raises(DatasetError, match=r"pose/parameters would have 104 bytes.*several datasets"):
        put_array(open_group(str(spoilable), mode="r+"), "pose/parameters", np.zeros(13), ("pose",))


def test_a_dataset_that_begins_while_it_is_looked_for_is_opened(dataset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process writes zarr.json after Zarr has found none."""
    real, asked = zarr.open_group, []

    def not_yet(*arguments: Any, **options: Any) -> zarr.Group:
        asked.append(arguments)
        if len(asked) == 1:
            raise FileNotFoundError("zarr.json")
        return real(*arguments, **options)

    monkeypatch.setattr(zarr, "open_group", not_yet)
    assert open_group(dataset).attrs["status"] == "complete"
