"""Close-ups of the place where methods differ most, and the frame that marks it in the whole picture."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh
from training.viz.render.camera import Camera

_REACH, _AROUND = 0.17, 0.1  # of the longest edge of the truth's box: half a close-up's height, and what is averaged
_SHAPE = 4 / 3  # width by height
_CANDIDATES = 400
_INK = (120, 128, 142)


@dataclass(frozen=True)
class CloseUp:
    """A place [3] among placed meshes, and half the height of the part around it that is shown."""

    centre: Floats
    reach: float

    @classmethod
    def of(cls, truth: Mesh, outputs: Sequence[Mesh]) -> "CloseUp":
        """Where the errors of the worst and the best output differ most, on average over the surroundings.

        Its centre is the middle of what the truth and all outputs have there. Places that an output has moved out of
        a close-up are left out, unless all are.
        """
        every = np.stack([truth.vertices, *(mesh.vertices for mesh in outputs)])
        errors = np.linalg.norm(every[1:] - every[0], axis=2)
        size = max(float(np.ptp(truth.vertices, axis=0).max()), 1e-12)
        places = np.unique(np.linspace(0, len(truth.vertices) - 1, _CANDIDATES).astype(int))
        around = cKDTree(truth.vertices).query_ball_point(truth.vertices[places], _AROUND * size)
        difference, worst = np.ptp(errors, axis=0), errors.max(0)
        score = np.array([difference[near].mean() for near in around])
        inside = np.array([worst[near].max() for near in around]) < _REACH * size
        score = np.where(inside, score, -1.0) if inside.any() else score
        return cls(every[:, around[score.argmax()]].mean((0, 1)), _REACH * size)

    def camera(self, camera: Camera) -> Camera:
        """The same eye, turned to the place and zoomed in."""
        away = float(np.linalg.norm(np.subtract(camera.eye, self.centre)))
        x, y, z = map(float, self.centre)
        return Camera(camera.eye, (x, y, z), float(np.degrees(2 * np.arctan(self.reach / away))))

    def marked(self, picture: npt.NDArray[np.uint8], camera: Camera) -> npt.NDArray[np.uint8]:
        """A copy of the whole picture with a frame around the place."""
        height, width = picture.shape[:2]
        across, above, backward = (self.centre - np.array(camera.eye)) @ camera.axes().T
        focal = height / 2 / np.tan(np.radians(camera.field_of_view) / 2) / max(-backward, 1e-12)
        middle, half = np.array([height / 2 - focal * above, width / 2 + focal * across]), focal * self.reach
        low = np.rint(middle - half * np.array([1, _SHAPE])).astype(int)
        high = np.rint(middle + half * np.array([1, _SHAPE])).astype(int)
        return outlined(picture, np.maximum(low, 0), np.minimum(high, (height - 1, width - 1)))


def close_up_size(width: int) -> tuple[int, int]:
    """Width and height in pixels of a close-up."""
    return width, round(width / _SHAPE)


def outlined(
    picture: npt.NDArray[np.uint8], low: npt.NDArray[np.integer], high: npt.NDArray[np.integer]
) -> npt.NDArray[np.uint8]:
    """Return a copy with a thin frame whose corners are pixels (row, column) `low` and `high`."""
    found = picture.copy()
    (top, left), (bottom, right) = low.tolist(), high.tolist()
    if top >= bottom or left >= right:
        return found
    for rows, columns in (
        (slice(top, top + 2), slice(left, right + 1)),
        (slice(bottom - 1, bottom + 1), slice(left, right + 1)),
        (slice(top, bottom + 1), slice(left, left + 2)),
        (slice(top, bottom + 1), slice(right - 1, right + 1)),
    ):
        found[rows, columns] = _INK
    return found
