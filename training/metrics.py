"""Evaluation metrics (DSFFNet, section 4.2). Every function takes ``[b, n, 3]`` vertices and returns ``[b]`` float64.

Definitions differ between papers, and so do units: print them beside every table. "Box" is the unit of normalised
coordinates, half the longest edge of a mesh's bounding box. Arithmetic is in float64, on the CPU where SciPy does it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from training.losses import SHORTEST_EDGE

POINT_MESH_DISTANCE_SCALE = 1e-4
"""Tables print PMD in units of this."""

CHAMFER_DISTANCE_SCALE = 1e-4
"""Tables print CD in units of this."""

EARTH_MOVER_DISTANCE_SCALE = 1e-3
"""Tables print EMD in units of this."""

EARTH_MOVER_POINTS = 1024
"""Vertices of which the EMD is taken by default: an exact assignment takes time in the cube of this."""


def point_mesh_distance(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return PMD, the mean over vertices *and coordinates* of ``(prediction - truth)^2``, in box^2.

    The paper calls it a Euclidean distance (section 4.2); its code and its numbers are this.
    """
    first, second = _pair(prediction, truth)
    return (first - second).square().mean(dim=(1, 2))


def recentred_point_mesh_distance(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return PMD (box^2) after moving the centre of the prediction's bounding box onto that of the truth.

    NPT and 3D-CoreNet report this.
    """
    first, second = _pair(prediction, truth)
    return point_mesh_distance(first - _box_centre(first) + _box_centre(second), second)


def mean_euclidean_error(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over vertices of ``|prediction - truth|``, in the unit of the input (say, millimetres)."""
    first, second = _pair(prediction, truth)
    return (first - second).norm(dim=2).mean(dim=1)


def chamfer_distance(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return CD, mean squared distance to the nearest vertex, prediction to truth plus truth to prediction, in box^2.

    ``CD = mean_p min_t |p - t|^2 + mean_t min_p |p - t|^2`` (section 4.2), exact, by k-d trees; never above ``6 PMD``.
    The two meshes may differ in their number of vertices.
    """
    first, second = _clouds(prediction, truth)
    return torch.tensor([_chamfer(p, t) for p, t in zip(first, second, strict=True)], dtype=torch.float64)


def earth_mover_distance(
    prediction: Tensor, truth: Tensor, *, points: int = EARTH_MOVER_POINTS, seed: int = 0
) -> Tensor:
    """Return EMD, the mean distance (box) under the best one-to-one assignment: ``min_s mean_i |p_i - t_s(i)|``.

    Section 4.2. Exact, on the same ``min(points, n)`` vertices of both, drawn by `seed` without replacement: the time
    grows as the cube of their number. With all vertices, ``EMD <= sqrt(3 PMD)``.

    Parameters
    ----------
    prediction, truth
        ``[b, n, 3]``, vertex by vertex.
    points
        Number of vertices to draw; state it beside the figure.
    seed
        Seed of the draw; the same vertices for every mesh of ``n`` vertices.

    Raises
    ------
    ValueError
        If the shapes differ or `points` is not positive.
    """
    if points < 1:
        raise ValueError(f"points must be positive, got {points}")
    first, second = (array.numpy() for array in _pair(prediction.cpu(), truth.cpu()))
    count = first.shape[1]
    chosen = np.random.default_rng(seed).permutation(count)[:points] if points < count else np.arange(count)
    values = [_assignment(p[chosen], t[chosen]) for p, t in zip(first, second, strict=True)]
    return torch.tensor(values, dtype=torch.float64)


def edge_length_ratio_error(prediction: Tensor, truth: Tensor, edges: Tensor) -> Tensor:
    """Return the mean over `edges` (``[e, 2]`` int64) of ``|l_prediction / l_truth - 1|``, without unit.

    Edges of the truth not longer than `SHORTEST_EDGE` count as zero.
    """
    first, second = (_lengths(mesh, edges) for mesh in _pair(prediction, truth))
    error = torch.where(second > SHORTEST_EDGE, first / second - 1, 0)
    return error.abs().mean(dim=1)


def normal_angle_error(prediction: Tensor, truth: Tensor, faces: Tensor) -> Tensor:
    """Return the mean over `faces` (``[f, 3]`` integers) of the angle between the two normals, in degrees.

    Every face counts once, whatever its area. A face without a normal in the truth (zero area) is left out; one
    without a normal in the prediction counts as 90 degrees. Zero if no face has a normal in the truth.
    """
    first, second = (_normals(mesh, faces.long()) for mesh in _pair(prediction, truth))
    # atan2 keeps its precision near 0 and 180 degrees, where the arc cosine loses half of the digits.
    angle = torch.rad2deg(torch.atan2(torch.linalg.cross(first, second).norm(dim=2), (first * second).sum(dim=2)))
    angle = torch.where(first.norm(dim=2) > 0, angle, 90.0)
    counted = second.norm(dim=2) > 0
    return (angle * counted).sum(dim=1) / counted.sum(dim=1).clamp_min(1)


def _pair(prediction: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    if prediction.shape != truth.shape:
        raise ValueError(f"prediction and truth differ in shape: {list(prediction.shape)} and {list(truth.shape)}")
    return _mesh(prediction), _mesh(truth)


def _mesh(vertices: Tensor) -> Tensor:
    if vertices.ndim != 3 or vertices.shape[1] < 1 or vertices.shape[2] != 3:
        raise ValueError(f"vertices must be [batch, vertex, 3] with a vertex at least, got {list(vertices.shape)}")
    return vertices.detach().double()


def _clouds(prediction: Tensor, truth: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if len(prediction) != len(truth):
        raise ValueError(f"prediction and truth differ in number: {list(prediction.shape)} and {list(truth.shape)}")
    return _mesh(prediction).cpu().numpy(), _mesh(truth).cpu().numpy()


def _box_centre(vertices: Tensor) -> Tensor:
    return (vertices.amin(dim=1, keepdim=True) + vertices.amax(dim=1, keepdim=True)) / 2


def _chamfer(prediction: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    there, _ = cKDTree(truth).query(prediction)
    back, _ = cKDTree(prediction).query(truth)
    return float(np.mean(there**2) + np.mean(back**2))


def _assignment(prediction: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    costs = cdist(prediction, truth)
    return float(costs[linear_sum_assignment(costs)].mean())


def _lengths(vertices: Tensor, edges: Tensor) -> Tensor:
    return (vertices[:, edges[:, 0]] - vertices[:, edges[:, 1]]).norm(dim=2)


def _normals(vertices: Tensor, faces: Tensor) -> Tensor:
    a, b, c = (vertices[:, faces[:, corner]] for corner in range(3))
    return torch.linalg.cross(b - a, c - a)
