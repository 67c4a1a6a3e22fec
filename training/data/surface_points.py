"""Points of a mesh' surface in the place of its vertices, so that a network learns from any sampling of a body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.arrays import Floats

_ALL = slice(None)


class SurfacePoints(NamedTuple):
    """Points of the surfaces of some meshes, each a mixture of three vertices.

    Attributes
    ----------
    corners
        Numbers of the vertices [b, n, 3] int64, that with the largest share first.
    shares
        How much of each [b, n, 3] float32, in sum one.
    drawn
        Of which meshes [b] points were drawn; those of the others are the vertices themselves.
    """

    corners: Tensor
    shares: Tensor
    drawn: tuple[bool, ...]

    def to(self, device: torch.device | str) -> SurfacePoints:
        """The same on another device."""
        return SurfacePoints(self.corners.to(device), self.shares.to(device), self.drawn)

    def of(self, values: Tensor) -> Tensor:
        """Return values [b, n, c] at the points, from those at as many vertices of each mesh [b, n, c]."""
        found = values.clone()
        for mesh in np.flatnonzero(self.drawn).tolist():
            found[mesh] = self.mixed(mesh, values[mesh, self.corners[mesh]])
        return found

    def mixed(self, mesh: int, values: Tensor, rows: Tensor | slice = _ALL) -> Tensor:
        """Return values [k, c] at points [k] of one mesh, by number, from those at their corners [k, 3, c]."""
        return (values * self.shares[mesh, rows, :, None].to(values.dtype)).sum(dim=1)


class Triangles:
    """Triangles of one topology, to draw points of, as many of a triangle as it has of the area.

    Parameters
    ----------
    vertices
        [v, 3] of a body at rest, in any unit: areas are those at rest.
    faces
        [f, 3].

    Attributes
    ----------
    areas
        What share of the area lies around each vertex [v].
    """

    def __init__(self, vertices: Floats, faces: NDArray[np.integer], *, device: torch.device) -> None:
        a, b, c = np.asarray(vertices, np.float64)[faces].swapaxes(0, 1)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) + 1e-30  # a mesh without area has points, too
        self._faces = torch.from_numpy(np.asarray(faces, np.int64)).to(device)
        around = np.bincount(np.asarray(faces).ravel(), np.repeat(areas / 3, 3), len(vertices))
        self.areas = torch.from_numpy(around / around.sum()).float().to(device)
        self._below = torch.from_numpy(np.cumsum(areas / areas.sum())).float().to(device)

    def drawn(self, count: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Corners and shares [count, 3] of points of the surface, even by area."""
        at, one, two = torch.rand((3, count), generator=random, device=self._below.device)
        face = torch.searchsorted(self._below, at).clamp_max(len(self._faces) - 1)
        root = one.sqrt()
        shares, order = torch.stack([1 - root, root * (1 - two), root * two], dim=1).sort(dim=1, descending=True)
        return self._faces[face].gather(1, order), shares


def points_of(
    meshes: Sequence[Triangles], counts: Sequence[int], rows: int, chance: float, random: Sequence[torch.Generator]
) -> SurfacePoints:
    """Draw as many points of each mesh as it has vertices, with this chance; else its vertices stay as they are.

    Even by the areas of the body at rest whose triangles these are, hence nearly so on others of the same topology.

    Parameters
    ----------
    counts
        Vertices of each mesh.
    rows
        To which they are padded; rows after a mesh' count stay what they are.
    """
    device = random[0].device
    corners = torch.arange(rows, device=device)[None, :, None].repeat(len(meshes), 1, 3)
    shares = torch.tensor([1.0, 0.0, 0.0], device=device).repeat(len(meshes), rows, 1)
    chosen = (torch.stack([torch.rand((), generator=own, device=device) for own in random]) < chance).tolist()
    for row, (triangles, count, own) in enumerate(zip(meshes, counts, random, strict=True)):
        if chosen[row]:
            corners[row, :count], shares[row, :count] = triangles.drawn(count, own)
    return SurfacePoints(corners, shares, tuple(chosen))
