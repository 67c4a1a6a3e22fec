"""Skinning weights diffused from a body into the space around it: the field of FITE (Lin et al. 2022), section 3.1.

Wanted are weights that are the body's own on its skin and do not change along its normals there, and are as smooth as
they can be elsewhere. In free space the minimiser of such values under the energy of second derivatives is known: a
thin-plate spline, one dense solve for all bones. That a weight does not change along a normal is said by a second
centre, a centimetre out along the normal, of the same weights.

    w_j(x) = b_j0 + b_j . x - sum_k a_jk |x - c_k|,   sum_k a_jk = 0,   sum_k a_jk c_k = 0

Then weights are clipped to [0, 1] and divided by their sum.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from torch import Tensor
from torch.nn.functional import grid_sample

from datagen.common.arrays import Floats
from datagen.common.errors import CheckpointError
from datagen.mesh.geometry import vertex_normals
from training.avatar.body import CanonicalBody
from training.avatar.solid import Solid
from training.checkpoints.tensor_record import TensorRecord

Progress = Callable[[range], Iterable[int]]
_RIDGE = 1e-7
_CLEAR = 0.7  # of the offset: a second centre that lies nearer to the skin than that is of a fold, and left out
_AT_ONCE = 4_000  # points; with 5,000 centres their distances take 160 MB
_WEIGHTS_AS_METRES = 0.1
"""What one in weights counts as a distance when centres are chosen: they lie closer where weights change."""


@dataclass(frozen=True, eq=False)
class ThinPlate:
    """Skinning weights anywhere, in closed form: ``centres`` [k, 3], ``pulls`` a [k, bone], ``affine`` b [4, bone]."""

    centres: NDArray[np.float64]
    pulls: NDArray[np.float64]
    affine: NDArray[np.float64]

    def weights(self, points: Floats, *, progress: Progress = iter) -> NDArray[np.float64]:
        """Weights [n, bone] at points [n, 3], each in [0, 1], of sum one."""
        found = np.empty((len(points), self.pulls.shape[1]))
        for first in progress(range(0, len(points), _AT_ONCE)):
            found[first : first + _AT_ONCE] = self._clipped(np.asarray(points[first : first + _AT_ONCE], np.float64))
        return found

    def _clipped(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        spline = self.affine[0] + points @ self.affine[1:] - cdist(points, self.centres) @ self.pulls
        clipped = np.clip(spline, 0, 1)
        return clipped / clipped.sum(axis=1, keepdims=True)  # the spline's own sum is one: what is left is no less


@dataclass(frozen=True, eq=False)
class SkinningField(TensorRecord):
    """Skinning weights on a grid of cells that fills a box.

    Parameters
    ----------
    low, high
        Corners [3] of the box, metres, in the canonical pose.
    grid
        Weights [bone, z, y, x] float16 at the centres of cells.
    """

    kind = "skinning field"
    low: Tensor
    high: Tensor
    grid: Tensor

    def weights(self, points: Tensor) -> Tensor:
        """Weights [n, bone] at points [n, 3], linear between cells; beyond the box those of its border."""
        return sampled(self._normalised, self.low, self.high, points)

    def transforms(self, transforms: Tensor) -> Tensor:
        """The blended transform [12, z, y, x] at every cell, of the bones' [bone, 3, 4].

        What is interpolated in it is what interpolated weights blend, as both are linear.
        """
        flat = transforms.to(self._normalised).reshape(len(transforms), 12)
        return torch.einsum("bzyx,bk->kzyx", self._normalised, flat)

    def cells(self) -> Tensor:
        """Centres [z, y, x, 3] of the cells."""
        return torch.from_numpy(box_cells(self.low.numpy(), self.high.numpy(), tuple(self.grid.shape[:0:-1])))

    @cached_property
    def _normalised(self) -> Tensor:
        grid = self.grid.float()
        return grid / grid.sum(dim=0)

    @classmethod
    def load(cls, path: Path) -> Self:
        """See :meth:`TensorRecord.load`."""
        field = super().load(path)
        if field.grid.ndim != 4:
            raise CheckpointError(f"{path} holds no skinning field, but a grid of {field.grid.ndim} axes")
        return field


def sampled(grid: Tensor, low: Tensor, high: Tensor, points: Tensor) -> Tensor:
    """Values [n, k] of a grid [k, z, y, x] of cells in a box at points [n, 3], trilinear; the border's beyond it."""
    place = (2 * (points - low) / (high - low) - 1)[None, None, None]
    return grid_sample(grid[None], place, align_corners=False, padding_mode="border")[0, :, 0, 0].T


def diffused_skinning(
    body: CanonicalBody,
    *,
    centres: int = 2500,
    spacing: float = 0.02,
    margin: float = 0.1,
    progress: Progress = iter,
) -> SkinningField:
    """The field around a body, on a grid.

    Parameters
    ----------
    body
        In the canonical pose.
    centres
        Points of the skin that the spline goes through (:func:`thin_plate`).
    spacing, margin
        Metres: about the edge of a cell, and what the box has around the body; skirts and hair need more.
    progress
        Goes through the range of points whose weights are to be found, a few thousand at a time.
    """
    low, high = body.vertices.min(axis=0) - margin, body.vertices.max(axis=0) + margin
    counts = np.maximum(np.ceil((high - low) / spacing), 2).astype(int)
    cells = box_cells(low, high, tuple(counts.tolist()))
    weights = thin_plate(body, centres=centres).weights(cells.reshape(-1, 3), progress=progress)
    grid = torch.from_numpy(weights.T.astype(np.float16)).reshape(-1, *cells.shape[:3])
    return SkinningField(torch.from_numpy(low).float(), torch.from_numpy(high).float(), grid)


def thin_plate(body: CanonicalBody, *, centres: int = 2500, offset: float = 0.01) -> ThinPlate:
    """The spline through the weights of ``centres`` points of a body's skin, as far from one another as can be.

    Where nobody sees the skin from outside, as within a mouth, it has no say. Each point has a companion ``offset``
    metres out along its normal, but in folds.
    """
    solid, normals = Solid(body.vertices, body.faces), vertex_normals(body.vertices, body.faces)
    seen = np.flatnonzero(solid.seen(body.vertices, normals))
    chosen = seen[farthest_points(np.concatenate([body.vertices, _WEIGHTS_AS_METRES * body.weights], 1)[seen], centres)]
    lifted = body.vertices[chosen] + offset * normals[chosen]
    clear = -solid.depth(lifted) > _CLEAR * offset
    places = np.concatenate([body.vertices[chosen], lifted[clear]])
    return _spline(places, body.weights[np.concatenate([chosen, chosen[clear]])])


def _spline(places: NDArray[np.float64], values: NDArray[np.float64]) -> ThinPlate:
    """The thin-plate spline through values [k, bone] at places [k, 3]."""
    count = len(places)
    system = np.zeros((count + 4, count + 4))
    system[:count, :count] = _RIDGE * np.eye(count) - cdist(places, places)
    system[:count, count], system[:count, count + 1 :] = 1, places
    system[count:, :count] = system[:count, count:].T
    wanted = np.concatenate([values, np.zeros((4, values.shape[1]))])
    found = scipy.linalg.solve(system, wanted, assume_a="sym", overwrite_a=True, overwrite_b=True)
    return ThinPlate(places, found[:count], found[count:])


def farthest_points(points: Floats, count: int) -> NDArray[np.int64]:
    """Numbers of up to ``count`` points [n, d], each the farthest from those before it; all differ in place.

    The first is the farthest from the mean.
    """
    at = np.asarray(points, np.float32)
    chosen, away = list[int](), np.full(len(at), np.inf, np.float32)
    following = int(((at - at.mean(axis=0)) ** 2).sum(axis=1).argmax())
    while len(chosen) < min(count, len(at)) and away[following] > _SAME:
        chosen.append(following)
        away = np.minimum(away, ((at - at[following]) ** 2).sum(axis=1))
        following = int(away.argmax())
    return np.array(chosen, np.int64)


_SAME = 1e-12  # of a squared distance


def box_cells(low: Floats, high: Floats, counts: tuple[int, ...]) -> NDArray[np.float64]:
    """Centres [z, y, x, 3] of (x, y, z) ``counts`` cells that fill a box."""
    axes = [start + (np.arange(count) + 0.5) * (end - start) / count
            for start, end, count in zip(low, high, counts, strict=True)]  # fmt: skip
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack([x, y, z], axis=-1)
