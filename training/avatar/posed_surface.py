"""The surface of an avatar's points in a pose, smooth where the points have come to lie in disorder.

The points of a template that a pose tears, as at the hem of a skirt, jump to either side of the tear, and edges between
them come out several times as long as in the template. There the surface is low-passed along the edges; elsewhere it is
the points', as on most of the skin (not on fingers and feet that lie in disorder themselves). FITE's points have no
faces: its released code makes a surface of them by Poisson's equation before it measures.
"""

import numpy as np
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, edges_of
from datagen.mesh.low_pass import LowPass
from training.avatar.template import Template

_TORN, _TIMES = 1.5, 8
"""How many times as long as in the template the edges at a vertex are together where it begins to be filtered, and is
wholly at one more; how often. Chosen by seen poses (docs/results/avatar.md)."""


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
        self._lengths = self._lengths_at(at_rest)
        self._low_passed = LowPass(self._faces, len(at_rest))

    def __call__(self, points: Floats) -> Mesh:
        """Return the surface of points [n, 3] in a pose, in metres: a mesh of n vertices."""
        torn = self._lengths_at(points) / self._lengths.clip(1e-9)
        share = np.clip(torn - _TORN, 0, 1)[:, None]
        filtered = points + share * (self._low_passed(points, _TIMES) - points)
        return Mesh(np.where(share > 0, filtered, points), self._faces)

    def _lengths_at(self, points: Floats) -> NDArray[np.float64]:
        """The sum of the lengths of the edges at each point [n]."""
        lengths = np.linalg.norm(points[self._edges[:, 0]] - points[self._edges[:, 1]], axis=1)
        return np.asarray(np.bincount(self._edges.T.ravel(), np.tile(lengths, 2), len(points)), np.float64)
