"""Several bodies in one dataset, so that a triple may take its source from one and its target from another."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import BodyModel, load_body, part_labels
from datagen.common.assets import Asset
from datagen.mesh.rig import Rig
from datagen.poses import Poses
from datagen.recipe import MixedBody


class MixedModel:
    """See :class:`datagen.bodies.BodyModel`. Identity i is of body i modulo their number.

    Parameters are the body's number, then those of every body in turn, zero where they are another body's.
    """

    def __init__(self, recipe: MixedBody) -> None:
        self._bodies: list[BodyModel] = [load_body(body) for body in recipe.bodies]
        labels = [f"{number}.{body.family}" for number, body in enumerate(recipe.bodies)]
        named = zip(labels, self._bodies, strict=True)
        self.parameter_names = (
            "body",
            *(f"{label}.{name}" for label, body in named for name in body.parameter_names),
        )
        common = set.intersection(*(set(body.joints) for body in self._bodies))
        self.joints = tuple(joint for joint in self._bodies[0].joints if joint in common)

    @cached_property
    def assets(self) -> tuple[Asset, ...]:
        """Those of all bodies; found when asked for, as a large set of files takes time to hash."""
        return tuple(dict.fromkeys(asset for body in self._bodies for asset in body.assets))

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """Parameters of the identity's own body in their place."""
        number = identity % len(self._bodies)
        parameters = np.zeros(len(self.parameter_names))
        parameters[0] = number
        parameters[self._place(number)] = self._bodies[number].draw_identity(random, identity // len(self._bodies))
        return parameters

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3] of that identity's body."""
        body, own = self._of(parameters)
        return body.faces(own)

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] of that identity's body."""
        body, own = self._of(parameters)
        return body.vertices(own, poses)

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig | None:
        """The rig of that identity's body, None where it has none: bodies of one dataset may have different parts."""
        body, own = self._of(parameters)
        return body.rig(own, joints)

    def part_labels(self, parameters: NDArray[np.float64]) -> NDArray[np.int32] | None:
        """What each vertex [vertex] belongs to where that identity's body is dressed, None elsewhere."""
        body, own = self._of(parameters)
        return part_labels(body, own)

    def _of(self, parameters: NDArray[np.float64]) -> tuple[BodyModel, NDArray[np.float64]]:
        number = int(parameters[0])
        return self._bodies[number], parameters[self._place(number)]

    def _place(self, number: int) -> slice:
        sizes = [len(body.parameter_names) for body in self._bodies]
        start = 1 + sum(sizes[:number])
        return slice(start, start + sizes[number])
