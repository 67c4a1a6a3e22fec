"""The poses of meshes, read off them by the parts network: rotations of joints, by which other bodies can be posed."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.arrays import Floats
from datagen.common.errors import CheckpointError, MeshError
from datagen.mesh.geometry import InFaces, Mesh
from training.inference.predict import load_trained
from training.inference.standing import MISREAD, facing, rest_error, sampled, stands, understanding_of
from training.networks.parts import Parts


class PosesRead(NamedTuple):
    """Axis-angle ``rotations`` [mesh, joint, 3] in radians over the tree of ``joints`` and ``parents``.

    The members of :class:`datagen.poses.Poses`, in their order.
    """

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    rotations: NDArray[np.float64]


def read_poses(weights: Sequence[Path], meshes: Iterable[Mesh]) -> PosesRead:
    """The pose of each mesh, over the joints that the network of ``weights`` tells apart.

    Of several weights those are taken that read the first mesh best (`training.inference.standing.rest_error`). How it
    stands is found, and which way each faces and leans. The root's place is not read: a body posed so stays where it
    stands.

    Raises
    ------
    CheckpointError
        There are no such weights, or they are those of another network than ``parts``.
    MeshError
        A mesh cannot be used, or is no body that the network knows.
    """
    networks = [_reader(each) for each in weights]
    frames = (InFaces.checked(mesh, name=f"mesh {number}").mesh for number, mesh in enumerate(meshes))
    first = list(islice(frames, 1 if len(networks) > 1 else 0))
    network = min(networks, key=lambda each: sum(_misread(each, mesh) for mesh in first))
    parents = [-1 if parent == part else parent for part, parent in enumerate(network.parents.tolist())]
    world = np.stack(list(_world_rotations(network, chain(first, frames))))
    return PosesRead(network.joints, tuple(parents), local_rotations(world, parents))


def local_rotations(world: Floats, parents: Iterable[int]) -> NDArray[np.float64]:
    """Axis-angles [pose, joint, 3] relative to the parent, of world rotations [pose, joint, 3, 3].

    The inverse of :func:`datagen.mesh.rig.world_rotations`.
    """
    turns = [world[:, own] if parent < 0 else world[:, parent].swapaxes(1, 2) @ world[:, own]
             for own, parent in enumerate(parents)]  # fmt: skip
    found = np.stack(turns, axis=1)
    return Rotation.from_matrix(found.reshape(-1, 3, 3)).as_rotvec().reshape(*found.shape[:2], 3)


def _reader(weights: Path) -> Parts:
    """The network of some weights."""
    network = load_trained(weights)[0]
    if not isinstance(network, Parts):
        raise CheckpointError(f"{weights} holds no weights of network 'parts', which reads poses off meshes")
    return network


def _misread(network: Parts, mesh: Mesh) -> float:
    """The rest error of a mesh as it is found to stand, in degrees."""
    found = stands(network, mesh)
    if not np.isnan(found.rest_error):
        return found.rest_error
    return rest_error(network, Mesh(found.upright(mesh.vertices), mesh.faces))


@torch.no_grad()
def _world_rotations(network: Parts, meshes: Iterable[Mesh]) -> Iterator[NDArray[np.float64]]:
    """Rotations [part, 3, 3] of each mesh, Y up, facing +Z at rest."""
    understand, axes, turn = understanding_of(network), None, np.eye(3)
    for number, mesh in enumerate(meshes):
        if axes is None:  # the others may turn round and bend
            axes = stands(network, mesh)
            turn = axes.lean
        upright = axes.turned(mesh.vertices)
        turn = facing(understand, upright, turn)
        drawn = sampled(network, Mesh(upright @ turn, mesh.faces))
        reading = network.read(drawn)
        if not (error := float(network.rest_error(reading, drawn))) <= MISREAD:
            raise MeshError(
                f"mesh {number} is no body whose pose these weights know (misread by {error:.0f} degrees, more than "
                f"{MISREAD:g}). Look at it, or leave it out"
            )
        yield turn @ network.read_again(drawn, reading).rotations[0].double().numpy()
