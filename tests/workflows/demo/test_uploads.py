"""Uploads: what is refused, in one line, and where files land whatever they are called."""

import io
import zipfile
from pathlib import Path

import pytest

from datagen.common.errors import MeshError
from workflows.demo import uploads
from workflows.demo.uploads import keep

TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def zipped(**files: bytes) -> bytes:
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name.replace("__", "/"), content)
    return written.getvalue()


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("../../etc/cron.d/body.obj", "body.obj"),
        ("..\\..\\body.OBJ", "body.obj"),
        ("/absolute.obj", "absolute.obj"),
        (".hidden.obj", "hidden.obj"),
        ("a b\x1b[31m\n.obj", "a_b_31m_.obj"),
        ("\u202e.obj", "_.obj"),
        ("x" * 300 + ".obj", "x" * 60 + ".obj"),
    ],
)
def test_a_file_lands_in_its_folder_under_a_harmless_name(tmp_path: Path, name: str, kept: str) -> None:
    folder = tmp_path / "session" / "source-1"
    assert keep(name, TRIANGLE, folder) == [folder / kept]
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [folder / kept]


def test_frames_of_a_zip_come_in_natural_order_without_its_folders(tmp_path: Path) -> None:
    content = zipped(**{"walk/f10.obj": TRIANGLE, "../f2.obj": TRIANGLE, "__MACOSX/._f2.obj": b"", "notes.txt": b""})
    assert [path.name for path in keep("walk.zip", content, tmp_path / "s")] == ["f2.obj", "f10.obj"]
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["f10.obj", "f2.obj"]


def test_materials_lie_beside_their_mesh(tmp_path: Path) -> None:
    content = zipped(**{"b/person.obj": TRIANGLE, "b/person.mtl": b"newmtl skin\n", "b/skin.png": b"\x89PNG"})
    assert [path.name for path in keep("person.zip", content, tmp_path / "t", most=1)] == ["person.obj"]
    assert (tmp_path / "t" / "person.mtl").exists() and (tmp_path / "t" / "skin.png").exists()


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("body.exe", b"MZ", "none of .obj"),
        ("body", b"", "none of .obj"),
        ("walk.zip", b"PK\x03\x04 not really", "cannot be read as a zip"),
        ("walk.zip", zipped(**{"readme.txt": b""}), "holds no mesh files"),
        ("walk.zip", zipped(**{"a/f.obj": TRIANGLE, "b/f.obj": TRIANGLE}), "two files of one name"),
        ("two.zip", zipped(**{"f.obj": TRIANGLE, "g.obj": TRIANGLE}), "holds 2 meshes, 1 can be taken"),
        ("bomb.zip", zipped(**{"f.obj": bytes(3_000_000)}), "holds 3 MB, the page takes 2"),
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
