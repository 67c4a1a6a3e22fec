"""Which way a mesh stands: turning it into the axes that networks are trained in, and finding its axes.

Networks see bodies with Y up that face +Z. A network that is given one mesh as source and as target should return it;
it does so only where the mesh stands as the network's training data did. So the 24 ways that a mesh can stand along the
axes are tried, and the one that comes back best is taken. This needs the network and nothing else: no skeleton, no
category, no convention of a file format. It is an addition to the DSFFNet paper, which takes aligned meshes as given.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from datagen.errors import RecipeError
from datagen.mesh import bounding_box

Floats = NDArray[np.floating]
SelfErrors = Callable[[Floats], NDArray[np.float64]]
"""Meshes [b, n, 3] in the normalised box -> PMD [b] of each when it is transferred onto itself."""

NAMES = ("X", "Y", "Z", "-X", "-Y", "-Z")
_PROBED_VERTICES = 256  # of a mesh: so many tell the 24 ways apart as well as 512 do (docs/transfer.md)
CLEARLY = 1.3  # a way of standing must come back so many times better than the training data's to be believed


@dataclass(frozen=True)
class Axes:
    """The axes of a mesh's file that point to the body's head and to its front: ``Y`` and ``Z`` in the training data.

    Raises
    ------
    RecipeError
        A name is none of X, Y, Z, -X, -Y, -Z, or both lie along one line.
    """

    up: str = "Y"
    front: str = "Z"

    def __post_init__(self) -> None:
        for name in (self.up, self.front):
            if name not in NAMES:
                raise RecipeError(f"{name!r} is no axis; name one of {', '.join(NAMES)}")
        if self.up[-1] == self.front[-1]:
            raise RecipeError(f"a body cannot have {self.up} up and face {self.front}: name two different axes")

    def __str__(self) -> str:
        return f"{self.up} up, facing {self.front}"

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The rotation [3, 3] from the file's axes to those of training; its rows are right, up and front."""
        up, front = _direction(self.up), _direction(self.front)
        return np.stack([np.cross(up, front), up, front])

    def turned(self, vertices: Floats) -> Floats:
        """Vertices [..., 3] in the file's axes -> Y up, facing +Z."""
        return vertices if self == UPRIGHT else vertices @ self.matrix.T

    def restored(self, vertices: Floats) -> Floats:
        """Vertices [..., 3], Y up and facing +Z -> the file's axes."""
        return vertices if self == UPRIGHT else vertices @ self.matrix


def _direction(name: str) -> NDArray[np.float64]:
    return np.eye(3)["XYZ".index(name[-1])] * (-1 if name[0] == "-" else 1)


UPRIGHT = Axes()
EVERY_AXES = (
    UPRIGHT,
    *(Axes(up, front) for up, front in product(NAMES, NAMES) if up[-1] != front[-1] and (up, front) != ("Y", "Z")),
)
"""The 24 ways to stand along the axes; the training data's first."""


def axes_of_both(up: str, front: str) -> tuple[Axes, Axes]:
    """Axes of source and target from names such as ``Z`` (of both) or ``Z,Y`` (of the source, of the target).

    Raises
    ------
    RecipeError
        A name is no axis, or there are more than two.
    """
    ups, fronts = (names.upper().split(",") for names in (up, front))
    if max(len(ups), len(fronts)) > 2:
        raise RecipeError(f"--up={up} --front={front}: name one axis, or two with a comma, of source and target")
    return Axes(ups[0], fronts[0]), Axes(ups[-1], fronts[-1])


def axes_as_options(source: Axes, target: Axes) -> str:
    """What :func:`axes_of_both` reads, as it is typed."""
    ups, fronts = ((source.up, target.up), (source.front, target.front))
    alike = source == target
    return f"--up={ups[0] if alike else ','.join(ups)} --front={fronts[0] if alike else ','.join(fronts)}"


@dataclass(frozen=True)
class Orientation:
    """How well a mesh comes back from the network in each of EVERY_AXES: PMD [24] in the normalised box."""

    errors: NDArray[np.float64]

    @property
    def axes(self) -> Axes:
        """The way of standing that comes back best; the training data's unless another is clearly better."""
        best = int(np.argmin(self.errors))
        return EVERY_AXES[best] if self.is_unlike_training else UPRIGHT

    @property
    def is_unlike_training(self) -> bool:
        """Whether the mesh comes back clearly better when it is turned."""
        return bool(self.errors[0] > CLEARLY * self.errors.min())

    def error(self, axes: Axes) -> float:
        """PMD of the mesh transferred onto itself when it stands by ``axes``."""
        return float(self.errors[EVERY_AXES.index(axes)])


def orientation(self_errors: SelfErrors, meshes: Sequence[Floats]) -> Orientation:
    """Try the 24 ways of standing on a mesh, or on several that stand alike (frames of a sequence, which then vote).

    Parameters
    ----------
    self_errors
        :meth:`training.transfer.PoseTransfer.self_errors` of the network.
    meshes
        Vertices [n, 3] in any unit; 256 of them, evenly spread over their order, are looked at.
    """
    return Orientation(np.mean([self_errors(_turned_ways(mesh)) for mesh in meshes], axis=0))


def self_error(self_errors: SelfErrors, mesh: Floats) -> float:
    """PMD of one mesh [n, 3], Y up and facing +Z, transferred onto itself."""
    return float(self_errors(_probe(mesh)[None])[0])


def _turned_ways(mesh: Floats) -> Floats:
    return np.stack([axes.turned(_probe(mesh)) for axes in EVERY_AXES])


def _probe(mesh: Floats) -> Floats:
    """Some vertices in the box of all; in their own order, which one of the networks reads."""
    chosen = np.unique(np.linspace(0, len(mesh) - 1, min(len(mesh), _PROBED_VERTICES)).round().astype(int))
    return bounding_box(mesh).normalise(mesh)[chosen]
