"""Light on a mesh: how open each vertex is to the sky, the shadow on the ground, a key light with fill and gloss."""

import numpy as np
from scipy import ndimage

from datagen.common.arrays import Floats, Integers
from datagen.mesh.geometry import vertex_normals
from training.viz.render.camera import Camera, axes_of
from training.viz.render.rasterizer import rasterise

_SKY_LIGHTS = 20
_SHADOW_PIXELS = 96
_GROUND_PIXELS = 96


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


def ground_shade(camera: Camera, size: tuple[int, int], vertices: Floats, faces: Integers) -> Floats:
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


def lighting(normals: Floats, opening: Floats, axes: Floats) -> tuple[Floats, Floats]:
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
    axes = axes_of(direction)
    mesh, points = vertices @ axes.T, points @ axes.T
    low, extent = mesh.min(0), max(float(np.ptp(mesh, axis=0).max()), 1e-9)
    scale = np.array([_SHADOW_PIXELS / extent, _SHADOW_PIXELS / extent, 1.0])
    _, nearest = rasterise((mesh - low) * scale, faces, _SHADOW_PIXELS, _SHADOW_PIXELS)
    at = np.floor((points - low) * scale)[:, :2].astype(int)
    inside = ((at >= 0) & (at < _SHADOW_PIXELS)).all(1)
    at = np.where(inside[:, None], at, 0)
    open_sky = points[:, 2] - low[2] >= nearest[at[:, 1] * _SHADOW_PIXELS + at[:, 0]] - 0.012 * extent
    return np.asarray(open_sky | ~inside, float)
