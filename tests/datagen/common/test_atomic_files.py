"""Files that appear whole: on the disk before their name is, with the permissions that the person's umask gives."""

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.common.errors import StorageError
from datagen.common.files import atomic_file, write_atomically
from training.checkpoints.checkpoint import export_weights, require_checkpoint, save_checkpoint


@pytest.fixture(params=[0o000, 0o002, 0o022, 0o027, 0o077], ids=oct)
def umask(request: pytest.FixtureRequest) -> int:
    before = os.umask(request.param)
    request.addfinalizer(lambda: os.umask(before))
    return int(request.param)


def _written_file(folder: Path) -> None:
    write_atomically(folder / "sub" / "file.json", b"{}")


def _checkpoint(folder: Path) -> None:
    about = {"step": 1, "recipe": {}, "dataset": ""}
    save_checkpoint(folder / "run", about=about, weights={}, state={}, keep=1, best=True)


def _exported(folder: Path) -> None:
    _checkpoint(folder)
    export_weights(require_checkpoint(folder / "run"), folder / "exported")


@pytest.mark.parametrize("write", [_written_file, _checkpoint, _exported])
def test_files_and_folders_have_the_permissions_of_the_umask(
    tmp_path: Path, umask: int, write: Callable[[Path], None]
) -> None:
    folder = tmp_path / "out"
    write(folder)
    for path in (folder, *folder.rglob("*")):
        whole = 0o777 if path.is_dir() else 0o666
        assert stat.S_IMODE(path.stat().st_mode) == whole & ~umask, path


def test_its_content_reaches_the_disk_before_its_name_and_its_name_before_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, sync, replace = [], os.fsync, os.replace

    def synced(descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        done.append("folder" if path == tmp_path else path.read_bytes())
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", lambda *names: (done.append("renamed"), replace(*names)))
    write_atomically(tmp_path / "file", b"content")
    assert done == [b"content", "renamed", "folder"]


def test_a_file_that_fails_half_way_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"before")
    with pytest.raises(StorageError, match=r"could not write .*file: No space left"), atomic_file(path) as file:
        file.write(b"half")
        raise OSError(28, "No space left on device")
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
