"""Pictures of triangle meshes by a small software rasteriser: NumPy and SciPy only, no GPU, X server or GL library.

Frame: Y up, bodies face +Z. Supersampled, smooth-shaded, lit by a key light and an occluded sky, with a soft shadow.
"""

import numpy as np
import numpy.typing as npt

from datagen.common.arrays import Floats, Integers
from datagen.mesh.geometry import Mesh, vertex_normals
from training.viz.look import Look
from training.viz.render.camera import Camera, checked_vertices, frame
from training.viz.render.lighting import ground_shade, lighting, openness
from training.viz.render.rasterizer import on_plane, planes, rasterise

CLAY = (0.72, 0.74, 0.78)
BACKGROUND = (0.975, 0.978, 0.982)
_SUPERSAMPLE = 3


def render_mesh(
    vertices: Floats,
    faces: Integers,
    *,
    colors: npt.ArrayLike | None = None,
    look: Look | None = None,
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
    look : Look, optional
        What the faces look like by themselves, in the place of ``colors``.
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
    vertices, faces = checked_vertices(vertices), _checked_faces(faces, len(vertices))
    camera = camera or frame([Mesh(vertices, faces)], size=size)
    normals = vertex_normals(vertices, faces)
    if look is not None:
        colors = (1.0, 1.0, 1.0) if look.colors is None else look.colors
    albedo = _linear(_checked_colors(CLAY if colors is None else colors, len(vertices)))
    attributes = np.c_[normals, openness(vertices, faces), albedo]
    light = _supersampled(camera, size, vertices, faces, attributes, shading, look)
    mesh_light, coverage = light[..., :3], light[..., 3:]
    scenery = _linear(np.array(background)) * (1 - shading * ground_shade(camera, size, vertices, faces))[..., None]
    picture = _display(mesh_light + (1 - coverage) * scenery)
    return np.asarray(np.rint(255 * picture), np.uint8)


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


def _linear(color: Floats) -> Floats:
    return np.asarray(color, float) ** 2.2


def _display(light: Floats) -> Floats:
    return np.clip(light, 0, 1) ** (1 / 2.2)


def _supersampled(
    camera: Camera,
    size: tuple[int, int],
    vertices: Floats,
    faces: Integers,
    attributes: Floats,
    shading: float,
    look: Look | None,
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
    kept = np.flatnonzero((-in_view[faces, 2] > 1e-6).all(1))
    ahead = faces[kept]
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
    diffuse, gloss = lighting(normals, surface[:, 3], axes)
    paint = 1.0 if look is None else look.painted(kept[owner], weights)
    lit = paint * surface[:, 4:] * (1 + shading * (diffuse - 1))[:, None] + shading * gloss[:, None]
    target = pixels // width // _SUPERSAMPLE * size[0] + pixels % width // _SUPERSAMPLE
    layers = [np.bincount(target, layer, size[0] * size[1]) for layer in (*lit.T, np.ones(len(lit)))]
    return np.stack(layers, -1).reshape(size[1], size[0], 4) / _SUPERSAMPLE**2
