"""Where datasets lie: folders and store URLs; whose they are, who may write, and removing them."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout
from zarr.core.sync import sync

from datagen.errors import DatasetError
from datagen.store.schema import NoDataset, check_ours, open_group


def is_local(url: str) -> bool:
    """Whether a store URL is a folder of a file system."""
    return "://" not in url


def remove(url: str) -> None:
    """Remove a dataset; nothing happens where there is none.

    Raises
    ------
    DatasetError
        The place holds something that is not a dataset.
    """
    if not is_local(url):
        _remove_remote(url)
        return
    require_ours(url)
    shutil.rmtree(url, ignore_errors=not Path(url).exists())


def _remove_remote(url: str) -> None:
    try:
        group = open_group(url, mode="r+")
    except NoDataset:
        return
    check_ours(url, group)
    sync(group.store.delete_dir(group.path))


def require_ours(url: str) -> None:
    """Refuse a local place that holds anything but a dataset of ours.

    Raises
    ------
    DatasetError
        It is a file, or a folder with other things in it.
    """
    path = Path(url)
    if path.is_file():
        raise DatasetError(f"{url} is a file, not a dataset. Choose another --out")
    strangers = {entry.name for entry in path.iterdir() if not entry.name.startswith(".")} if path.exists() else set()
    if strangers - _MEMBERS:
        raise DatasetError(
            f"{url} holds what is not a dataset ({sorted(strangers - _MEMBERS)[0]}). Choose another --out"
        )


_MEMBERS = {"zarr.json", "topology", "identity", "pose", "evaluation", "manifest"}


@contextlib.contextmanager
def writing_alone(url: str) -> Iterator[None]:
    """Hold the right to write to a local dataset; the operating system gives it back if this process dies."""
    if not is_local(url):
        yield
        return
    lock = FileLock(f"{os.path.abspath(url)}.lock")
    try:
        Path(lock.lock_file).parent.mkdir(parents=True, exist_ok=True)
        with lock.acquire(timeout=0):
            yield
    except Timeout as error:
        raise DatasetError(f"another process is writing to {url}. Wait for it, or stop it, then run again") from error
