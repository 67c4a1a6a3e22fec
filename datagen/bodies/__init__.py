"""Body models behind one protocol.

To add a family: one module here that defines a class with the members of :class:`BodyModel`, its recipe section
in :mod:`datagen.recipe`, and one line in ``FAMILIES``. The contract tests then cover it.
"""

from functools import lru_cache
from importlib import import_module
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from datagen.common.assets import Asset
from datagen.common.errors import BodyError
from datagen.mesh.rig import Rig
from datagen.poses import Poses, PoseSource
from datagen.recipe import Body


class BodyModel(Protocol):
    """A body: identity parameters and poses over named joints in, vertices out.

    ``joints`` are the pose joints that it understands: a dataset whose poses turn any other is refused.
    """

    parameter_names: tuple[str, ...]
    joints: tuple[str, ...]
    assets: tuple[Asset, ...]

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """Parameters [parameter] of identity number ``identity``, named by ``parameter_names``."""
        ...

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3] of that identity (families may differ between identities)."""
        ...

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] in metres, Y up, facing +Z.

        A shard asks several times for some poses of one identity, so what is dear about an identity is to be remembered
        (:func:`datagen.bodies.skinning.remembering`).
        """
        ...

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig | None:
        """The identity's rig under poses of ``joints``; None for a family without a skeleton."""
        ...


@runtime_checkable
class DressedModel(Protocol):
    """A body some of whose vertices are garments."""

    def part_labels(self, parameters: NDArray[np.float64]) -> NDArray[np.int32] | None:
        """What each vertex [vertex] belongs to: 0 skin, from 1 on garments; None for an identity without labels."""
        ...


FAMILIES = {
    "anny": "datagen.bodies.anny.model:AnnyModel",
    "smpl": "datagen.bodies.smpl_family.smpl:SmplModel",
    "smal": "datagen.bodies.smpl_family.smal:SmalModel",
    "rigged": "datagen.bodies.rigged:RiggedModel",
    "imported": "datagen.bodies.imported:ImportedModel",
    "mixed": "datagen.bodies.mixed:MixedModel",
    "clothed": "datagen.bodies.clothed.model:ClothedModel",
    "leg": "datagen.bodies.leg:LegModel",
}


@lru_cache(maxsize=8)
def load_body(recipe: Body) -> BodyModel:
    """The body model of a recipe, loaded once a process."""
    module, name = FAMILIES[recipe.family].split(":")
    model: BodyModel = getattr(import_module(module), name)(recipe)
    return model


def part_labels(body: BodyModel, parameters: NDArray[np.float64]) -> NDArray[np.int32] | None:
    """What each vertex [vertex] of an identity belongs to: 0 skin, from 1 on garments; None where nobody is dressed."""
    return body.part_labels(parameters) if isinstance(body, DressedModel) else None


def require_joints(body: BodyModel, source: PoseSource, *, family: str) -> None:
    """Refuse poses that turn joints which the body does not have: it would silently stand otherwise than the rest.

    Raises
    ------
    BodyError
        With the joints that are lacking.
    """
    lacking = [joint for joint in source.joints if joint not in body.joints]
    if lacking:
        raise BodyError(
            f"the poses turn joints that the body family {family!r} lacks: {', '.join(lacking)}. It has "
            f"{', '.join(body.joints) or 'none'}. Choose poses for it: --set data.poses.distribution.name=..."
        )
