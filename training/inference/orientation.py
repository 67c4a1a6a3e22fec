"""Which way a mesh stands: turning it into the axes that networks are trained in, and finding its axes.

Networks see bodies with Y up that face +Z. A network that is given one mesh as source and as target should return it;
it does so only where the mesh stands as the network's training data did. So the 24 ways that a mesh can stand along the
axes are tried, and the one that comes back best is taken where it is certain. This needs the network and nothing else:
no skeleton, no category, no convention of a file format. It is an addition to the DSFFNet paper, which takes aligned
meshes as given.

It is not certain of a mesh that stands between the axes, which comes back better when it is turned a little further,
nor of one that the network does not know, as an animal by a network of humans, for which some way comes back least
badly. The thresholds are from the measurements in docs/results/transfer.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.common.errors import RecipeError
from datagen.mesh.geometry import bounding_box

SelfErrors = Callable[[Floats], NDArray[np.float64]]
"""Meshes [b, n, 3] in the normalised box -> PMD [b] of each when it is transferred onto itself."""

NAMES = ("X", "Y", "Z", "-X", "-Y", "-Z")
_PROBED_VERTICES = 256  # of a mesh: so many tell the 24 ways apart as well as 512 do (docs/results/transfer.md)
POOR_ERROR = 0.01
"""PMD of a mesh onto itself, at most, where the network knows it and it stands right: 0.1 of half the box, in every
coordinate."""
_CLEARLY = 1.5  # so many times the error of a way that is certain has every other at least
_NEARLY = 1.3  # so many times the error of the best way has one at most that is as good
TURN = 30.0
"""Degrees about the vertical that a mesh is turned by, to see whether it stands between the axes."""
_ALONG, _BETWEEN = 1.2, 0.7  # times the error of the best way, so much at least and at most has the mesh turned so


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

    @property
    def lean(self) -> NDArray[np.float64]:
        """How a body is turned [3, 3] from upright then: not at all, as far as axes can say."""
        return np.eye(3)

    def turned(self, vertices: Floats) -> Floats:
        """Vertices [..., 3] in the file's axes -> Y up, facing +Z."""
        return vertices if self == UPRIGHT else vertices @ self.matrix.T

    def upright(self, vertices: Floats) -> Floats:
        """As `turned`: axes say nothing of a lean."""
        return self.turned(vertices)

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


def axes_of_both(up: str | None, front: str | None) -> tuple[Axes, Axes]:
    """Axes of source and target from names such as ``Z`` (of both) or ``Z,Y`` (of the source, of the target).

    Without ``up`` that is Y; without ``front`` that is Z, or -Y where Z is up, as in Blender.

    Raises
    ------
    RecipeError
        A name is no axis, or there are more than two.
    """
    ups = (up or UPRIGHT.up).upper().split(",")
    fronts = front.upper().split(",") if front else ["-Y" if name[-1:] == "Z" else UPRIGHT.front for name in ups]
    if max(len(ups), len(fronts)) > 2:
        said = f"--up={up or UPRIGHT.up} --front={front or UPRIGHT.front}"
        raise RecipeError(f"{said}: name one axis, or two with a comma, of source and target")
    return Axes(ups[0], fronts[0]), Axes(ups[-1], fronts[-1])


def axes_as_options(source: Axes, target: Axes) -> str:
    """Return what :func:`axes_of_both` reads, as it is typed."""
    ups, fronts = ((source.up, target.up), (source.front, target.front))
    alike = source == target
    return f"--up={ups[0] if alike else ','.join(ups)} --front={fronts[0] if alike else ','.join(fronts)}"


@dataclass(frozen=True)
class Orientation:
    """How well a mesh comes back from the network, as PMD in the normalised box.

    Attributes
    ----------
    errors
        In each of EVERY_AXES, [24].
    turned
        In the best of them and turned further about the vertical, by 30 degrees to either side, [2].
    """

    errors: NDArray[np.float64]
    turned: NDArray[np.float64]

    @property
    def best(self) -> Axes:
        """The way of standing that comes back best, certain or not."""
        return EVERY_AXES[int(np.argmin(self.errors))]

    @property
    def axes(self) -> Axes:
        """The way of standing where it is certain, else that of the training data: the mesh is left as it is."""
        return self.best if self.is_certain else UPRIGHT

    @property
    def is_certain(self) -> bool:
        """Whether the mesh comes back well in one way, clearly better than in any other and than turned from it."""
        least, next_best = np.sort(self.errors)[:2]
        return bool(least <= POOR_ERROR and next_best >= _CLEARLY * least and self.turned.min() >= _ALONG * least)

    @property
    def is_between(self) -> bool:
        """Whether the mesh comes back clearly better when it is turned from its best way about the vertical."""
        return bool(self.turned.min() <= _BETWEEN * self.errors.min())

    def fits(self, axes: Axes) -> bool:
        """Return whether nothing speaks against a mesh that stands by ``axes``."""
        return self.error(axes) <= min(POOR_ERROR, _NEARLY * float(self.errors.min())) and not self.is_between

    def error(self, axes: Axes) -> float:
        """PMD of the mesh transferred onto itself when it stands by ``axes``."""
        return float(self.errors[EVERY_AXES.index(axes)])


def orientation(self_errors: SelfErrors, meshes: Sequence[Floats]) -> Orientation:
    """Try the ways of standing on a mesh, or on several that stand alike (frames of a sequence, which then vote).

    Parameters
    ----------
    self_errors
        :meth:`training.inference.transfer.PoseTransfer.self_errors` of the network.
    meshes
        Vertices [n, 3] in any unit; 256 of them, evenly spread over their order, are looked at.
    """
    errors = np.mean([self_errors(_turned_ways(mesh)) for mesh in meshes], axis=0)
    best = EVERY_AXES[int(np.argmin(errors))]
    turned = np.mean([self_errors(_turned_a_little(best.turned(mesh))) for mesh in meshes], axis=0)
    return Orientation(errors, turned)


def _turned_ways(mesh: Floats) -> Floats:
    return np.stack([axes.turned(_probe(mesh)) for axes in EVERY_AXES])


def _turned_a_little(mesh: Floats) -> Floats:
    """The mesh, Y up, turned about the vertical to either side."""
    sine, cosine = np.sin(np.radians(TURN)), np.cos(np.radians(TURN))
    turn = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    return np.stack([_probe(mesh @ turn), _probe(mesh @ turn.T)])


def _probe(mesh: Floats) -> Floats:
    """Some vertices in the box of all; in their own order, which one of the networks reads."""
    chosen = np.unique(np.linspace(0, len(mesh) - 1, min(len(mesh), _PROBED_VERTICES)).round().astype(int))
    return bounding_box(mesh).normalise(mesh)[chosen]
