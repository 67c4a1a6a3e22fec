"""Linear blend skinning in SMPL's convention, for every family that has joints and weights: fast, and exact.

Skinning is one sparse product: M [vertex, 4 joint] holds each weight times the vertex' homogeneous rest position,
and is multiplied with the joints' transforms of all poses at once.

Its numbers are multiples of fixed steps (rest vertices and rotations of 2^-20, which is a micrometre, joints and the
factors of products of 2^-24), so that float64 holds every product and every sum of them exactly. Then the order of
summation does not matter, and the bytes of a shard do not depend on the CPU, the BLAS or the number of threads.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from datagen.mesh.rig import Rig, part_transforms

VERTICES_AT_ONCE = 2**18
"""Of some poses together: 6 MB of float64, which stay in a CPU's cache and in memory that malloc does not give back."""
_COARSE, _FINE = 2.0**20, 2.0**24
_FEW_JOINTS = 3  # of so many a dense product is the quicker one; exact as it is, its numbers are the same
_ONE_THREAD = 2**18  # multiplications of a dense product, which larger BLAS divides among threads that wait for longer
_EXACT_WITHIN = 4.0  # metres from the origin; a larger body's steps are larger by powers of two

Weights: TypeAlias = NDArray[np.float64] | scipy.sparse.csr_array


@dataclass(frozen=True)
class Rest:
    """An identity at rest: vertices [vertex, 3] and joints [joint, 3] in metres; weights [vertex, joint]; parents."""

    vertices: NDArray[np.float64]
    joints: NDArray[np.float64]
    weights: Weights
    parents: Sequence[int]

    @cached_property
    def prepared(self) -> "_Prepared":
        """What all its poses have in common."""
        scale = _scale(self)
        coarse, fine = _COARSE / scale, _FINE / scale
        few = isinstance(self.weights, np.ndarray) and self.weights.shape[1] <= _FEW_JOINTS
        weights = self.weights if few else scipy.sparse.csr_array(self.weights)
        factors = _factors(_round(self.vertices, coarse), weights, fine)
        return _Prepared(_round(self.joints, fine), weights, factors, fine)


@dataclass(frozen=True)
class _Prepared:
    """An identity for the product: joints [joint, 3], weights, M [vertex, 4 joint], and steps to a metre."""

    joints: NDArray[np.float64]
    weights: Weights
    factors: Weights
    fine: float


def remembering(rest: Callable[[NDArray[np.float64]], Rest]) -> Callable[[NDArray[np.float64]], Rest]:
    """The same function from parameters to rest, which remembers its last identity: a task asks for few of its poses at
    a time. Nobody may change what it returns.
    """
    last = lru_cache(maxsize=1)(lambda values: rest(np.array(values)))
    return lambda parameters: last(tuple(parameters.tolist()))


def skin(rest: Rest, world: NDArray[np.float64], correctives: NDArray[np.float64] | None = None) -> NDArray[np.float32]:
    """Posed vertices [pose, vertex, 3] float32: each vertex moved by its weighted mean of joint transforms.

    Parameters
    ----------
    rest
        The identity.
    world
        Rotations [pose, joint, 3, 3] of the joints relative to rest, in world axes (:meth:`datagen.poses.Poses.on`).
    correctives
        Displacements [pose, vertex, 3] of the rest vertices in metres, such as SMPL's pose blend shapes.
    """
    body, world, count = rest.prepared, _round(world, _COARSE), len(rest.vertices)
    posed = np.empty((len(world), count, 3), np.float32)
    at_once = VERTICES_AT_ONCE // count
    if isinstance(body.factors, np.ndarray):
        at_once = min(at_once, _ONE_THREAD // (3 * body.factors.size))
    at_once = max(1, at_once)
    for first in range(0, len(world), at_once):
        some = slice(first, first + at_once)
        transforms = _round(part_transforms(world[some], body.joints, rest.parents), body.fine)
        columns = np.ascontiguousarray(transforms.transpose(1, 3, 0, 2)).reshape(-1, 3 * len(transforms))
        vertices = (body.factors @ columns).reshape(count, -1, 3).transpose(1, 0, 2)
        if correctives is not None:
            vertices = vertices + _turned(body.weights, world[some], correctives[some])
        posed[some] = vertices
    return posed


def rig_of(
    rest: Rest,
    names: Sequence[str],
    drivers: Sequence[int],
    corrections: NDArray[np.float64] | None = None,
) -> Rig:
    """Return the rig of an identity; bones that always move as their parents do are folded into them.

    Parameters
    ----------
    rest
        The identity; its vertices are not looked at.
    names
        Name of each bone.
    drivers
        Number of the pose joint that turns each bone, -1 for none (:func:`datagen.mesh.rig.drivers_of`).
    corrections
        Rotations [bone, 3, 3] by which each bone is turned before its joint's; none by default.
    """
    if corrections is None:
        corrections = np.tile(np.eye(3), (len(names), 1, 1))
    kept, part_of = list[int](), list[int]()
    for bone, parent in enumerate(rest.parents):
        rigid = parent >= 0 and drivers[bone] == drivers[parent]
        if rigid and np.array_equal(corrections[bone], corrections[parent]):
            part_of.append(part_of[parent])
        else:
            part_of.append(len(kept))
            kept.append(bone)
    weights = rest.weights
    if len(kept) < len(names) or not isinstance(weights, np.ndarray):
        weights = scipy.sparse.csr_array(weights) @ np.eye(len(kept))[part_of]
    return Rig(
        names=tuple(names[bone] for bone in kept),
        parents=tuple(part_of[rest.parents[bone]] if rest.parents[bone] >= 0 else -1 for bone in kept),
        drivers=tuple(drivers[bone] for bone in kept),
        corrections=corrections[kept],
        weights=weights.astype(np.float32),
        joints=rest.joints[kept].astype(np.float32),
    )


def _factors(vertices: NDArray[np.float64], weights: Weights, fine: float) -> Weights:
    """[vertex, 4 joint], sparse where the weights are: weight times (x, y, z, 1)."""
    homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
    if isinstance(weights, np.ndarray):
        return _round(weights[:, :, None] * homogeneous[:, None], fine).reshape(len(vertices), -1)
    rows = np.repeat(np.arange(len(vertices)), np.diff(weights.indptr))
    values = _round(weights.data[:, None] * homogeneous[rows], fine)
    columns = weights.indices[:, None] * 4 + np.arange(4, dtype=weights.indices.dtype)
    shape = (weights.shape[0], 4 * weights.shape[1])
    return scipy.sparse.csr_array((values.ravel(), columns.ravel(), 4 * weights.indptr), shape=shape)


def _turned(weights: Weights, world: NDArray[np.float64], correctives: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correctives turned by each vertex' blended rotation: sum over k of w_k R_k d."""
    poses, joints = world.shape[:2]
    factors = scipy.sparse.csr_array(weights)
    factors.data = _round(factors.data, _FINE)
    blended = (factors @ np.ascontiguousarray(world.transpose(1, 0, 2, 3)).reshape(joints, -1)).reshape(-1, poses, 3, 3)
    turned = _round(blended, _COARSE) @ _round(correctives, _FINE).transpose(1, 0, 2)[..., None]
    return np.asarray(turned[..., 0].transpose(1, 0, 2))


def _scale(rest: Rest) -> float:
    extent = max(float(np.abs(rest.vertices).max()), float(np.abs(rest.joints).max()), 1e-9)
    return float(2.0 ** max(0, np.ceil(np.log2(extent / _EXACT_WITHIN))))


def _round(values: NDArray[np.float64], per_unit: float) -> NDArray[np.float64]:
    return np.round(values * per_unit) / per_unit
