"""The folder of an outfit: all that is made, step by step, of a person's scans in it before its points are learned.

subject.safetensors   body and scans (:class:`training.avatar.subject.Subject`)
field.safetensors     diffused skinning weights
samples.safetensors   points around the scans: canonical places, inside or not
surfaces.safetensors  points of the scans' outer surfaces
template.safetensors  the canonical surface that was learned
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.errors import CheckpointError, UnsafeFileError
from datagen.common.files import sha256_of
from training.avatar.diffusion import SkinningField
from training.avatar.occupancy import FrameSamples
from training.avatar.subject import Subject
from training.avatar.template import Template
from training.checkpoints.tensor_record import TensorRecord
from training.checkpoints.weights import read_header

Kept = TypeVar("Kept")


@dataclass(frozen=True)
class Stored(Generic[Kept]):
    """A file of an outfit's folder, and what reads it."""

    path: Path
    read: Callable[[Path], Kept]

    def load(self) -> Kept:
        """What lies in it (CheckpointError where it is missing, damaged, or something else)."""
        return self.read(self.path)

    @property
    def is_sound(self) -> bool:
        """Whether it is there and whole."""
        try:
            return bool(read_header(self.path))
        except (CheckpointError, UnsafeFileError):
            return False


@dataclass(frozen=True)
class Outfit:
    """The folder of an outfit."""

    path: Path

    @property
    def name(self) -> str:
        """Of the outfit."""
        return self.path.name

    @property
    def subject(self) -> Stored[Subject]:
        """The body and its scans."""
        return Stored(self.path / "subject.safetensors", Subject.load)

    @property
    def field(self) -> Stored[SkinningField]:
        """The field around the body."""
        return Stored(self.path / "field.safetensors", SkinningField.load)

    @property
    def samples(self) -> "Stored[OccupancySamples]":
        """Points around the scans."""
        return Stored(self.path / "samples.safetensors", OccupancySamples.load)

    @property
    def surfaces(self) -> "Stored[SurfaceSamples]":
        """Points of the scans."""
        return Stored(self.path / "surfaces.safetensors", SurfaceSamples.load)

    @property
    def template(self) -> Stored[Template]:
        """The canonical surface."""
        return Stored(self.path / "template.safetensors", Template.load)

    @staticmethod
    def fingerprint(*files: Stored[Any]) -> str:
        """What tells files from others: a hash over the hashes of their bytes.

        Raises
        ------
        CheckpointError
            One is missing.
        """
        for file in files:
            if not file.path.is_file():
                raise CheckpointError(f"{file.path} is missing. Make it: dsffnet avatar train with the same --out")
        return hashlib.sha256("".join(sha256_of(file.path) for file in files).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class OccupancySamples(TensorRecord):
    """Points around all scans of an outfit: :class:`FrameSamples` with a leading axis of frames.

    ``conditions`` [frame, condition]: poses as the network is told of them; ``is_seen`` [frame]; ``hand_points``
    [m, 3], ``hand_inside`` [m]: :func:`training.avatar.occupancy.hand_samples`.
    """

    kind = "occupancy samples"
    roots: Tensor
    valid: Tensor
    inside: Tensor
    near: Tensor
    conditions: Tensor
    is_seen: Tensor
    hand_points: Tensor
    hand_inside: Tensor

    @property
    def count(self) -> int:
        """Points around a scan."""
        return self.roots.shape[1]

    @property
    def hands(self) -> tuple[Tensor, Tensor]:
        """Canonical points around the hands, and whether they are inside."""
        return self.hand_points, self.hand_inside

    @cached_property
    def seen(self) -> list[int]:
        """The frames that are learned from."""
        return torch.nonzero(self.is_seen).flatten().tolist()

    @cached_property
    def unseen(self) -> list[int]:
        """The others."""
        return torch.nonzero(~self.is_seen).flatten().tolist()

    def frame(self, frame: int, rows: NDArray[np.int64]) -> FrameSamples:
        """Some points of a frame."""
        return FrameSamples(*(its[frame][rows] for its in (self.roots, self.valid, self.inside, self.near)))


@dataclass(frozen=True, eq=False)
class SurfaceSamples(TensorRecord):
    """Points of the scans' outer surfaces ``points`` [frame, n, 3] with unit ``normals`` [frame, n, 3]."""

    kind = "surface samples"
    points: Tensor
    normals: Tensor


def outfits_in(folder: Path) -> list[Outfit]:
    """The outfits of a folder, by name.

    Raises
    ------
    CheckpointError
        There is none.
    """
    found = [Outfit(path) for path in sorted(folder.glob("*/")) if Outfit(path).subject.path.is_file()]
    if not found:
        raise CheckpointError(f"{folder} holds no outfits. Make them: dsffnet avatar train --out {folder.parent}")
    return found
