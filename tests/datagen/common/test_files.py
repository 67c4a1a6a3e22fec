"""Files that somebody else named stay in their folder, are regular, and have a bounded size."""

import os
import tracemalloc
from pathlib import Path

import pytest

from datagen.common.errors import UnsafeFileError
from datagen.common.files import files_below, lock_within, read_bounded, refuse_links_out, resolve_within


@pytest.mark.parametrize("name", ["", ".", "/etc/hostname", "../secret", "a/../../secret", "a\0b", "..\\secret"])
def test_names_that_lead_out_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(UnsafeFileError):
        resolve_within(tmp_path / "folder", name)


def test_links_that_lead_out_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "secret").write_text("s")
    (tmp_path / "folder" / "file").symlink_to(tmp_path / "secret")
    (tmp_path / "folder" / "below").symlink_to(tmp_path)
    for name in ("file", "below/secret", "below/not-there"):
        with pytest.raises(UnsafeFileError, match="link"):
            resolve_within(tmp_path / "folder", name)


def test_links_out_of_a_folder_are_refused_with_what_else_to_do_but_for_those_that_are_named(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "x").symlink_to(tmp_path)
    refuse_links_out(tmp_path / "folder", but=("x",))
    with pytest.raises(UnsafeFileError, match=rf"link the whole folder {tmp_path}/folder instead .*; else remove it"):
        refuse_links_out(tmp_path / "folder", but=("y",))


def test_files_below_a_folder_are_all_found_whatever_else_lies_there(tmp_path: Path) -> None:
    (tmp_path / "folder" / "below").mkdir(parents=True)
    for name in ("a", "b", "below/c"):
        (tmp_path / "folder" / name).write_text(name)
    os.mkfifo(tmp_path / "folder" / "pipe")
    links = {"to-file": "a", "to-folder": tmp_path, "to-itself": "to-itself", "to-nothing": "none", "through": "a/x"}
    for name, leads_to in links.items():
        (tmp_path / "folder" / name).symlink_to(leads_to)
    found = {os.path.relpath(file.path, tmp_path / "folder") for file in files_below(tmp_path / "folder")}
    assert found == {"a", "b", "below/c", "to-file"}
    assert {file.name for file in files_below(tmp_path / "folder", but="other/below")} == {"a", "b", "c", "to-file"}
    assert {file.name for file in files_below(tmp_path / "folder", but="folder/below")} == {"a", "b", "to-file"}
    assert not list(files_below(tmp_path / "none")) and not list(files_below(tmp_path / "folder" / "a"))


def test_a_link_that_leads_to_itself_is_refused(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(UnsafeFileError, match="link"):
        resolve_within(tmp_path, "loop")


def test_a_folder_that_is_itself_reached_by_a_link_is_the_folder(tmp_path: Path) -> None:
    (tmp_path / "folder" / "a").mkdir(parents=True)
    (tmp_path / "other").symlink_to(tmp_path / "folder")
    assert resolve_within(tmp_path / "other", "a/b") == tmp_path / "folder" / "a" / "b"


def test_only_regular_files_of_bounded_size_are_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"12345")
    os.mkfifo(tmp_path / "pipe")
    assert read_bounded(tmp_path / "file", limit=5) == b"12345"
    with pytest.raises(UnsafeFileError, match="4 bytes"):
        read_bounded(tmp_path / "file", limit=4)
    os.mknod(tmp_path / "socket", 0o140600)
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "socket", Path("/dev/zero")):
        with pytest.raises(UnsafeFileError, match="regular"):
            read_bounded(path, limit=10)
    with pytest.raises(FileNotFoundError):
        read_bounded(tmp_path / "nothing", limit=5)


def test_what_is_too_long_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    os.truncate(tmp_path / "file", 2**36)
    tracemalloc.start()
    try:
        with pytest.raises(UnsafeFileError, match="longer than"):
            read_bounded(tmp_path / "file", limit=2**28)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_a_lock_is_a_regular_file_in_its_folder(tmp_path: Path) -> None:
    (tmp_path / "folder" / "taken").mkdir(parents=True)
    (tmp_path / "folder" / "link").symlink_to(tmp_path / "made")
    for name in ("link", "taken"):
        with pytest.raises(UnsafeFileError):
            lock_within(tmp_path / "folder", name)
    with lock_within(tmp_path / "folder", ".lock"):
        assert (tmp_path / "folder" / ".lock").is_file()
    assert not (tmp_path / "made").exists()
