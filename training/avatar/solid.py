"""Whether points lie inside of triangle meshes, and which vertices are seen from outside: Warp's queries on the CPU.

Inside is where the generalised winding number (Jacobson et al. 2013; fast form of Barill et al. 2018) is above one
half. So meshes may have holes, as garments have: an open tube counts as filled up to about its hem.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.common.quiet_warp import wp
from training.avatar.kernels import depth, seen

_DIRECTIONS = 64


class Solid:
    """What closed or open triangles ``faces`` [f, 3] over ``vertices`` [v, 3], looking outwards, enclose."""

    def __init__(self, vertices: Floats, faces: NDArray[np.integer]) -> None:
        indices = wp.array(np.ascontiguousarray(faces, np.int32).ravel(), dtype=wp.int32, device="cpu")
        self._mesh = wp.Mesh(points=_vectors(vertices), indices=indices, support_winding_number=True)

    def depth(self, points: Floats) -> NDArray[np.float32]:
        """How deep points [n, 3] lie inside, as distances [n] from the surface; negative outside."""
        found = wp.empty(len(points), dtype=wp.float32, device="cpu")
        _launch(depth, len(points), self._mesh.id, _vectors(points), found)
        return np.asarray(found.numpy())

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Whether points [n, 3] lie inside [n]."""
        return self.depth(points) > 0

    def seen(self, points: Floats, normals: Floats) -> NDArray[np.bool_]:
        """Whether anything far away sees points [n, 3] of the surface, whose outward unit normals [n, 3] are given.

        One of 64 rays from each point, all to the outer side, must meet nothing: the insides of a mouth are not seen.
        """
        found = wp.empty(len(points), dtype=wp.int32, device="cpu")
        extent = float(np.ptp(np.asarray(points), axis=0).max())
        rays = _vectors(_directions(_DIRECTIONS))
        _launch(seen, len(points), self._mesh.id, _vectors(points), _vectors(normals), rays, 1e-4 * extent, found)
        return np.asarray(found.numpy()) > 0


def _directions(count: int) -> NDArray[np.float64]:
    """Unit vectors [count, 3] spread evenly over the sphere, on a Fibonacci spiral."""
    number = np.arange(count)
    height, turn = 1 - (2 * number + 1) / count, np.pi * (3 - np.sqrt(5)) * number
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1)


def _vectors(values: Floats) -> Any:
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device="cpu")


def _launch(kernel: Any, count: int, *given: Any) -> None:
    wp.launch(kernel, dim=count, inputs=list(given), device="cpu")
