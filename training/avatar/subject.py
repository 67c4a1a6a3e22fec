"""A person in one outfit as FITE learns from: the body below the clothes, and scans of the person in several poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.common.errors import CheckpointError
from datagen.mesh.geometry import Mesh
from datagen.mesh.rig import skinned, world_rotations
from training.avatar.body import CanonicalBody
from training.checkpoints.weights import read_header, read_weights, write_weights_atomically

_ARRAYS = ("scans", "faces", "parts", "transforms", "rotations", "is_seen")
_OF_BODY = ("vertices", "faces", "weights", "joints", "turns")


@dataclass(frozen=True, eq=False)
class Subject:
    """Scans are meshes in metres, Y up, whose vertices correspond.

    Attributes
    ----------
    name
        Of the outfit.
    source
        Where the scans are from: the dataset's uuid, or the sha256 of the file.
    body
        In the canonical pose.
    scans
        Vertices [frame, v, 3] float32.
    faces
        Triangles [f, 3] int64.
    parts
        Label [v] int64 of what each vertex belongs to: 0 skin, from 1 on garments.
    transforms
        Of the bones [frame, bone, 3, 4] float32, from the canonical pose.
    rotations
        Of the pose joints [frame, joint, 3] float32, axis-angle in radians relative to the parent.
    is_seen
        Which frames [frame] are learned from.
    """

    name: str
    source: str
    body: CanonicalBody
    scans: NDArray[np.float32]
    faces: NDArray[np.int64]
    parts: NDArray[np.int64]
    transforms: NDArray[np.float32]
    rotations: NDArray[np.float32]
    is_seen: NDArray[np.bool_]

    def scan(self, frame: int) -> Mesh:
        """The mesh of a frame."""
        return Mesh(self.scans[frame].astype(np.float64), self.faces)

    def posed(self, frame: int) -> Mesh:
        """The body below the clothes, as it stands in a frame."""
        transforms = self.transforms[frame][None].astype(np.float64)
        return Mesh(skinned(self.body.vertices, self.body.weights, transforms)[0], self.body.faces)

    @property
    def seen(self) -> list[int]:
        """The frames that are learned from."""
        return np.flatnonzero(self.is_seen).tolist()

    @property
    def unseen(self) -> list[int]:
        """The others."""
        return np.flatnonzero(~self.is_seen).tolist()

    def save(self, path: Path) -> None:
        """Write all of it into one file of safetensors."""
        body = self.body
        arrays = {f"body.{name}": getattr(body, name) for name in _OF_BODY}
        arrays |= {name: getattr(self, name) for name in _ARRAYS}
        bones = {name: list(getattr(body, name)) for name in ("names", "parents", "drivers")}
        tensors = {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}
        write_weights_atomically(path, tensors, {"name": self.name, "source": self.source, "bones": bones})

    @classmethod
    def load(cls, path: Path) -> "Subject":
        """Read what :meth:`save` wrote.

        Raises
        ------
        CheckpointError
            The file is missing, damaged, or holds something else.
        """
        read, about = read_weights(path), read_header(path)
        if read.keys() != {*(f"body.{name}" for name in _OF_BODY), *_ARRAYS} or not {"bones", "source"} <= about.keys():
            raise CheckpointError(f"{path} holds no scans of a person. Remove it, then run the same command again")
        arrays = {name: tensor.numpy() for name, tensor in read.items()}
        bones: dict[str, Any] = {name: tuple(its) for name, its in about["bones"].items()}
        of_body: dict[str, Any] = {name: arrays[f"body.{name}"] for name in _OF_BODY}
        body = CanonicalBody(**of_body, **bones)
        return cls(about["name"], about["source"], body, **{name: arrays[name] for name in _ARRAYS})


def posed_by(
    body: CanonicalBody, rotations: Floats, joints: Sequence[str], parents: Sequence[int]
) -> NDArray[np.float32]:
    """Transforms [frame, bone, 3, 4] of a body's bones for rotations [frame, joint, 3] of the pose joints."""
    world = world_rotations(np.asarray(rotations, np.float64), parents)
    return body.transforms(world, joints).astype(np.float32)
