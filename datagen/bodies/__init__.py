"""Body models behind one protocol.

To add a family: one module here that defines a class with the members of :class:`BodyModel`, its recipe section
in :mod:`datagen.recipe`, and one line in ``FAMILIES``. The contract tests then cover it.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datagen.recipe import Body


@dataclass(frozen=True)
class Asset:
    """What a body model was made from: a package or a file, its licence and its hash or version."""

    name: str
    licence: str
    version: str


class BodyModel(Protocol):
    """A parametric body: identity parameters and a pose over SMPL's 24 named joints in, vertices out."""

    parameter_names: tuple[str, ...]
    assets: tuple[Asset, ...]

    def draw_identity(self, random: np.random.Generator) -> NDArray[np.float64]:
        """Identity parameters [parameter], named by ``parameter_names``."""
        ...

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3] of that identity (families may differ between identities)."""
        ...

    def vertices(self, parameters: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] in metres, Y up, facing +Z.

        ``poses`` is axis-angle [pose, 24, 3] in radians (see :mod:`datagen.poses`).
        """
        ...


FAMILIES = {"anny": "datagen.bodies.anny:AnnyModel", "leg": "datagen.bodies.leg:LegModel"}


@lru_cache(maxsize=4)
def load_body(recipe: Body) -> BodyModel:
    """The body model of a recipe, loaded once a process."""
    module, name = FAMILIES[recipe.family].split(":")
    model: BodyModel = getattr(import_module(module), name)(recipe)
    return model
