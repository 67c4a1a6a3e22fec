"""Mesh files and archives of somebody else's that want more than to be read: one line, at once, and little memory."""

import io
import json
import os
import pickle
import struct
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.bodies.smpl_family import safe_pickle as unpickling
from datagen.bodies.smpl_family import safe_pickle_arrays as recorded_arrays
from datagen.bodies.smpl_family.model_file import KEYS
from datagen.bodies.smpl_family.model_file import read_arrays as read_model_arrays
from datagen.characters import cc0_animals as animals
from datagen.common import npz as archives
from datagen.common.errors import DsffnetError, MeshError
from datagen.common.npz import FAULTS, read_arrays
from datagen.mesh import limits as mesh_limits
from datagen.mesh.files import MeshFile, load_mesh, read_mesh_file, write_posed
from datagen.mesh.formats import FORMATS, gltf
from datagen.mesh.formats import mtl as mesh_materials
from datagen.mesh.formats.gltf import Gltf
from datagen.poses.amass_files import find_motions
from datagen.poses.pose_files import read_pose_file
from tests.support.shapes.mesh_files import FACES, POINTS, scene
from tests.support.shapes.rigged_files import Document, Rig

SECRET = b"newmtl skin\nKd 1 1 1\n# the key to the house\n"
TETRAHEDRON = "".join("v {} {} {}\n".format(*row) for row in POINTS) + "".join(
    "f {} {} {}\n".format(*row) for row in FACES + 1
)
PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
MEGABYTE = 2**20


@contextmanager
def within(megabytes: int) -> Iterator[None]:
    """The block takes no more memory than that."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < megabytes * MEGABYTE, f"{peak / MEGABYTE:.0f} MB"


def one_line(error: BaseException, name: str) -> bool:
    return "\n" not in str(error) and name in str(error) and len(str(error)) < 1000


def textured(folder: Path, head: str = "mtllib look.mtl\n", suffix: str = ".obj") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if suffix == ".obj":
        (folder / "mesh.obj").write_text(head + "usemtl skin\n" + TETRAHEDRON)
        return folder / "mesh.obj"
    faces = "".join("3 {} {} {}\n".format(*row) for row in FACES)
    header = PLY.format("ascii", 4).replace("element", f"comment TextureFile {head}\nelement")
    header += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    (folder / "mesh.ply").write_text(header + "".join("{} {} {}\n".format(*row) for row in POINTS) + faces)
    return folder / "mesh.ply"


def everything_written(mesh: Path, out: Path) -> bytes:
    """All bytes that are written for a mesh in every format, and beside it."""
    read = read_mesh_file(mesh)
    for suffix in FORMATS:
        write_posed(read, read.mesh.vertices, out / suffix[1:] / f"posed{suffix}")
    return b"".join(path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file())


def linked_library(home: Path, secret: Path) -> Path:
    mesh = textured(home)
    (home / "look.mtl").symlink_to(secret)
    return mesh


def linked_texture(home: Path, secret: Path) -> Path:
    mesh = textured(home)
    (home / "look.mtl").write_text("newmtl skin\nmap_Kd skin.png\nmap_Bump ../secret\nnorm sub/../../secret\n")
    (home / "skin.png").symlink_to(secret)
    return mesh


def linked_folder(home: Path, secret: Path) -> Path:
    mesh = textured(home, "mtllib sub/secret\nmtllib ..\\secret\nmtllib .\n")
    (home / "sub").symlink_to(secret.parent)
    return mesh


def linked_ply_texture(home: Path, secret: Path) -> Path:
    mesh = textured(home, "skin.png", ".ply")
    (home / "skin.png").symlink_to(secret)
    return mesh


def linked_glb_image(home: Path, secret: Path) -> Path:
    document = scene()
    document.json["images"][0] = {"uri": "skin.png"}
    home.mkdir(parents=True)
    (home / "skin.png").symlink_to(secret)
    return document.save(home / "scene.glb")


@pytest.mark.parametrize("named", [linked_library, linked_texture, linked_folder, linked_ply_texture, linked_glb_image])
def test_what_a_mesh_names_outside_of_its_folder_is_not_carried_off(
    tmp_path: Path, named: Callable[[Path, Path], Path]
) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(b"\x89PNG" + SECRET)
    mesh = named(tmp_path / "home", secret)
    assert SECRET not in everything_written(mesh, tmp_path / "out")


@pytest.mark.parametrize("kind", ["device", "pipe", "folder", "link to itself", "a name of 300 letters"])
def test_a_library_that_is_no_file_is_noted_and_the_mesh_is_written(tmp_path: Path, kind: str) -> None:
    mesh = textured(tmp_path / "home", f"mtllib {'x' * 300}\n" if "300" in kind else "mtllib look.mtl\n")
    place = tmp_path / "home" / "look.mtl"
    if kind == "device":
        place.symlink_to("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(place)
    elif kind == "folder":
        place.mkdir()
    elif kind == "link to itself":
        place.symlink_to("look.mtl")
    read = read_mesh_file(mesh)
    (note,) = write_posed(read, read.mesh.vertices, tmp_path / "out" / "posed.obj").left_out
    assert note.startswith("materials: ") and [p.name for p in (tmp_path / "out").iterdir()] == ["posed.obj"]


def test_what_a_mesh_names_is_bounded_in_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = textured(tmp_path / "home", "mtllib " + " ".join(f"{n}.mtl" for n in range(30)) + "\n")
    for number in range(30):
        (tmp_path / "home" / f"{number}.mtl").write_bytes(b"#" * 1000)
    monkeypatch.setattr(mesh_materials, "NAMED_LIMIT", 5_500)
    found = read_mesh_file(mesh).content.companions()
    assert len(found.beside) == 5 and len(found.left_out) == 25 and "longer than" in found.left_out[0]
    monkeypatch.setattr(mesh_materials, "NAMED_LIMIT", MEGABYTE)
    monkeypatch.setattr(mesh_materials, "_MOST_FILES", 10)
    found = read_mesh_file(mesh).content.companions()
    assert len(found.beside) == 10 and len(found.left_out) == 10, "what is beyond is not even noted for ever"


def test_the_ending_of_a_texture_that_somebody_named_adds_no_lines_to_the_library(tmp_path: Path) -> None:
    document = scene()
    document.json["images"][0] = {"uri": "data:,AAAA", "name": "skin.x\nmap_Kd y"}
    document.json["materials"][0]["name"] = "skin\nmap_Kd /etc/passwd"
    read = read_mesh_file(document.save(tmp_path / "scene.glb"))
    write_posed(read, read.mesh.vertices, tmp_path / "out" / "posed.obj")
    lines = (tmp_path / "out" / "posed.mtl").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["newmtl", "Kd", "map_Kd", "newmtl", "Kd"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["posed-0", "posed.mtl", "posed.obj"]


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("kind", ["device", "pipe", "folder", "of the kernel", "10 GB", "name with a zero"])
def test_what_is_no_file_of_a_size_is_refused_at_once(tmp_path: Path, suffix: str, kind: str) -> None:
    path = tmp_path / f"mesh{suffix}"
    if kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "of the kernel":
        path.symlink_to("/proc/self/status")
    elif kind == "10 GB":
        with path.open("wb") as file:
            file.write(b"ply\nformat ascii 1.0\nelement vertex 4\nend_header\n" if suffix == ".ply" else b"OFF 4 4 0\n")
            file.truncate(10 * 2**30)
    else:
        path = tmp_path / f"mesh\0{suffix}"
    for read in (read_mesh_file, load_mesh):
        with within(20), pytest.raises(MeshError) as caught:
            read(path)
        assert one_line(caught.value, str(path))


def glb(change: Callable[[Document], Any]) -> Callable[[Path], Path]:
    def save(folder: Path) -> Path:
        document = scene()
        change(document)
        return document.save(folder / "mesh.glb")

    return save


def primitives(document: Document) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = document.json["meshes"][0]["primitives"]
    return found


def with_zeros(document: Document) -> None:
    """Attributes that are nowhere in the file: zeros, of which it says how many."""
    for number in range(4):
        document.json["accessors"].append({"componentType": 5126, "type": "VEC4", "count": 60_000_000})
        for primitive in primitives(document):
            primitive["attributes"][f"_{number}"] = len(document.json["accessors"]) - 1


def with_one_place_for_all(document: Document) -> None:
    view = document.view(bytes(4 * MEGABYTE))
    document.json["images"] = [{"bufferView": view, "mimeType": "image/png"}] * 400


def with_indices_again_and_again(document: Document) -> None:
    indices = document.accessor(np.zeros(300_000, np.uint16), "uint16")
    primitives(document)[0]["indices"] = indices
    document.json["meshes"][0]["primitives"] = [primitives(document)[0]] * 400


def with_many_vertices(document: Document) -> None:
    document.json["meshes"][0]["primitives"] = [
        {"attributes": {"POSITION": document.accessor(np.zeros((10_000, 3)))}} for _ in range(11)
    ]


def with_nothing_between_elements(document: Document) -> None:
    document.json["accessors"][0] |= {"count": 90_000, "sparse": {"count": 2**40, "indices": {"bufferView": 0,
        "componentType": 5125}, "values": {"bufferView": 0}}}  # fmt: skip
    document.json["bufferViews"][0]["byteStride"] = -4


def with_brackets(document: Document) -> None:
    document.json["extras"] = [[]] * 300_000


def binary_ply(folder: Path) -> Path:
    """A list of -1 values, which NumPy takes for: all that is left."""
    head = PLY.format("binary_little_endian", 4) + "element face 20000\nproperty list char int vertex_indices\n"
    body = POINTS.tobytes() + b"\x03" + struct.pack("<3i", 0, 1, 2) + b"\xff" * 30_001
    (folder / "mesh.ply").write_bytes((head + "end_header\n").encode() + body)
    return folder / "mesh.ply"


def text(name: str, content: str) -> Callable[[Path], Path]:
    def save(folder: Path) -> Path:
        (folder / name).write_text(content)
        return folder / name

    return save


WIDE = "1" * 200_000
ROWS = "".join(f"{n} {n % 7} {n % 3}\n" for n in range(1000))
GREEDY: dict[str, Callable[[Path], Path]] = {
    "GLB: zeros of which it only says how many": glb(with_zeros),
    "GLB: images of one place": glb(with_one_place_for_all),
    "GLB: primitives of the same indices": glb(with_indices_again_and_again),
    "GLB: many meshes of vertices": glb(with_many_vertices),
    "GLB: elements that overlap": glb(with_nothing_between_elements),
    "GLB: brackets": glb(with_brackets),
    "PLY: 1e12 of something": text("mesh.ply", PLY.format("ascii", 4) + "element x 999999999999\nend_header\n"),
    "PLY: fewer than none": text("mesh.ply", PLY.format("ascii", -1) + "end_header\n"),
    "PLY: two of a name": text("mesh.ply", PLY.format("ascii", 4) + "element vertex 4\nend_header\n" + ROWS),
    "PLY: a list of less than nothing": binary_ply,
    "PLY: a wide word": text("mesh.ply", PLY.format("ascii", 1001) + "end_header\n" + ROWS + f"0 {WIDE} 0\n"),
    "OFF: a wide word": text("mesh.off", f"OFF\n1001 1 0\n{ROWS}0 {WIDE} 0\n3 0 1 2\n"),
    "OFF: 1e9 faces": text("mesh.off", "OFF\n4 999999999 0\n" + ROWS),
    "STL: a wide word": text("mesh.stl", "solid\n" + "vertex 1 2 3\n" * 3000 + f"vertex {WIDE} 0 0\nendsolid\n"),
    "STL: 2e9 triangles": text("mesh.stl", "x" * 84),
    "OBJ: words": text("mesh.obj", TETRAHEDRON + "f" + " 1" * 300_000),
    "OBJ: lines": text("mesh.obj", TETRAHEDRON + "\n" * 300_000),
}


@pytest.mark.parametrize("what", sorted(GREEDY))
def test_little_files_that_ask_for_much_memory_get_none(
    tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Limits are lower here, so that the files may be small."""
    path = GREEDY[what](tmp_path)
    monkeypatch.setattr(gltf, "LARGEST", 20 * MEGABYTE)
    lowered = {
        "VERTEX_LIMIT": 100_000, "_CORNER_LIMIT": 1_000_000, "_LINE_LIMIT": 100_000, "_WORD_LIMIT": 200_000,
        "_JSON_VALUES": 500_000,
    }  # fmt: skip
    for name, value in lowered.items():
        monkeypatch.setattr(mesh_limits, name, value)
    with within(100), pytest.raises(MeshError) as caught:
        read_mesh_file(path)
    assert one_line(caught.value, str(path))


def test_a_mesh_of_many_repeated_corners_is_read_within_those_limits(tmp_path: Path) -> None:
    """What is refused above is not what a person has: the same files, sound."""
    for suffix in (".obj", ".ply"):
        assert isinstance(read_mesh_file(textured(tmp_path, "look", suffix)), MeshFile)
    assert isinstance(read_mesh_file(scene().save(tmp_path / "scene.glb")), MeshFile)


@pytest.mark.parametrize("kind", ["link", "device", "too long"])
def test_buffers_of_a_character_are_beside_it_and_bounded(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = Rig().save(tmp_path / "in" / "file.gltf")
    buffer = tmp_path / "in" / "file data.bin"
    if kind == "link":
        buffer.rename(tmp_path / "secret.bin")
        buffer.symlink_to(tmp_path / "secret.bin")
    elif kind == "device":
        buffer.unlink()
        buffer.symlink_to("/dev/zero")
    else:
        monkeypatch.setattr(gltf, "LARGEST", path.stat().st_size)
        buffer.write_bytes(bytes(path.stat().st_size + 1))
    with within(20), pytest.raises(DsffnetError) as caught:
        Gltf(path).accessor(0)
    assert one_line(caught.value, "file")


def bomb(path: Path, names: tuple[str, ...], *, method: int = zipfile.ZIP_DEFLATED, promised: int = 2**33) -> Path:
    """An archive of little that says it holds much: zeros, or a shape without them."""
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({promised // 8},), }}".ljust(117).encode() + b"\n"
    with zipfile.ZipFile(path, "w", method) as archive:
        for name in names:
            with archive.open(f"{name}.npy", "w") as member:
                member.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head)
                member.write(bytes(3 * MEGABYTE))
    return path


def lying(path: Path, names: tuple[str, ...]) -> Path:
    """The same, whose directory says that each member has 1,000 bytes."""
    content = bytearray(bomb(path, names).read_bytes())
    place = content.find(b"PK\x01\x02")
    while place >= 0:
        struct.pack_into("<I", content, place + 24, 1000)
        place = content.find(b"PK\x01\x02", place + 1)
    path.write_bytes(content)
    return path


ARCHIVES: dict[str, Callable[[Path, tuple[str, ...]], Path]] = {
    "more than is read": bomb,
    "less than it unpacks to": lying,
    "packed without a limit": lambda path, names: bomb(path, names, method=zipfile.ZIP_LZMA, promised=2**20),
    "a shape without its numbers": lambda path, names: bomb(path, names, promised=2**22),
}


@pytest.mark.parametrize("kind", sorted(ARCHIVES))
@pytest.mark.parametrize("reader", ["arrays", "poses", "model", "motions"])
def test_archives_that_unpack_to_more_than_they_say_are_not_unpacked(
    tmp_path: Path, kind: str, reader: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "LARGEST", 2 * MEGABYTE)
    monkeypatch.setattr(recorded_arrays, "_LARGEST", 2 * MEGABYTE)
    path = ARCHIVES[kind](tmp_path / "x.npz", KEYS if reader == "model" else ("poses", "joints"))
    readers: dict[str, Callable[[], Any]] = {
        "arrays": lambda: read_arrays(path, ("poses",)),
        "poses": lambda: read_pose_file(path),
        "model": lambda: read_model_arrays(path, KEYS),
        "motions": lambda: find_motions(str(path)),
    }
    with within(2), pytest.raises(FAULTS if reader == "arrays" else DsffnetError) as caught:
        readers[reader]()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("zip64", [False, True])
def test_an_archive_of_a_million_members_is_refused_before_its_directory_is_read(tmp_path: Path, zip64: bool) -> None:
    """Here one 40,000 times; ZIP64 says elsewhere how long its directory is."""
    path = tmp_path / "x.npz"
    np.savez(path, poses=np.zeros(3))
    with zipfile.ZipFile(path, "a") as archive:
        archive.filelist += archive.filelist * 40_000
        archive.writestr("last", b"")
    if zip64:
        content = path.read_bytes()
        end, place = content[-22:], len(content) - 22
        counts = struct.unpack("<HHII", end[8:20])
        record = struct.pack("<4sQHHIIQQQQ", b"PK\x06\x06", 44, 45, 45, 0, 0, *counts)
        locator = struct.pack("<4sIQI", b"PK\x06\x07", 0, place, 1)
        path.write_bytes(content[:place] + record + locator + end[:8] + b"\xff" * 12 + end[20:])
    with pytest.raises(ValueError, match="its directory has 2,"):
        read_arrays(path, ("poses",))


def test_an_array_of_an_unknown_version_is_refused() -> None:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (3,), }\n"
    with pytest.raises(ValueError, match=r"its format version \(9, 9\) is not known"):
        archives.array_header(io.BytesIO(b"\x93NUMPY\x09\x09" + struct.pack("<I", len(header)) + header))


@pytest.mark.parametrize(
    "read", [lambda path: read_arrays(path, ("a",)), read_pose_file, lambda p: find_motions(str(p.parent))]
)
def test_a_pipe_for_an_archive_is_not_waited_for(tmp_path: Path, read: Callable[[Path], Any]) -> None:
    os.mkfifo(tmp_path / "x.npz")
    with pytest.raises((DsffnetError, ValueError)):
        read(tmp_path / "x.npz")


@pytest.mark.parametrize("program", [b"I1\nr\xff\xff\xff\x07.", b"\x80\x02" + b"]" * 10_002 + b"."])
def test_a_pickle_of_few_bytes_that_asks_for_gigabytes(
    tmp_path: Path, program: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(unpickling, "_MOST_STEPS", 10_000)
    (tmp_path / "model.pkl").write_bytes(program)
    with within(100), pytest.raises(DsffnetError, match="more memory than any body model") as caught:
        read_model_arrays(tmp_path / "model.pkl", KEYS)
    assert one_line(caught.value, "model.pkl")


def test_an_honest_pickle_is_still_read(tmp_path: Path) -> None:
    content = {key: np.arange(6.0).reshape(2, 3) for key in KEYS}
    for protocol in range(6):
        (tmp_path / "model.pkl").write_bytes(pickle.dumps(content, protocol))
        assert np.array_equal(read_model_arrays(tmp_path / "model.pkl", KEYS)["f"], content["f"])


def test_an_animal_that_never_ends_is_not_the_one_that_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DSFFNET_CACHE", str(tmp_path))
    folder = tmp_path / animals._PACKAGE.replace("==", "-")
    folder.mkdir()
    (folder / f"{animals.NAMES[0]}.glb").symlink_to("/dev/zero")
    with within(20), pytest.raises(DsffnetError, match=r"not the animal that is known.*not a regular file"):
        animals.animal_files()


def test_deep_json_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "deep.gltf").write_text('{"asset":{"version":"2.0"},"extras":' + "[" * 100_000 + "]" * 100_000 + "}")
    with pytest.raises(DsffnetError) as caught:
        Gltf(tmp_path / "deep.gltf")
    assert one_line(caught.value, "deep.gltf")
    assert json.loads('{"sound": true}') == mesh_limits.parse_json(b'{"sound": true}')
