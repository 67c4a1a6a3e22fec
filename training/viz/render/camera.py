"""Cameras, and the view that holds some meshes. Frame: Y up, bodies face +Z."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh

_ELEVATION = 12.0


@dataclass(frozen=True)
class Camera:
    """A perspective camera; Y is up in the picture.

    Parameters
    ----------
    eye, target : tuple of three floats
        Where the camera is and what it looks at, in the frame and unit of the meshes.
    field_of_view : float
        Vertical angle of view in degrees.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    field_of_view: float = 18.0

    def axes(self) -> Floats:
        """Return the camera's right, up and backward unit vectors as rows [3, 3]."""
        return axes_of(np.subtract(self.eye, self.target))


def frame(
    meshes: Sequence[Mesh],
    *,
    size: tuple[int, int] = (320, 400),
    azimuth: float | None = None,
    margin: float = 0.09,
) -> Camera:
    """Return the three-quarter camera that just holds all meshes, so that panels drawn with it can be compared.

    Parameters
    ----------
    meshes : sequence of mesh
        Meshes with vertices [v, 3], Y up, facing +Z.
    size : (int, int)
        Width and height of the panel in pixels.
    azimuth : float
        Direction of the eye in degrees from +Z towards +X, 12 above the horizon. By default 28 from the front for
        upright bodies, and 62 for bodies that are long from front to back, as most animals.
    margin : float
        Share of the panel left free on each side.
    """
    points = np.concatenate([checked_vertices(mesh.vertices) for mesh in meshes])
    turn, rise = np.radians([azimuth_of(meshes) if azimuth is None else azimuth, _ELEVATION])
    direction = np.array([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)])
    axes = axes_of(direction)
    in_view = points @ axes.T
    centre = (in_view.min(0) + in_view.max(0)) / 2
    across, above, towards = np.abs(in_view - centre)[:, 0], np.abs(in_view - centre)[:, 1], (in_view - centre)[:, 2]
    slope = np.tan(np.radians(Camera.field_of_view) / 2) * (1 - 2 * margin)
    distance = max((towards + across / (slope * size[0] / size[1])).max(), (towards + above / slope).max(), 1e-6)
    target = centre @ axes
    return Camera(eye=_triple(target + distance * direction), target=_triple(target))


def azimuth_of(meshes: Sequence[Mesh]) -> float:
    """Return degrees from the front: a horse seen head-on hides its body, a person seen from the side hides a leg."""
    widths, depths = np.array([np.ptp(np.asarray(mesh.vertices, float), axis=0)[[0, 2]] for mesh in meshes]).T
    return 62.0 if np.median(depths / np.maximum(widths, 1e-12)) > 1.7 else 28.0


def axes_of(backward: Floats) -> Floats:
    """Return right, up and backward as rows; any right will do when looking straight up or down."""
    backward = backward / np.linalg.norm(backward)
    hint = np.array([0.0, 1, 0]) if abs(backward[1]) < 0.999 else np.array([0.0, 0, -1])
    right = np.cross(hint, backward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(backward, right), backward])


def checked_vertices(vertices: Floats) -> Floats:
    vertices = np.asarray(vertices, float)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise ValueError(f"vertices must have shape [v, 3], got {vertices.shape}")
    if bad := int((~np.isfinite(vertices).all(1)).sum()):
        raise ValueError(f"vertices must be finite: {bad} of {len(vertices)} are not")
    return vertices


def _triple(vector: Floats) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
