"""Rigged characters of any make: twelve CC0 animals, or a folder of glTF files whose joints share names.

An identity is a character with proportions of its own: torso, neck, head, limbs and tail are longer or shorter, thicker
or thinner than their maker made them (:mod:`datagen.bodies.proportions`).
"""

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.proportions import Scales, Stretchable
from datagen.bodies.skinning import Rest, remembering, rig_of, skin
from datagen.characters.character import load_characters, shared_joints
from datagen.characters.weld import volume
from datagen.common.errors import BodyError
from datagen.mesh.rig import Rig, drivers_of
from datagen.poses import Poses
from datagen.recipe import RiggedBody

_FACTORS = {
    "torso length": "torso", "torso girth": "torso", "neck length": "neck", "neck girth": "neck", "head size": "head",
    "ear size": "ears", "limb length": "hindlimbs forelimbs", "limb girth": "hindlimbs forelimbs",
    "forelimb length": "forelimbs", "tail length": "tail", "tail girth": "tail",
}  # fmt: skip
_CHARACTER, _FORELIMB = "character", "forelimb length"
_FORELIMB_SHARE = 0.25  # of the range: all legs lengthen together, or an animal's feet would not meet one ground


class RiggedModel:
    """See :class:`datagen.bodies.BodyModel`; frame: metres, Y up, facing +Z, +X to the body's left.

    Identity i is of character i modulo their number, so that all occur. ``joints`` are those that all characters have.
    """

    def __init__(self, recipe: RiggedBody) -> None:
        self._characters = load_characters(recipe.path, recipe.characters, vertices=recipe.vertices)
        self._stretchable = [Stretchable(character) for character in self._characters]
        found = {part for each in self._stretchable for part in each.parts}
        self.parameter_names = (
            _CHARACTER, *(name for name, names in _FACTORS.items() if found.intersection(names.split())),
        )  # fmt: skip
        self.joints = shared_joints(self._characters)[0]
        self.assets = tuple(dict.fromkeys(asset for character in self._characters for asset in character.assets))
        self._range, self._height = recipe.bone_scale, recipe.height
        self.rest = remembering(self._rest)

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """The character's number, then factors uniform within 1 +- the recipe's ``bone_scale``."""
        drawn = random.uniform(-self._range, self._range, len(self.parameter_names) - 1)
        share = [_FORELIMB_SHARE if name == _FORELIMB else 1.0 for name in self.parameter_names[1:]]
        return np.array([identity % len(self._characters), *(1 + drawn * share)])

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3] of the identity's character."""
        return self._characters[int(parameters[0])].faces

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32; the root joint stays where it is at rest (no grounding)."""
        character = self._characters[int(parameters[0])]
        return skin(self.rest(parameters), poses.on(character.names, character.parents))

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig:
        """The joints of the identity's character; those that the poses do not turn are one part with their parents."""
        character = self._characters[int(parameters[0])]
        drivers = drivers_of(character.names, character.parents, joints)
        return rig_of(self.rest(parameters), character.names, drivers)

    def _rest(self, parameters: NDArray[np.float64]) -> Rest:
        number = int(parameters[0])
        character = self._characters[number]
        factors = dict(zip(self.parameter_names[1:], parameters[1:].tolist(), strict=True))
        vertices, joints = self._stretchable[number].stretched(part_scales(factors))
        if self._height:
            size = self._height / float(np.ptp(character.vertices[:, 1]))
            vertices, joints = vertices * size, joints * size
        if not np.isfinite(vertices).all() or volume(vertices, character.faces) <= 0:
            raise BodyError(
                f"{character.name} is degenerate with the factors {factors}. Choose a smaller data.body.bone_scale"
            )
        return Rest(vertices, joints, character.weights, character.parents)


def part_scales(factors: dict[str, float]) -> Scales:
    """Factors along and across the bones of every part, from factors by parameter name; 1 where there is none."""
    get = {name: factors.get(name, 1.0) for name in _FACTORS}
    limb, head = get["limb length"], get["head size"]
    return {
        "torso": (get["torso length"], get["torso girth"]),
        "neck": (get["neck length"], get["neck girth"]),
        "head": (head, head),
        "ears": (head * get["ear size"], head * get["ear size"]),
        "hindlimbs": (limb, get["limb girth"]),
        "forelimbs": (limb * get[_FORELIMB], get["limb girth"]),
        "tail": (get["tail length"], get["tail girth"]),
    }
