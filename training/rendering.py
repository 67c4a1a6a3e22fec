"""Pictures of triangle meshes by a small software rasteriser: NumPy and SciPy only, no GPU, X server or GL library.

Frame: Y up, bodies face +Z. Supersampled, smooth-shaded, lit by a key light and an occluded sky, with a soft shadow.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from training.rasteriser import Floats, Integers, on_plane, planes, rasterise

CLAY = (0.72, 0.74, 0.78)
BACKGROUND = (0.975, 0.978, 0.982)
_SUPERSAMPLE = 3
_SKY_LIGHTS = 20
_SHADOW_PIXELS = 96
_GROUND_PIXELS = 96


class MeshLike(Protocol):
    """Anything with ``vertices`` [v, 3] (float) and ``faces`` [f, 3] (int)."""

    @property
    def vertices(self) -> Floats:
        """Positions [v, 3], Y up."""

    @property
    def faces(self) -> Integers:
        """Triangles [f, 3], indices into the vertices."""


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
        return _axes(np.subtract(self.eye, self.target))


def frame(
    meshes: Sequence[MeshLike],
    *,
    size: tuple[int, int] = (320, 400),
    azimuth: float = 28.0,
    elevation: float = 12.0,
    margin: float = 0.09,
) -> Camera:
    """Return the three-quarter camera that just holds all meshes, so that panels drawn with it can be compared.

    Parameters
    ----------
    meshes : sequence of mesh
        Meshes with vertices [v, 3], Y up, facing +Z.
    size : (int, int)
        Width and height of the panel in pixels.
    azimuth, elevation : float
        Direction of the eye in degrees: from +Z towards +X, and above the horizon.
    margin : float
        Share of the panel left free on each side.
    """
    points = np.concatenate([_checked_vertices(mesh.vertices) for mesh in meshes])
    turn, rise = np.radians([azimuth, elevation])
    direction = np.array([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)])
    axes = _axes(direction)
    in_view = points @ axes.T
    centre = (in_view.min(0) + in_view.max(0)) / 2
    across, above, towards = np.abs(in_view - centre)[:, 0], np.abs(in_view - centre)[:, 1], (in_view - centre)[:, 2]
    slope = np.tan(np.radians(Camera.field_of_view) / 2) * (1 - 2 * margin)
    distance = max((towards + across / (slope * size[0] / size[1])).max(), (towards + above / slope).max(), 1e-6)
    target = centre @ axes
    return Camera(eye=_triple(target + distance * direction), target=_triple(target))


def render_mesh(
    vertices: Floats,
    faces: Integers,
    *,
    colors: npt.ArrayLike | None = None,
    camera: Camera | None = None,
    size: tuple[int, int] = (320, 400),
    background: tuple[float, float, float] = BACKGROUND,
    shading: float = 1.0,
) -> npt.NDArray[np.uint8]:
    """Draw one mesh standing on the ground at its lowest vertex.

    Parameters
    ----------
    vertices : array [v, 3]
        Positions, Y up, facing +Z, any unit.
    faces : array [f, 3]
        Triangles; drawn from both sides.
    colors : array [v, 3] or [3], optional
        sRGB in 0..1, one a vertex or one for all; clay grey by default.
    camera : Camera, optional
        The view; by default `frame` of this mesh alone.
    size : (int, int)
        Width and height in pixels.
    background : three floats
        sRGB in 0..1.
    shading : float
        1 for full lighting, 0 for the bare colours; between them where colours carry numbers.

    Returns
    -------
    array [height, width, 3] of uint8

    Raises
    ------
    ValueError
        If a vertex is not finite or an array has the wrong shape.

    Examples
    --------
    >>> triangle = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    >>> render_mesh(triangle, np.array([[0, 1, 2]]), size=(32, 40)).shape
    (40, 32, 3)
    """
    vertices, faces = _checked_vertices(vertices), _checked_faces(faces, len(vertices))
    camera = camera or frame([_Arrays(vertices, faces)], size=size)
    normals = vertex_normals(vertices, faces)
    albedo = _linear(_checked_colors(CLAY if colors is None else colors, len(vertices)))
    light = _supersampled(camera, size, vertices, faces, np.c_[normals, openness(vertices, faces), albedo], shading)
    mesh_light, coverage = light[..., :3], light[..., 3:]
    scenery = _linear(np.array(background)) * (1 - shading * _ground_shade(camera, size, vertices, faces))[..., None]
    picture = _display(mesh_light + (1 - coverage) * scenery)
    return np.asarray(np.rint(255 * picture), np.uint8)


def vertex_normals(vertices: Floats, faces: Integers) -> Floats:
    """Return area-weighted unit normals [v, 3]; a vertex without area points up."""
    corners = vertices[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(total, faces[:, corner], flat)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-30), (0.0, 1.0, 0.0))


def openness(vertices: Floats, faces: Integers) -> Floats:
    """Return how much of its surroundings every vertex sees [v]: 1 in the open, 0 in a closed fold.

    Light comes from `_SKY_LIGHTS` fixed directions over the whole sphere, each with a shadow map. The opener side of
    the surface counts, so that a mesh turned inside out, or a sheet, looks as it should.
    """
    normals = vertex_normals(vertices, faces)
    normals = np.concatenate([normals, -normals])
    lifted = np.concatenate([vertices, vertices]) + 0.01 * np.ptp(vertices, axis=0).max() * normals
    seen, possible = np.zeros(len(normals)), np.full(len(normals), 1e-9)
    for direction in _sphere(_SKY_LIGHTS):
        facing = np.maximum(normals @ direction, 0)
        seen += facing * _visible(vertices, faces, lifted, direction)
        possible += facing
    return _smoothed((seen / possible).reshape(2, -1).max(0), faces)


def ground_shadow(vertices: Floats, faces: Integers) -> tuple[Floats, Floats, float]:
    """Return the soft shadow on the ground under a mesh: wider and fainter the higher the part that casts it.

    Returns
    -------
    shadow : array [g, g]
        0 in the open to 1 in full shadow; rows along Z, columns along X.
    corner : array [2]
        Least (x, z) of the square of ground.
    side : float
        Its side, in the unit of the vertices.
    """
    low, high = vertices.min(0), vertices.max(0)
    tall = max(float((high - low).max()), 1e-9)
    side = float((high - low)[[0, 2]].max() + 0.8 * tall)
    corner = ((low + high)[[0, 2]] - side) / 2
    from_below = np.stack([vertices[:, 0] - corner[0], vertices[:, 2] - corner[1], low[1] - vertices[:, 1]], 1)
    _, nearness = rasterise(
        from_below * (_GROUND_PIXELS / side, _GROUND_PIXELS / side, 1), faces, *2 * [_GROUND_PIXELS]
    )
    height = -nearness.reshape(_GROUND_PIXELS, _GROUND_PIXELS) / tall
    light = np.ones_like(height)
    for reach, strength in ((0.03, 1.0), (0.1, 0.9), (0.35, 0.75)):
        spread = 0.55 * reach * tall * _GROUND_PIXELS / side
        light *= 1 - np.minimum(strength * ndimage.gaussian_filter(np.exp(-height / reach), spread), 0.6)
    return 1 - light, corner, side


@dataclass(frozen=True)
class _Arrays:
    vertices: Floats
    faces: Integers


def _checked_vertices(vertices: Floats) -> Floats:
    vertices = np.asarray(vertices, float)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise ValueError(f"vertices must have shape [v, 3], got {vertices.shape}")
    if bad := int((~np.isfinite(vertices).all(1)).sum()):
        raise ValueError(f"vertices must be finite: {bad} of {len(vertices)} are not")
    return vertices


def _checked_faces(faces: Integers, count: int) -> Integers:
    faces = np.asarray(faces, np.int64)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must have shape [f, 3], got {faces.shape}")
    if faces.size and not 0 <= faces.min() <= faces.max() < count:
        raise ValueError(f"faces must index {count} vertices, got {faces.min()} to {faces.max()}")
    return faces


def _checked_colors(colors: npt.ArrayLike, count: int) -> Floats:
    colors = np.asarray(colors, float)
    if colors.shape not in ((3,), (count, 3)):
        raise ValueError(f"colors must have shape [3] or [{count}, 3], got {colors.shape}")
    return np.broadcast_to(np.clip(colors, 0, 1), (count, 3))


def _triple(vector: Floats) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def _axes(backward: Floats) -> Floats:
    """Return right, up and backward as rows; any right will do when looking straight up or down."""
    backward = backward / np.linalg.norm(backward)
    hint = np.array([0.0, 1, 0]) if abs(backward[1]) < 0.999 else np.array([0.0, 0, -1])
    right = np.cross(hint, backward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(backward, right), backward])


def _linear(color: Floats) -> Floats:
    return np.asarray(color, float) ** 2.2


def _display(light: Floats) -> Floats:
    return np.clip(light, 0, 1) ** (1 / 2.2)


def _sphere(count: int) -> Floats:
    """Return nearly even unit vectors [count, 3]: a Fibonacci lattice."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sin(turn) * np.sqrt(1 - height**2), height, np.cos(turn) * np.sqrt(1 - height**2)], 1)


def _smoothed(values: Floats, faces: Integers) -> Floats:
    """Return a vertex quantity [v] averaged half with its neighbours."""
    ends, starts = np.concatenate([faces, np.roll(faces, 1, 1), np.roll(faces, 2, 1)]).T[:2]
    count = np.bincount(ends, minlength=len(values))
    around = np.bincount(ends, weights=values[starts], minlength=len(values)) / np.maximum(count, 1)
    return np.where(count > 0, (values + around) / 2, values)


def _visible(vertices: Floats, faces: Integers, points: Floats, direction: Floats) -> Floats:
    """Return 1 where a point [p, 3] sees the distant light in a direction past the mesh, else 0, from a shadow map."""
    axes = _axes(direction)
    mesh, points = vertices @ axes.T, points @ axes.T
    low, extent = mesh.min(0), max(float(np.ptp(mesh, axis=0).max()), 1e-9)
    scale = np.array([_SHADOW_PIXELS / extent, _SHADOW_PIXELS / extent, 1.0])
    _, nearest = rasterise((mesh - low) * scale, faces, _SHADOW_PIXELS, _SHADOW_PIXELS)
    at = np.floor((points - low) * scale)[:, :2].astype(int)
    inside = ((at >= 0) & (at < _SHADOW_PIXELS)).all(1)
    at = np.where(inside[:, None], at, 0)
    open_sky = points[:, 2] - low[2] >= nearest[at[:, 1] * _SHADOW_PIXELS + at[:, 0]] - 0.012 * extent
    return np.asarray(open_sky | ~inside, float)


def _ground_shade(camera: Camera, size: tuple[int, int], vertices: Floats, faces: Integers) -> Floats:
    """Return how much of the background's light [h, w] the shadow on the ground takes."""
    width, height = size
    right, up, backward = camera.axes()
    slope = np.tan(np.radians(camera.field_of_view) / 2) * 2 / height
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, height / 2 - np.arange(height) - 0.5)
    ray = slope * (x[..., None] * right + y[..., None] * up) - backward
    drop = vertices[:, 1].min() - camera.eye[1]
    reach = np.divide(drop, ray[..., 1], out=np.full(x.shape, -1.0), where=np.abs(ray[..., 1]) > 1e-9)
    shadow, corner, side = ground_shadow(vertices, faces)
    hit = (np.array(camera.eye)[[0, 2]] + reach[..., None] * ray[..., [0, 2]] - corner) / side
    rows_columns = np.moveaxis(hit[..., ::-1], -1, 0) * _GROUND_PIXELS - 0.5
    shade = ndimage.map_coordinates(shadow, rows_columns, order=1)
    to_edge = 0.5 - np.maximum(np.abs(x) / width, np.abs(y) / height)  # panels side by side must not show their borders
    return np.asarray(np.where(reach > 0, 0.85 * shade * np.clip(to_edge / 0.08, 0, 1), 0.0))


def _supersampled(
    camera: Camera, size: tuple[int, int], vertices: Floats, faces: Integers, attributes: Floats, shading: float
) -> Floats:
    """Return linear light times coverage, and coverage [h, w, 4]; attributes: normal, openness, albedo [v, 7]."""
    width, height = size[0] * _SUPERSAMPLE, size[1] * _SUPERSAMPLE
    axes = camera.axes()
    in_view = (vertices - np.array(camera.eye)) @ axes.T
    away = np.maximum(-in_view[:, 2], 1e-9)
    focal = height / 2 / np.tan(np.radians(camera.field_of_view) / 2)
    screen = np.stack(
        [width / 2 + focal * in_view[:, 0] / away, height / 2 - focal * in_view[:, 1] / away, 1 / away], 1
    )
    ahead = faces[(-in_view[faces, 2] > 1e-6).all(1)]
    owner, _ = rasterise(screen, ahead, width, height)
    pixels = np.flatnonzero(owner >= 0)
    owner = owner[pixels]
    plane_of, facing = planes(screen, ahead)
    one, two = (on_plane(plane, owner, pixels % width + 0.5, pixels // width + 0.5) for plane in plane_of[:2])
    weights = np.stack([1 - one - two, one, two]) * screen[ahead[owner], 2].T
    weights /= weights.sum(0)
    surface = np.asarray(sum(weights[k, :, None] * attributes[ahead[owner, k]] for k in range(3)))
    # y points down, so a face seen from its front has negative area; one seen from behind is lit as if turned.
    normals = surface[:, :3] * np.where(facing[owner] < 0, 1, -1)[:, None]
    diffuse, gloss = _lighting(normals, surface[:, 3], axes)
    lit = surface[:, 4:] * (1 + shading * (diffuse - 1))[:, None] + shading * gloss[:, None]
    target = pixels // width // _SUPERSAMPLE * size[0] + pixels % width // _SUPERSAMPLE
    layers = [np.bincount(target, layer, size[0] * size[1]) for layer in (*lit.T, np.ones(len(lit)))]
    return np.stack(layers, -1).reshape(size[1], size[0], 4) / _SUPERSAMPLE**2


def _lighting(normals: Floats, opening: Floats, axes: Floats) -> tuple[Floats, Floats]:
    """Return diffuse factor and gloss [p]: a wrapped key light over the viewer's left shoulder, fill, sky."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    key_direction = np.array([-0.5, 0.62, 0.6]) @ axes
    key_direction /= np.linalg.norm(key_direction)
    key = np.maximum((normals @ key_direction + 0.3) / 1.3, 0) ** 1.4
    fill = np.maximum(normals @ (np.array([0.85, 0.05, 0.5]) @ axes), 0)
    half = key_direction + axes[2]
    gloss = np.maximum(normals @ (half / np.linalg.norm(half)), 0) ** 28
    diffuse = 1.0 * key * (0.3 + 0.7 * opening) + (0.3 + 0.16 * normals[:, 1]) * opening**1.6 + 0.1 * fill
    return diffuse, 0.07 * gloss * opening
