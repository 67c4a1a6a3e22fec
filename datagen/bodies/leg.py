"""A procedural two-bone leg: a tube from hip to foot that bends at the knee.

It needs no assets and loads at once: for tests, for trying the pipeline out, and as the smallest example of how a
family is added. Identity: length, thigh and ankle radius, knee height. It obeys ``left_hip`` and ``left_knee``.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.skinning import Rest, remembering, rig_of, skin
from datagen.common.assets import Asset
from datagen.mesh.rig import Rig, drivers_of
from datagen.poses import JOINTS, Poses
from datagen.recipe import LegBody

_RANGES = {"length": (0.7, 1.1), "thigh_radius": (0.06, 0.14), "ankle_radius": (0.03, 0.06), "knee": (0.45, 0.6)}
_LOWEST, _HIGHEST = np.transpose(list(_RANGES.values()))
_BONES, _PARENTS = ("left_hip", "left_knee"), (-1, 0)


class LegModel:
    """See :class:`datagen.bodies.BodyModel`; frame: metres, Y up, facing +Z, the hip at the origin."""

    parameter_names = tuple(_RANGES)
    joints = JOINTS  # all but two of which move nothing: it is one leg
    assets = (Asset("procedural leg", "Apache-2.0", "2"),)

    def __init__(self, recipe: LegBody) -> None:
        self._rings, self._segments = recipe.rings, recipe.segments
        self._faces = self._tube()
        self._along = np.linspace(0.0, 1.0, self._rings)
        angle = np.linspace(0.0, 2 * np.pi, self._segments, endpoint=False)
        self._around = np.cos(angle), np.sin(angle)
        shin = np.repeat(1 / (1 + np.exp((0.5 - self._along) * 40)), self._segments)
        self._weights = np.stack([1 - shin, shin], axis=1)
        self.rest = remembering(self._rest)
        self._shared_rig = lru_cache(maxsize=4)(self._rig_but_joints)

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """Parameters [4]: length, thigh radius, ankle radius (metres), knee height (fraction of length)."""
        return random.uniform(_LOWEST, _HIGHEST)

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3] of the tube and its two caps; the same for all identities."""
        return self._faces

    def _tube(self) -> NDArray[np.int32]:
        ring, step = np.meshgrid(np.arange(self._rings - 1), np.arange(self._segments), indexing="ij")
        first = (ring * self._segments + step).ravel()
        right = (ring * self._segments + (step + 1) % self._segments).ravel()
        side = [np.stack([first, right, first + self._segments], 1)]
        side.append(np.stack([right, right + self._segments, first + self._segments], 1))
        fan = np.stack(
            [np.zeros(self._segments - 2), *np.arange(1, self._segments).reshape(1, -1).repeat(2, 0)[:, :-1]]
        )
        fan[2] += 1
        last = (self._rings - 1) * self._segments
        return np.concatenate([*side, fan.T[:, ::-1], fan.T + last]).astype(np.int32)

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32."""
        rest = self.rest(parameters)
        return skin(rest, poses.on(_BONES, rest.parents))

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig:
        """Thigh and shin; as many rings lie above the knee as below it, so that all legs share their weights."""
        shared = self._shared_rig(joints)
        kept = [_BONES.index(name) for name in shared.names]  # one, where poses turn no knee
        return replace(shared, joints=_heads(parameters)[kept].astype(np.float32))

    def _rig_but_joints(self, joints: tuple[str, ...]) -> Rig:
        rest = Rest(np.empty((0, 3)), np.zeros((2, 3)), self._weights, _PARENTS)
        rig = rig_of(rest, _BONES, drivers_of(_BONES, _PARENTS, joints))
        rig.weights.flags.writeable = False
        return rig

    def _rest(self, parameters: NDArray[np.float64]) -> Rest:
        length, thigh, ankle, knee = parameters
        along = np.interp(self._along, [0.0, 0.5, 1.0], [0.0, knee, 1.0])[:, None]
        bulge = np.sin(np.pi * along)
        radius = (thigh + (ankle - thigh) * along) * (1 + 0.15 * bulge**2)
        vertices = np.empty((self._rings, self._segments, 3))
        vertices[..., 0] = radius * self._around[0]
        vertices[..., 1] = -length * along
        vertices[..., 2] = radius * self._around[1] + 0.02 * bulge
        return Rest(vertices.reshape(-1, 3), _heads(parameters), self._weights, _PARENTS)


def _heads(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Hip and knee at rest [2, 3]."""
    length, _, _, knee = parameters
    return np.array([[0.0, 0.0, 0.0], [0.0, -length * knee, 0.0]])
