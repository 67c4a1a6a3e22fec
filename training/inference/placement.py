"""Where an output stands and how large it is: networks answer in a normalised box, people ask for the target's place.

Size: a pose changes the box, so the scale comes from edge lengths, which a pose hardly changes: their median ratio to
the target's. Place: the lowest vertex stays at the target's height and the middle of the box stays above the same spot
of the ground, so that a body that sits down sits on the ground on which it stood. Centring the box instead, as the
paper's normalisation suggests, would let it float at the height of its hips.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.geometry import Mesh, bounding_box

Floats = NDArray[np.floating]
_NO_LENGTH = 1e-9  # of the normalised box: an edge that has none says nothing of the scale


def scale_of(target: Mesh, vertices: Floats) -> float:
    """How many units of the target one unit of the output's box is; vertices [n, 3] in the normalised box."""
    before, after = (_side_lengths(each, target.faces) for each in (target.vertices, vertices))
    usable = (after > _NO_LENGTH) & (before > 0)
    return float(np.median(before[usable] / after[usable])) if usable.any() else 1.0


def standing_point(vertices: Floats) -> NDArray[np.float64]:
    """The point [3] of the ground below the middle of the box of vertices [n, 3] with Y up, at their lowest height."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])


def placed(target: Mesh, vertices: Floats) -> Floats:
    """Vertices [n, 3] in the normalised box -> the target's size and place; all with Y up."""
    sized = vertices * scale_of(target, vertices)
    return sized - standing_point(sized) + standing_point(target.vertices)


@dataclass(frozen=True)
class Path:
    """The way that the frames of a sequence go over and above the ground, in the units of the target.

    A frame's box holds no place, so a walk would be a walk on the spot. The output goes where the source goes, with
    steps as long as its own size asks for. The ratio is that of the first frame, lest it tremble.
    """

    start: Floats
    ratio: float

    @classmethod
    def from_first(cls, source: Floats, output_scale: float) -> "Path":
        """A path that begins where the target stands; ``source`` [n, 3] is the first frame, Y up."""
        return cls(standing_point(source), output_scale / float(bounding_box(source).half))

    def offset(self, source: Floats) -> Floats:
        """How far [3] the output of this frame is from where the first one stands."""
        return (standing_point(source) - self.start) * self.ratio


def _side_lengths(vertices: Floats, faces: NDArray[np.integer]) -> Floats:
    corners = vertices[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).ravel()
