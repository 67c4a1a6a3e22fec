"""A canonical body that needs no assets: the procedural leg, some of whose poses bend the knee."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import load_body
from datagen.mesh.rig import rest_vertices
from datagen.poses import JOINTS, PARENTS, Poses
from datagen.recipe import LegBody
from training.avatar.body import CanonicalBody, canonical_body


@dataclass(frozen=True)
class PosedLeg:
    """A leg, four poses of it, and what it looks like in them: ``posed`` [pose, vertex, 3]."""

    body: CanonicalBody
    poses: Poses
    posed: NDArray[np.float64]

    @property
    def transforms(self) -> NDArray[np.float64]:
        """Of the bones [pose, bone, 3, 4], from the canonical pose."""
        return self.body.transforms(self.poses.world(), JOINTS)


@lru_cache
def posed_leg() -> PosedLeg:
    """A leg of 384 vertices."""
    model, parameters = load_body(LegBody(rings=32, segments=12)), np.array([0.9, 0.1, 0.05, 0.5])
    rotations = np.zeros((4, len(JOINTS), 3))
    rotations[1:, JOINTS.index("left_knee"), 0] = np.radians([30, 60, 90])
    rotations[1:, JOINTS.index("left_hip")] = np.radians([[-40, 0, 0], [20, 30, 0], [0, 0, -20]])
    poses, rig = Poses(JOINTS, PARENTS, rotations), model.rig(parameters, JOINTS)
    assert rig is not None
    posed = model.vertices(parameters, poses).astype(np.float64)
    rest = rest_vertices(posed, rig.weights, rig.transforms(poses.world()))
    return PosedLeg(canonical_body(rig, rest, model.faces(parameters), JOINTS, PARENTS), poses, posed)
