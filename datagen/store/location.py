"""Where datasets lie: folders and store URLs; whose they are, who may write, and removing them."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from datagen.common.errors import DatasetError, NoDataset
from datagen.store.object_names import MEMBERS
from datagen.store.objects import LocalObjects, delete_object, is_local, list_objects, plain
from datagen.store.schema import check_ours, check_version, lost_root, open_group

_FOLDERS = (*MEMBERS, "identity")
"""What a dataset's root holds, the last one in format 2."""


def remove(url: str) -> None:
    """Remove a dataset; nothing happens where there is none. Its root goes last, so that a rest is still known as ours.

    Raises
    ------
    DatasetError
        The place holds something that is not a dataset.
    """
    require_ours(url, fresh=True)
    if not is_local(url):
        _remove_remote(url)
        return
    folder = Path(plain(url))
    for member in _FOLDERS:
        if (folder / member).is_symlink():  # what it leads to is not ours
            (folder / member).unlink()
        shutil.rmtree(folder / member, ignore_errors=not (folder / member).exists())
    (folder / "zarr.json").unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # something of the person's is in it
        folder.rmdir()


def _remove_remote(url: str) -> None:
    try:
        group = open_group(url, mode="r+")
    except NoDataset:
        return
    check_version(url, group)  # of an older format other objects would be left
    for path in sorted(list_objects(group), key=lambda path: path == "zarr.json"):
        delete_object(group, path)


def require_ours(url: str, *, fresh: bool = False) -> None:
    """Refuse a place that holds anything but a dataset of ours, which can be ``fresh`` made without its zarr.json.

    Raises
    ------
    DatasetError
        It is a file, somebody else's Zarr group, a folder with other things in it, or a dataset that lost its root.
    """
    if not is_local(url):
        with contextlib.suppress(NoDataset):
            check_ours(url, open_group(url))
        return
    path = Path(plain(url))
    if path.exists() and not path.is_dir():
        raise DatasetError(f"{url} is a file, not a dataset. Choose another --out")
    there = sorted(entry.name for entry in path.iterdir()) if path.exists() else []
    if there and not _has_our_root(path):
        if LocalObjects(os.path.realpath(path)).has_lost_root():
            if fresh:
                return
            raise DatasetError(lost_root(url))
        raise DatasetError(f"{url} holds what is not a dataset ({there[0]}). Choose another --out")
    strangers = [name for name in there if not name.startswith(".") and name not in (*_FOLDERS, "zarr.json")]
    if strangers:
        raise DatasetError(f"{url} holds what is not a dataset ({strangers[0]}). Choose another --out")


def _has_our_root(path: Path) -> bool:
    """Whether the folder's zarr.json is one that we wrote, be it damaged since."""
    content = LocalObjects(path).read("zarr.json") or b""
    return b'"format_version"' in content or b'"recipe_sha256"' in content


@contextlib.contextmanager
def writing_alone(url: str) -> Iterator[None]:
    """Hold the right to write to a local dataset; the operating system gives it back if this process dies."""
    if not is_local(url):
        yield
        return
    lock = FileLock(f"{os.path.realpath(plain(url))}.lock")
    try:
        Path(lock.lock_file).parent.mkdir(parents=True, exist_ok=True)
        with lock.acquire(timeout=0):
            yield
    except Timeout as error:
        raise DatasetError(f"another process is writing to {url}. Wait for it, or stop it, then run again") from error
