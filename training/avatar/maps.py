"""Position maps: the posed body as four pictures of itself, whose colours are places (FITE, Lin et al., ECCV 2022).

The canonical template is drawn orthographically from four sides, once. What a pixel shows is a weighted mean of three
vertices, so a pose's map is one sparse product of these weights with the posed vertices. Points that a view does not
see read what covers them there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh
from training.networks.avatar import blend, moved
from training.viz.render.rasterizer import on_plane, planes, rasterise

_TURNS, _TILTS = (45, 135, 225, 315), (30, -30, 30, -30)  # degrees about Y, and then about X
_MARGIN = 1.05


@dataclass(frozen=True)
class Views:
    """Where four viewers at +Z, about whom the body is turned, see points.

    Attributes
    ----------
    centres
        Middle of each picture ``[view, 2]``, metres to the right and up.
    scale
        Half pictures a metre, of all views.
    """

    centres: NDArray[np.float64]
    scale: float

    @classmethod
    def of(cls, templates: Sequence[Floats]) -> Views:
        """The views that just hold all templates' vertices ``[n, 3]``, and 5 % more."""
        seen = _seen(np.concatenate(templates))[..., :2]
        low, high = seen.min(axis=1), seen.max(axis=1)
        return cls((low + high) / 2, float(2 / (_MARGIN * (high - low).max())))

    def places(self, points: Floats) -> NDArray[np.float64]:
        """Where points ``[n, 3]`` are seen ``[view, n, 3]``: to the right, up, in [-1, 1], and towards the viewer."""
        seen = _seen(points)
        seen[..., :2] -= self.centres[:, None]
        return self.scale * seen


def _seen(points: Floats) -> NDArray[np.float64]:
    """Points ``[view, n, 3]`` in the axes of each view."""
    turned = [Rotation.from_euler("yx", angles, degrees=True) for angles in zip(_TURNS, _TILTS, strict=True)]
    return np.stack([rotation.apply(points) for rotation in turned])


class PositionMaps:
    """The position maps of one template.

    Parameters
    ----------
    views
        Shared by all templates of an avatar.
    template
        In the canonical pose.
    weights
        Skinning weights ``[n, bone]`` of its vertices.
    size
        Pixels across a map.
    root
        Number of the bone whose motion the maps leave out.
    """

    def __init__(self, views: Views, template: Mesh, weights: Tensor, *, size: int, root: int = 0) -> None:
        self._size, self._root = size, root
        self._weights = weights.float()
        self._vertices = torch.from_numpy(template.vertices).to(self._weights)
        self._drawn = drawn_vertices(views, template, size).to(self._weights)

    def to(self, device: torch.device | str) -> PositionMaps:
        """Move to a device, in place, and return this."""
        self._weights, self._vertices = self._weights.to(device), self._vertices.to(device)
        self._drawn = self._drawn.to(device)
        return self

    @property
    def device(self) -> torch.device:
        """Where maps are made."""
        return self._weights.device

    def __call__(self, transforms: Tensor) -> Tensor:
        """Return maps ``[b, view, 3, size, size]`` for transforms ``[b, bone, 3, 4]`` from the canonical pose."""
        posed = moved(blend(self._weights, root_free(transforms, self._root)), self._vertices)
        return colored(self._drawn, posed, self._size)


def drawn_vertices(views: Views, template: Mesh, size: int) -> Tensor:
    """Return how much of each vertex every pixel shows: a sparse ``[view size size, n]``, rows empty on background."""
    faces = np.asarray(template.faces, np.int64)
    pixels, corners, shares = list[NDArray[np.int64]](), list[NDArray[np.int64]](), list[Floats]()
    for view, place in enumerate(views.places(template.vertices)):
        screen = np.stack([(1 + place[:, 0]) * size / 2, (1 - place[:, 1]) * size / 2, place[:, 2]], axis=1)
        face = rasterise(screen, faces, size, size)[0]
        covered = np.flatnonzero(face >= 0)
        owner, across, down = face[covered], covered % size + 0.5, covered // size + 0.5
        plane = planes(screen, faces)[0]
        second, third = (on_plane(plane[corner], owner, across, down) for corner in range(2))
        pixels.append(np.repeat(view * size * size + covered, 3))
        corners.append(faces[owner].ravel())
        shares.append(np.stack([1 - second - third, second, third], axis=1).ravel())
    where = torch.from_numpy(np.stack([np.concatenate(pixels), np.concatenate(corners)]))
    rows = len(views.centres) * size * size
    return torch.sparse_coo_tensor(
        where, torch.from_numpy(np.concatenate(shares)), (rows, len(template.vertices)), check_invariants=True
    ).coalesce()


def colored(drawn: Tensor, values: Tensor, size: int) -> Tensor:
    """Return pictures ``[b, view, c, size, size]`` of vertices' values ``[b, n, c]`` (:func:`drawn_vertices`)."""
    frames, count, channels = values.shape
    pixels = torch.sparse.mm(drawn, values.transpose(0, 1).reshape(count, -1))
    return pixels.reshape(-1, size, size, frames, channels).permute(3, 0, 4, 1, 2)


def root_free(transforms: Tensor, root: int = 0) -> Tensor:
    """Return transforms ``[b, bone, 3, 4]`` as they are where the bone ``root`` stays: its inverse before each."""
    back = transforms[:, root : root + 1, :, :3].mT
    moved_back = back @ transforms
    return torch.cat([moved_back[..., :3], moved_back[..., 3:] - back @ transforms[:, root : root + 1, :, 3:]], dim=-1)
