"""Uploads: what is refused, in one line, and where files land whatever they are called."""

import io
import zipfile
from pathlib import Path

import pytest

from datagen.common.errors import MeshError
from datagen.mesh.files import read_mesh_file
from workflows.demo import uploads
from workflows.demo.uploads import keep

TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return written.getvalue()


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("../../etc/cron.d/body.obj", "body.obj"),
        ("..\\..\\body.OBJ", "body.OBJ"),
        ("/absolute.obj", "absolute.obj"),
        (".hidden.obj", "hidden.obj"),
        ("a b\x1b[31m\n.obj", "a b_31m_.obj"),
        ("\u202e.obj", "_.obj"),
        ("x" * 300 + ".obj", "x" * 60 + ".obj"),
    ],
)
def test_a_file_lands_in_its_folder_under_a_harmless_name(tmp_path: Path, name: str, kept: str) -> None:
    folder = tmp_path / "session" / "source-1"
    assert keep(name, TRIANGLE, folder) == [folder / kept]
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [folder / kept]


def test_frames_of_a_zip_come_in_natural_order_and_nothing_else(tmp_path: Path) -> None:
    content = zipped(
        {
            "walk/f10.obj": TRIANGLE,
            "walk/f2.obj": TRIANGLE,
            "walk/.f3.obj": b"",
            "__MACOSX/f4.obj": b"",
            "no.txt": b"",
        }
    )
    assert [path.name for path in keep("walk.zip", content, tmp_path / "s")] == ["f2.obj", "f10.obj"]
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["f10.obj", "f2.obj"]


@pytest.mark.parametrize("place", ["../../{}", "/{}", "..\\{}", "./../b/../{}"])
def test_nothing_of_a_zip_leaves_its_folder(tmp_path: Path, place: str) -> None:
    content = zipped({place.format("f.obj"): TRIANGLE})
    kept = keep("walk.zip", content, tmp_path / "session" / "s")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == kept
    assert kept[0].is_relative_to(tmp_path / "session" / "s")


def test_textures_of_a_zip_are_found_in_folders_and_by_names_with_spaces(tmp_path: Path) -> None:
    body = TRIANGLE.replace(b"f 1 2 3", b"v 0 0 1\nf 1/1 2/1 3/1\nf 1/1 2/1 4/1")
    mesh = b"mtllib My Body.mtl\nvt 0 0\nusemtl skin\n" + body
    library = b"newmtl skin\nmap_Kd textures/The Skin.PNG\n"
    content = zipped({"b/My Body.obj": mesh, "b/My Body.mtl": library, "b/textures/The Skin.PNG": b"\x89PNG"})
    read = read_mesh_file(keep("person.zip", content, tmp_path / "t", most=1)[0])
    assert read.content.companions().beside == {"My Body.mtl": library, "textures/The Skin.PNG": b"\x89PNG"}
    assert not read.content.companions().left_out


def test_a_damaged_zip_of_any_method_is_refused(tmp_path: Path) -> None:
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2):
        content = bytearray(zipped({"f.obj": TRIANGLE * 99}, method))
        content[45:60] = bytes(byte ^ 255 for byte in content[45:60])
        with pytest.raises(MeshError, match="cannot be read as a zip"):
            keep("walk.zip", bytes(content), tmp_path / "s")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("body.exe", b"MZ", "none of .obj"),
        ("body", b"", "none of .obj"),
        ("walk.zip", b"PK\x03\x04 not really", "cannot be read as a zip"),
        ("walk.zip", zipped({"readme.txt": b""}), "holds no mesh files"),
        ("walk.zip", zipped({"a/f.obj": TRIANGLE, "b/f.obj": TRIANGLE}), "meshes in 2 folders"),
        ("walk.zip", zipped({"a/f?.obj": TRIANGLE, "a/f*.obj": TRIANGLE}), "two files of one name"),
        ("walk.zip", zipped({"a.obj": TRIANGLE, "a.obj/a.mtl": b""}), "two files of one name"),
        ("two.zip", zipped({"f.obj": TRIANGLE, "g.obj": TRIANGLE}), "holds 2 meshes, 1 can be taken"),
        ("bomb.zip", zipped({"f.obj": bytes(3_000_000)}), "holds 3 MB, the page takes 2"),
    ],
)
def test_what_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: bytes, said: str) -> None:
    monkeypatch.setattr(uploads, "UNPACKED_LIMIT", 2 * 2**20)
    with pytest.raises(MeshError, match=said) as refused:
        keep(name, content, tmp_path / "s", most=1 if name == "two.zip" else 240)
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_too_large_is_refused_by_its_announced_size() -> None:
    with pytest.raises(MeshError, match=r"big\.obj has 200 MB, the page takes 64"):
        uploads.require_size("big.obj", 200 * 2**20)
    uploads.require_size("small.obj", uploads.BYTE_LIMIT)
