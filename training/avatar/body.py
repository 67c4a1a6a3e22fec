"""A body in the canonical pose, around which an outfit is learned, and how its bones move from there.

The canonical pose is the rest pose of the pose joints (for people a T-pose) with the hips turned outwards by 15 degrees
about Z, which parts the legs. FITE (Lin et al. 2022), section 3.1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.mesh.rig import Rig, driven, part_transforms, skinned, world_rotations

_SIDES = {"left_hip": 1, "right_hip": -1}
_HANDS = {"left_wrist", "right_wrist", "left_hand", "right_hand"}


@dataclass(frozen=True, eq=False)
class CanonicalBody:
    """A body in the canonical pose; metres, Y up, facing +Z.

    Parameters
    ----------
    vertices
        [v, 3] float64.
    faces
        Triangles [f, 3] int64, which look outwards.
    weights
        Skinning weights [v, bone] float64; those of a vertex sum to one.
    joints
        Places [bone, 3] float64 about which bones turn; a root stays in its place.
    names, parents
        Name of each bone, and the number of its parent, which comes before it; -1 for a root.
    drivers
        Name of the pose joint that turns each bone; None where none does.
    turns
        World rotations [bone, 3, 3] of the drivers in the canonical pose.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    weights: NDArray[np.float64]
    joints: NDArray[np.float64]
    names: tuple[str, ...]
    parents: tuple[int, ...]
    drivers: tuple[str | None, ...]
    turns: NDArray[np.float64]

    @property
    def hands(self) -> NDArray[np.bool_]:
        """Whether each bone [bone] is one of a hand's: these are too fine for a field of 3 cm."""
        return np.array([driver in _HANDS for driver in self.drivers])

    def transforms(self, world: NDArray[np.float64], joints: Sequence[str]) -> NDArray[np.float64]:
        """Transforms [frame, bone, 3, 4] of the bones from the canonical pose to others.

        The posed transform times the inverse of the canonical one. A root stays in its place, as in a dataset's rows.

        Parameters
        ----------
        world
            World rotations [frame, joint, 3, 3] of the pose joints (:func:`datagen.mesh.rig.world_rotations`).
        joints
            Names of the pose joints.
        """
        numbers = {name: number for number, name in enumerate(joints)}
        rotations = driven(world, [numbers.get(name or "", -1) for name in self.drivers])
        return part_transforms(rotations @ self.turns.transpose(0, 2, 1), self.joints, self.parents)


def canonical_body(
    rig: Rig,
    vertices: Floats,
    faces: NDArray[np.integer],
    joints: Sequence[str],
    parents: Sequence[int],
    *,
    spread: float = np.pi / 12,
) -> CanonicalBody:
    """The canonical body of an identity.

    Parameters
    ----------
    rig
        Its bones; those that always move as their parents do are folded into these already.
    vertices
        [v, 3] in the rig's own rest, which may be another than that of the pose joints (people of Anny rest in an
        A-pose; :func:`datagen.mesh.rig.rest_vertices` finds them from posed ones).
    faces
        Triangles [f, 3].
    joints, parents
        The tree of pose joints under which the rig was made.
    spread
        Radians by which the hips are turned outwards.
    """
    axes = np.zeros((1, len(joints), 3))
    for number, name in enumerate(joints):
        axes[0, number, 2] = spread * _SIDES.get(name, 0)
    world = world_rotations(axes, parents)
    to_canonical = rig.transforms(world[0])
    return CanonicalBody(
        vertices=skinned(vertices, rig.weights, to_canonical[None])[0],
        faces=np.asarray(faces, np.int64),
        weights=rig.weights.astype(np.float64),
        joints=_moved(to_canonical, rig.joints),
        names=rig.names,
        parents=rig.parents,
        drivers=tuple(joints[driver] if driver >= 0 else None for driver in rig.drivers),
        turns=driven(world, rig.drivers)[0],
    )


def _moved(transforms: NDArray[np.float64], points: Floats) -> NDArray[np.float64]:
    """Points [bone, 3], each moved by its own transform [bone, 3, 4]."""
    return np.asarray((transforms[..., :3] @ np.asarray(points, np.float64)[..., None])[..., 0] + transforms[..., 3])
