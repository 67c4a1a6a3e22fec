"""Points of a mesh' surface in the place of its vertices, so that a network learns from any sampling of a body."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.arrays import Floats
from training.data.row_random import Purpose, RowRandom
from training.networks.execution import sent


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

    def at(self, rows: Tensor) -> SurfacePoints:
        """Those of the points of these numbers [b, k] alone."""
        some = rows[..., None].expand(-1, -1, 3)
        return SurfacePoints(self.corners.gather(1, some), self.shares.gather(1, some), self.drawn)

    def of(self, values: Tensor) -> Tensor:
        """Return values [b, n, c] at the points, from those at the vertices of each mesh [b, n, c]."""
        rows = sent(torch.from_numpy(np.flatnonzero(self.drawn)), values.device)
        corners = self.corners.index_select(0, rows).flatten(1)[..., None].expand(-1, -1, values.shape[2])
        found = _mixed(values.index_select(0, rows).gather(1, corners), self.shares.index_select(0, rows))
        return values.index_copy(0, rows, found)

    def mixed(self, values: Tensor) -> Tensor:
        """Return values [b, n, c] at the points, from those at their corners [b, 3 n, c]."""
        return _mixed(values, self.shares)


def _mixed(values: Tensor, shares: Tensor) -> Tensor:
    of_each = values.view(*shares.shape, values.shape[2])
    return (of_each * shares[..., None].to(values.dtype)).sum(dim=2)


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

    def drawn(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Corners and shares [b, n, 3] of points of the surface, even by area, for numbers [b, n, 3] in [0, 1)."""
        at, one, two = numbers.unbind(2)
        face = torch.searchsorted(self._below, at.contiguous()).clamp_max(len(self._faces) - 1)
        root = one.sqrt()
        shares, order = torch.stack([1 - root, root * (1 - two), root * two], dim=2).sort(dim=2, descending=True)
        return self._faces[face].gather(2, order), shares


def points_of(
    meshes: Sequence[Triangles],
    counts: Sequence[int],
    rows: int,
    chance: float,
    random: RowRandom,
    purposes: tuple[Purpose, Purpose],
) -> SurfacePoints:
    """Draw as many points of each mesh as it has vertices, with this chance; else its vertices stay as they are.

    Even by the areas of the body at rest whose triangles these are, hence nearly so on others of the same topology.

    Parameters
    ----------
    counts
        Vertices of each mesh.
    rows
        To which they are padded; rows after a mesh' count stay what they are.
    random, purposes
        By which meshes, and their points, are drawn.
    """
    device = random.device
    corners = torch.arange(rows, device=device)[None, :, None].repeat(len(meshes), 1, 3)
    shares = (torch.arange(3, device=device) == 0).float().repeat(len(meshes), rows, 1)
    chosen = (random.on_host().uniform(purposes[0]) < chance).tolist()
    alike = defaultdict[tuple[Triangles, int], list[int]](list)
    for row, kind in enumerate(zip(meshes, counts, strict=True)):
        if chosen[row]:
            alike[kind].append(row)
    for (triangles, count), numbers in alike.items():
        those = torch.tensor(numbers)
        its, own = sent(those, device), random.of(those)
        corners[its, :count], shares[its, :count] = triangles.drawn(own.uniform(purposes[1], count, 3))
    return SurfacePoints(corners, shares, tuple(chosen))
