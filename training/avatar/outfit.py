"""The folder of an outfit: all that is made, step by step, of a person's scans in it before its points are learned.

subject.safetensors   body and scans (:class:`training.avatar.subject.Subject`)
field.safetensors     diffused skinning weights
samples.safetensors   points around the scans: canonical places, inside or not
surfaces.safetensors  points of the scans' outer surfaces
template.safetensors  the canonical surface that was learned
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

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
from training.checkpoints.weights import read_header, read_weights, write_weights_atomically


@dataclass(frozen=True)
class Outfit:
    """Paths within the folder of an outfit, and what lies there."""

    path: Path

    @property
    def name(self) -> str:
        """Of the outfit."""
        return self.path.name

    @property
    def samples(self) -> Path:
        """See :class:`OccupancySamples`."""
        return self.path / "samples.safetensors"

    @property
    def surfaces(self) -> Path:
        """See :class:`SurfaceSamples`."""
        return self.path / "surfaces.safetensors"

    @property
    def template_file(self) -> Path:
        """See :class:`training.avatar.template.Template`."""
        return self.path / "template.safetensors"

    @property
    def field_file(self) -> Path:
        """See :class:`training.avatar.diffusion.SkinningField`."""
        return self.path / "field.safetensors"

    @property
    def subject_file(self) -> Path:
        """See :class:`training.avatar.subject.Subject`."""
        return self.path / "subject.safetensors"

    def subject(self) -> Subject:
        """The body and its scans."""
        return Subject.load(self.subject_file)

    def field(self) -> SkinningField:
        """The field around the body."""
        return SkinningField.load(self.field_file)

    def occupancy_samples(self) -> "OccupancySamples":
        """Points around the scans."""
        return OccupancySamples.load(self.samples)

    def surface_samples(self) -> "SurfaceSamples":
        """Points of the scans."""
        return SurfaceSamples.load(self.surfaces)

    def template(self) -> Template:
        """The canonical surface."""
        return Template.load(self.template_file)

    @staticmethod
    def fingerprint(*files: Path) -> str:
        """What tells files from others: a hash over the hashes of their bytes.

        Raises
        ------
        CheckpointError
            One is missing.
        """
        for file in files:
            if not file.is_file():
                raise CheckpointError(f"{file} is missing. Make it: dsffnet avatar train with the same --out")
        return hashlib.sha256("".join(map(sha256_of, files)).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class OccupancySamples:
    """Points around all scans of an outfit: :class:`FrameSamples` with a leading axis of frames.

    ``conditions`` [frame, condition]: poses as the network is told of them; ``is_seen`` [frame]; ``hand_points``
    [m, 3], ``hand_inside`` [m]: :func:`training.avatar.occupancy.hand_samples`.
    """

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

    def save(self, path: Path) -> None:
        """Write them."""
        write_weights_atomically(path, vars(self), {"kind": "occupancy samples"})

    @classmethod
    def load(cls, path: Path) -> "OccupancySamples":
        """Read what :meth:`save` wrote (CheckpointError where it is something else)."""
        return cls(**_expected(path, tuple(cls.__dataclass_fields__)))


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points of the scans' outer surfaces ``points`` [frame, n, 3] with unit ``normals`` [frame, n, 3]."""

    points: Tensor
    normals: Tensor

    def save(self, path: Path) -> None:
        """Write them."""
        write_weights_atomically(path, vars(self), {"kind": "surface samples"})

    @classmethod
    def load(cls, path: Path) -> "SurfaceSamples":
        """Read what :meth:`save` wrote (CheckpointError where it is something else)."""
        return cls(**_expected(path, ("points", "normals")))


def _expected(path: Path, names: tuple[str, ...]) -> dict[str, Tensor]:
    read = read_weights(path)
    if read.keys() != set(names):
        raise CheckpointError(f"{path} holds {', '.join(sorted(read)[:5]) or 'nothing'}, not {', '.join(names)}")
    return read


def outfits_in(folder: Path) -> list[Outfit]:
    """The outfits of a folder, by name.

    Raises
    ------
    CheckpointError
        There is none.
    """
    found = [Outfit(path) for path in sorted(folder.glob("*/")) if (path / "subject.safetensors").is_file()]
    if not found:
        raise CheckpointError(f"{folder} holds no outfits. Make them: dsffnet avatar train --out {folder.parent}")
    return found


def is_sound(path: Path) -> bool:
    """Whether a file of an outfit is there and whole."""
    try:
        return bool(read_header(path))
    except (CheckpointError, UnsafeFileError):
        return False
