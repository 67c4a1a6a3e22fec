"""The surface of an avatar's points in a pose, smooth where the points have come to lie in disorder.

The points of a template that a pose tears, as at the hem of a skirt, jump to either side of the tear, and edges between
them come out several times as long as in the template. There the surface is low-passed along the edges; elsewhere, as
on skin, it is the points'. FITE's points have no faces: its released code makes a surface of them by Poisson's equation
before it measures.
"""

import numpy as np

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, edges_of
from datagen.mesh.low_pass import LowPass
from training.avatar.template import Template

_TORN, _TIMES = 1.5, 8
"""From edges so many times as long as in the template on it is filtered, so often, and wholly from one more on: of the
pairs that were tried on seen poses the smoothest that leaves skin where it is (docs/results/avatar.md)."""


class PosedSurface:
    """Makes surfaces of a template's points in poses.

    Parameters
    ----------
    template
        Whose faces and edges' lengths are taken.
    """

    def __init__(self, template: Template) -> None:
        at_rest, self._faces = template.vertices.double().numpy(), template.faces.numpy()
        self._edges = edges_of(self._faces)
        self._lengths = self._lengths_of(at_rest).clip(1e-9)
        self._counts = np.bincount(self._edges.ravel(), minlength=len(at_rest)).clip(1)
        self._low_passed = LowPass(self._faces, len(at_rest))

    def __call__(self, points: Floats) -> Mesh:
        """Return the surface of points [n, 3] in a pose, in metres: a mesh of n vertices."""
        longer = self._lengths_of(points) / self._lengths
        torn = sum(np.bincount(ends, longer, len(points)) for ends in self._edges.T) / self._counts
        share = np.clip(torn - _TORN, 0, 1)[:, None]
        return Mesh(points + share * (self._low_passed(points, _TIMES) - points), self._faces)

    def _lengths_of(self, points: Floats) -> Floats:
        first, second = self._edges.T
        return np.linalg.norm(points[first] - points[second], axis=1)
