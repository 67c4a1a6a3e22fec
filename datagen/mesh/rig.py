"""Rigs: the parts of a body that move rigidly, and the exact transform of each in any pose. No body model is needed.

A body with a skeleton is posed by linear blend skinning: every part k carries points at rest by a transform G_k, and
vertex v goes to the sum over k of ``weights[v, k]`` times G_k (v, 1). Rotations come from the poses, places from the
identity's joints at rest. Part of a skinned body that a rig does not describe: displacements of the surface that depend
on the pose (SMPL's pose blend shapes, ``posedirs``), which are added at rest before skinning.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.arrays import Floats

_GRID = 2.0**20  # rotations are rounded to this, so that sines that differ in their last bit give the same meshes
NO_JOINT = -1
"""The driver of a part that no pose joint turns; the parent of a root."""


@dataclass(frozen=True, eq=False)
class Rig:
    """The parts of one identity's body; a bone that always moves as its parent does belongs to the parent's part.

    Parameters
    ----------
    names
        Name of each part, after its uppermost bone.
    parents
        Number of each part's parent, which comes before it; -1 for a root.
    drivers
        Number of the pose joint whose world rotation turns each part; -1 where none does.
    corrections
        Rotations [part, 3, 3] that lead from the body's rest to the rest pose of the pose joints; the identity where
        the two rest alike.
    weights
        Skinning weights [vertex, part] float32; those of a vertex sum to one.
    joints
        Places [part, 3] float32 at rest, metres, about which parts turn; a root stays in its place.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    drivers: tuple[int, ...]
    corrections: NDArray[np.float64]
    weights: NDArray[np.float32]
    joints: NDArray[np.float32]

    def rotations(self, world: NDArray[np.float64]) -> NDArray[np.float64]:
        """World rotations [..., part, 3, 3] of the parts, from those of the pose joints (:func:`world_rotations`)."""
        return driven(world, self.drivers) @ self.corrections

    def transforms(self, world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Transforms [..., part, 3, 4] from rest to the pose (:func:`part_transforms`)."""
        return part_transforms(self.rotations(world), self.joints.astype(np.float64), self.parents)


@dataclass(frozen=True, eq=False)
class Rigs:
    """The rigs of several identities whose bodies have the same parts.

    Parameters
    ----------
    names, parents, drivers, corrections
        As in :class:`Rig`.
    weights
        Skinning weights [kind, vertex, part] float32 of the different kinds; of most families there is one.
    kinds
        Kind [identity] int32 of each identity's weights.
    joints
        Places [identity, part, 3] float32 at rest.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    drivers: tuple[int, ...]
    corrections: NDArray[np.float64]
    weights: NDArray[np.float32]
    kinds: NDArray[np.int32]
    joints: NDArray[np.float32]

    def __getitem__(self, row: int) -> Rig:
        weights = self.weights[self.kinds[row]]
        return Rig(self.names, self.parents, self.drivers, self.corrections, weights, self.joints[row])


def world_rotations(rotations: NDArray[np.float64], parents: Sequence[int]) -> NDArray[np.float64]:
    """Rotations [pose, joint, 3, 3] of a tree's joints relative to rest, in world axes.

    ``rotations`` [pose, joint, 3] are axis-angles in radians relative to the parent: the product of them from the root
    on (SMPL, Loper et al. 2015, equation 4), rounded to 2^-20.
    """
    world = Rotation.from_rotvec(rotations.reshape(-1, 3)).as_matrix().reshape(*rotations.shape[:2], 3, 3)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ world[:, joint]
    return np.round(world * _GRID) / _GRID


def drivers_of(names: Sequence[str | None], parents: Sequence[int], joints: Sequence[str]) -> tuple[int, ...]:
    """Number within ``joints`` of the pose joint that turns each bone; -1 where none does.

    A bone whose name is not among them (or None) follows its parent; a root without one stays as it is.
    """
    known, found = {name: number for number, name in enumerate(joints)}, list[int]()
    for name, parent in zip(names, parents, strict=True):
        inherited = found[parent] if parent >= 0 else NO_JOINT
        found.append(inherited if name is None else known.get(name, inherited))
    return tuple(found)


def driven(world: NDArray[np.float64], drivers: Sequence[int]) -> NDArray[np.float64]:
    """World rotations [..., bone, 3, 3] of bones, each that of its driver among ``world`` [..., joint, 3, 3]."""
    still = np.broadcast_to(np.eye(3), (*world.shape[:-3], 1, 3, 3))
    return np.concatenate([world, still], axis=-3)[..., list(drivers), :, :]


def part_transforms(rotations: Floats, joints: Floats, parents: Sequence[int]) -> NDArray[np.float64]:
    """World transforms [..., part, 3, 4] that carry points at rest to their places in the pose.

    Parameters
    ----------
    rotations
        [..., part, 3, 3], relative to rest, in world axes.
    joints
        Places [..., part, 3] at rest; leading axes broadcast against those of ``rotations``.
    parents
        Number of each part's parent, which comes before it; -1 for a root, which stays in its place.
    """
    posed = np.empty(np.broadcast_shapes(rotations.shape[:-1], joints.shape))
    for part, parent in enumerate(parents):
        if parent < 0:
            posed[..., part, :] = joints[..., part, :]
        else:
            bone = joints[..., part, :] - joints[..., parent, :]
            posed[..., part, :] = posed[..., parent, :] + (rotations[..., parent, :, :] @ bone[..., None])[..., 0]
    offset = posed - (rotations @ joints[..., None])[..., 0]
    return np.concatenate([np.broadcast_to(rotations, (*offset.shape, 3)), offset[..., None]], axis=-1)


def skinned(vertices: Floats, weights: Floats, transforms: Floats) -> NDArray[np.float64]:
    """Posed vertices [pose, vertex, 3] of vertices [vertex, 3] at rest, for transforms [pose, part, 3, 4]."""
    blended = _blended(weights, transforms)
    return (blended[..., :3] @ vertices[..., None])[..., 0] + blended[..., 3]


def rest_vertices(posed: Floats, weights: Floats, transforms: Floats) -> NDArray[np.float64]:
    """Vertices [vertex, 3] at rest from posed ones [pose, vertex, 3]: least squares over the poses.

    The inverse of :func:`skinned`. A single pose may have vertices whose blended transform is singular (between parts
    that are turned by half a turn); several poses together have none.
    """
    blended = _blended(weights, transforms)
    matrices, wanted = blended[..., :3], posed - blended[..., 3]
    normal = np.einsum("pvij,pvik->vjk", matrices, matrices)
    return np.linalg.solve(normal, np.einsum("pvij,pvi->vj", matrices, wanted)[..., None])[..., 0]


def _blended(weights: Floats, transforms: Floats) -> NDArray[np.float64]:
    """Weighted mean [pose, vertex, 3, 4] of the parts' transforms at each vertex."""
    flat = np.asarray(transforms, np.float64).reshape(*transforms.shape[:-2], 12)
    return (np.asarray(weights, np.float64) @ flat).reshape(len(transforms), len(weights), 3, 4)
