"""Whether decoded meshes fit into the memory of the device that trains, or are streamed."""

from dataclasses import dataclass
from typing import Literal

import torch

from datagen.common.errors import RecipeError
from datagen.common.resources import bytes_text, free_memory

Cache = Literal["auto", "device", "stream"]
_DEVICE_SHARE = 0.4  # the rest is for weights and activations, which at 6,890 vertices take far more than meshes
_MEMORY_SHARE = 0.5


@dataclass(frozen=True)
class Room:
    """Free bytes of a memory, the share of them that meshes may take, and the processes that each need as much."""

    where: str
    free: int
    share: float
    sharers: int = 1


@dataclass(frozen=True)
class Choice:
    """Where meshes are kept, and why."""

    place: Literal["device", "stream"]
    why: str


def room_of(device: torch.device, *, sharers: int = 1) -> Room:
    """Return the room of a GPU's memory, which no other process shares, or of this machine's (its container's)."""
    if device.type == "cuda":
        return Room("device memory", int(torch.cuda.mem_get_info(device)[0]), _DEVICE_SHARE)
    return Room("memory", free_memory(), _MEMORY_SHARE, sharers)


def stream_memory(*, sharers: int = 1) -> int:
    """Return the bytes of this machine's memory that each of the processes may hold streamed meshes in."""
    return int(_MEMORY_SHARE * free_memory() / sharers)


def choose(cache: Cache, size: int, room: Room) -> Choice:
    """Return where to keep ``size`` bytes of meshes; ``auto`` streams what takes more than the room's share.

    Raises
    ------
    RecipeError
        ``device`` was asked for and has not so many bytes free.
    """
    needed = size * room.sharers
    if cache != "stream" and needed <= (room.free if cache == "device" else room.share * room.free):
        copies = f" ({room.sharers} processes: {bytes_text(needed)})" if room.sharers > 1 else ""
        return Choice("device", f"{room.where}: {bytes_text(size)} of {bytes_text(room.free)} free{copies}")
    reason = f"{bytes_text(needed)} are too much for the {room.where} ({bytes_text(room.free)} free)"
    if cache == "device":
        raise RecipeError(f"training.cache is 'device', but {reason}. Use --set training.cache=auto")
    return Choice(
        "stream", f"streamed, {bytes_text(size)} in all: {'as the recipe says' if cache == 'stream' else reason}"
    )
