"""Linear blend skinning in SMPL's convention, for every family that has joints and weights.

All of it runs in float64 on one BLAS thread and is rounded to float32 at the end, so that the bytes of a shard
do not depend on how many threads a worker happens to have.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

_POSES_AT_ONCE = 32  # bounds memory: 32 poses x 13,718 vertices x 12 transform entries x 8 bytes = 42 MB


@dataclass(frozen=True)
class Rest:
    """An identity at rest: vertices [vertex, 3] and joints [joint, 3] in metres; weights [vertex, joint]; parents."""

    vertices: NDArray[np.float64]
    joints: NDArray[np.float64]
    weights: NDArray[np.float64]
    parents: Sequence[int]


def joint_transforms(rest: Rest, rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """World transforms [pose, joint, 3, 4] that carry rest positions to posed ones.

    ``rotations`` [pose, joint, 3, 3] are relative to the parent, in axes aligned with the rest pose
    (SMPL, Loper et al. 2015, equations 3 and 4). Parents come before their children; the root's is -1.
    """
    posed = np.empty((len(rotations), len(rest.joints), 3))
    world = np.empty_like(rotations)
    for joint, parent in enumerate(rest.parents):
        if parent < 0:
            world[:, joint], posed[:, joint] = rotations[:, joint], rest.joints[joint]
            continue
        world[:, joint] = world[:, parent] @ rotations[:, joint]
        posed[:, joint] = posed[:, parent] + world[:, parent] @ (rest.joints[joint] - rest.joints[parent])
    offset = posed - np.einsum("pjik,jk->pji", world, rest.joints)
    return np.concatenate([world, offset[..., None]], axis=-1)


def skin(rest: Rest, rotations: NDArray[np.float64]) -> NDArray[np.float32]:
    """Posed vertices [pose, vertex, 3] float32: each vertex moved by its weighted mean of joint transforms."""
    homogeneous = np.concatenate([rest.vertices, np.ones((len(rest.vertices), 1))], axis=1)
    posed = np.empty((len(rotations), len(rest.vertices), 3), np.float32)
    with threadpool_limits(limits=1):
        for first in range(0, len(rotations), _POSES_AT_ONCE):
            transforms = joint_transforms(rest, rotations[first : first + _POSES_AT_ONCE])
            blended = np.tensordot(rest.weights, transforms, axes=([1], [1]))  # [vertex, pose, 3, 4]
            posed[first : first + _POSES_AT_ONCE] = np.einsum("vpik,vk->pvi", blended, homogeneous)
    return posed
