"""Where decoded meshes are kept: the fastest place that has room for them, said in words."""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from datagen.common.errors import RecipeError
from datagen.common.resources import bytes_text, free_disk, free_memory

Cache = Literal["auto", "device", "memory", "mapped", "stream"]
Place = Literal["device", "memory", "mapped", "stream"]

_DEVICE_SHARE = 0.4  # the rest is for weights and activations, which at 6,890 vertices take far more than meshes
_MEMORY_SHARE = 0.5
_DISK_SHARE = 0.8


@dataclass(frozen=True)
class Room:
    """Free bytes of one place, and the share of them that meshes may take."""

    where: str
    free: int
    share: float

    def holds(self, size: int) -> bool:
        """Whether there is room for that many bytes, and some to spare."""
        return size <= self.share * self.free


@dataclass(frozen=True)
class Choice:
    """Where meshes are kept, and why."""

    place: Place
    why: str


def device_room(device: torch.device) -> Room:
    """Free memory of a GPU."""
    return Room("device memory", int(torch.cuda.mem_get_info(device)[0]), _DEVICE_SHARE)


def memory_room() -> Room:
    """Free memory of this machine, or of the container that it runs in."""
    return Room("memory", free_memory(), _MEMORY_SHARE)


def disk_room(folder: Path) -> Room:
    """Free space of the disk on which a folder lies or will lie."""
    return Room(f"disk of {folder}", free_disk(folder), _DISK_SHARE)


def default_folder() -> Path:
    """Where memory-mapped files are kept: below DSFFNET_CACHE, or dsffnet in the user's cache folder.

    A user without a home, as containers have them, has a folder among the temporary ones.
    """
    for name, below in (("DSFFNET_CACHE", "vertices"), ("XDG_CACHE_HOME", "dsffnet/vertices")):
        if given := os.environ.get(name):
            return Path(given) / below
    try:
        return Path.home() / ".cache/dsffnet/vertices"
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"dsffnet-{os.getuid()}" / "vertices"


def choose(cache: Cache, size: int, *, device: torch.device, mapped: Callable[[], Path], sharers: int = 1) -> Choice:
    """Where to keep ``size`` bytes of meshes; ``mapped`` gives the path of the memory-mapped file, if it is asked for.

    ``auto`` is the first of device memory (on a GPU), memory, and a memory-mapped file that has room, else streaming.
    Memory must have it once for each of the ``sharers`` processes of this machine; a mapped file they share.

    Raises
    ------
    RecipeError
        A place was asked for that has not so many bytes free.
    """
    candidates: list[tuple[Place, Callable[[], tuple[int, Room]]]] = [
        ("memory", lambda: (size * sharers, memory_room())),
        ("mapped", lambda: (0 if os.path.exists(mapped()) else size, disk_room(mapped().parent))),
    ]
    if device.type == "cuda":
        candidates.insert(0, ("device", lambda: (size, device_room(device))))
    if cache == "device" and device.type != "cuda":
        cache = "memory"
    tried = []
    for place, look in candidates:
        if cache in ("auto", place):
            needed, room = look()
            if room.holds(needed) or (cache == place and needed <= room.free):
                return Choice(place, _why(place, size, needed, room))
            tried.append(f"{bytes_text(needed)} are too much for the {room.where} ({bytes_text(room.free)} free)")
    if cache not in ("auto", "stream"):
        raise RecipeError(f"training.cache is {cache!r}, but {tried[0]}. Use --set training.cache=auto")
    return Choice("stream", f"streamed, {bytes_text(size)} in all: {'; '.join(tried) or 'as the recipe says'}")


def _why(place: Place, size: int, needed: int, room: Room) -> str:
    copies = f" ({needed // size} processes: {bytes_text(needed)})" if needed > size else ""
    if place == "mapped":
        return f"memory-mapped file: {bytes_text(size)}" + (
            f", {bytes_text(room.free)} free on the {room.where}" if needed else " that is there already"
        )
    return f"{room.where}: {bytes_text(size)} of {bytes_text(room.free)} free{copies}"
