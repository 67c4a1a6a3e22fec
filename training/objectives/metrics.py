"""Evaluation metrics (DSFFNet, section 4.2). Every function takes ``[b, n, 3]`` vertices and returns ``[b]`` float64.

Definitions differ between papers, and so do units: print them beside every table. "Box" is the unit of normalised
coordinates, half the longest edge of a mesh's bounding box. With p and t corresponding vertices of prediction and
truth, n their number, a their share of the truth's area, and s a one-to-one assignment:

===============================  =================================================  =======  ===============
function                         formula                                            unit     tables print
===============================  =================================================  =======  ===============
point_mesh_distance              sum_i |p_i - t_i|^2 / (3 n)                        box^2    in 1e-4
recentred_point_mesh_distance    the same, prediction's box moved onto the truth's  box^2    in 1e-4
area_point_mesh_distance         sum_i a_i |p_i - t_i|^2 / (3 sum_i a_i)            box^2    in 1e-4
chamfer_distance                 mean_i min_j |p_i - t_j|^2 + mean_j min_i (same)   box^2    in 1e-4
earth_mover_distance             min_s mean_i |p_i - t_s(i)|                        box      in 1e-3
mean_euclidean_error             mean_i |p_i - t_i|                                 input's  in millimetres
edge_length_ratio_error          mean_e |l_e(p) / l_e(t) - 1|                       none     as it is
normal_angle_error               mean_f angle(n_f(p), n_f(t))                       degrees  as it is
===============================  =================================================  =======  ===============

The definitions entail ``EMD <= mean Euclidean error <= sqrt(3 PMD)`` (EMD over all vertices) and ``CD <= 6 PMD``.

Arithmetic is in float64 whatever the input, so that a metric agrees with brute force to far more digits than a table
prints. Meshes may be on a GPU, and the result is where the prediction is; what SciPy does (CD, EMD) is done on the CPU.
A mesh with a coordinate that is not finite, in prediction or truth, has the metric NaN, and no other mesh is affected.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from training.objectives.losses import SHORTEST_EDGE

EARTH_MOVER_POINTS = 1024
"""Vertices of which the EMD is taken by default: an exact assignment takes time in up to the cube of this."""

Points = NDArray[np.float64]

_SOFTNESS, _ROUNDS, _TINY = 0.02, 40, np.float32(1e-30)
"""Of the prices that speed up an assignment: their blur as a part of the mean cost, and rounds of scaling."""


def point_mesh_distance(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return PMD, the mean over vertices *and coordinates* of ``(prediction - truth)^2``, in box^2.

    The paper calls it a Euclidean distance (section 4.2); its code and its numbers are this.

    Parameters
    ----------
    prediction, truth
        ``[b, n, 3]``, vertex by vertex, in the normalised box.

    Raises
    ------
    ValueError
        If the shapes differ or are no meshes.
    """
    first, second = _pair(prediction, truth)
    return _where_finite((first - second).square().mean(dim=(1, 2)), first, second)


def recentred_point_mesh_distance(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return PMD (box^2) after moving the centre of the prediction's bounding box onto that of the truth.

    NPT and 3D-CoreNet report this. It may exceed PMD: the centres of boxes are not those of mass.
    """
    first, second = _pair(prediction, truth)
    return point_mesh_distance(first - _box_centre(first) + _box_centre(second), second)


def area_point_mesh_distance(prediction: Tensor, truth: Tensor, faces: Tensor) -> Tensor:
    """Return PMD (box^2) with each vertex weighted by a third of the area of its faces in the truth.

    PMD counts every vertex alike, so that half of Anny's are fingers, toes and face. Parameters are as of
    :func:`point_mesh_distance`; `faces`: ``[f, 3]`` integers. NaN where the truth has no area.
    """
    first, second = _pair(prediction, truth)
    corners, right = faces.cpu().long(), second.cpu()  # on a GPU the sums would come in another order each time
    thirds = _normals(right, corners).norm(dim=2, keepdim=True).expand(-1, -1, 3).flatten(1)
    areas = torch.zeros_like(right[..., 0]).index_add_(1, corners.flatten(), thirds).to(second.device)
    weighted = (areas * (first - second).square().mean(dim=2)).sum(dim=1) / areas.sum(dim=1)
    return _where_finite(weighted, first, second)


def mean_euclidean_error(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over vertices of ``|prediction - truth|``, in the unit of the input.

    In the normalised box this times half the longest edge of the truth's box in metres, times 1000, is the error in
    millimetres at the target identity's own size.
    """
    first, second = _pair(prediction, truth)
    return _where_finite((first - second).norm(dim=2).mean(dim=1), first, second)


def chamfer_distance(prediction: Tensor, truth: Tensor) -> Tensor:
    """Return CD, mean squared distance to the nearest vertex, prediction to truth plus truth to prediction, in box^2.

    ``CD = mean_p min_t |p - t|^2 + mean_t min_p |p - t|^2`` (section 4.2), exact. The two meshes may differ in
    their number of vertices.

    Nearest vertices come from k-d trees on the CPU, for meshes on a GPU too: n log n time and memory in proportion to
    n, where a table of all float64 distances between two meshes of 28,920 vertices would take 6.7 GB, and blocks of it
    8.4e8 float64 distances on GPUs of which most are slow at float64.

    Raises
    ------
    ValueError
        If there are not equally many meshes, or they are none.
    """
    first, second = _mesh(prediction), _mesh(truth)
    if len(first) != len(second):
        raise ValueError(f"prediction and truth differ in number: {list(prediction.shape)} and {list(truth.shape)}")
    return _one_by_one(_chamfer, first, second)


def earth_mover_distance(
    prediction: Tensor, truth: Tensor, *, points: int = EARTH_MOVER_POINTS, seed: int = 0
) -> Tensor:
    """Return EMD, the mean distance (box) under the best one-to-one assignment: ``min_s mean_i |p_i - t_s(i)|``.

    Section 4.2. Exact (SciPy's shortest augmenting paths), on
    the same ``min(points, n)`` vertices of both, drawn by `seed` without replacement. Over all vertices
    ``EMD <= sqrt(3 PMD)``; over fewer the same with the PMD of those. EMD grows as the points thin out, since a vertex
    then finds its nearest partners missing: compare figures of one number of points only.

    It is what an evaluation's time goes into. Measured on one core with bodies of Anny: a pair of 1,024 points takes
    25 ms where prediction and truth are near (PMD 9e-4) and 60 ms where they are far apart (PMD 830e-4), 615 points 7
    and 17 ms; all other metrics together take 2 to 5 ms at 1,229 vertices, and 35 to 145 ms (CD) at 13,718.

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
    first, second = _pair(prediction, truth)
    chosen = torch.from_numpy(_drawn(first.shape[1], points, seed)).to(first.device)
    return _one_by_one(_assignment, first[:, chosen], second[:, chosen])


def edge_length_ratio_error(prediction: Tensor, truth: Tensor, edges: Tensor) -> Tensor:
    """Return the mean over `edges` (``[e, 2]`` int64) of ``|l_prediction / l_truth - 1|``, without unit.

    Edges of the truth not longer than `SHORTEST_EDGE` count as zero.
    """
    first, second = _pair(prediction, truth)
    ours, right = (_lengths(mesh, edges.to(mesh.device)) for mesh in (first, second))
    error = torch.where(right > SHORTEST_EDGE, ours / right - 1, 0)
    return _where_finite(error.abs().mean(dim=1), first, second)


def normal_angle_error(prediction: Tensor, truth: Tensor, faces: Tensor) -> Tensor:
    """Return the mean over `faces` (``[f, 3]`` integers) of the angle between the two normals, in degrees.

    Every face counts once, whatever its area. A face without a normal in the truth (zero area) is left out; one
    without a normal in the prediction counts as 90 degrees. Zero if no face has a normal in the truth.
    """
    first, second = _pair(prediction, truth)
    ours, right = (_normals(mesh, faces.to(mesh.device).long()) for mesh in (first, second))
    # atan2 keeps its precision near 0 and 180 degrees, where the arc cosine loses half of the digits.
    angle = torch.rad2deg(torch.atan2(torch.linalg.cross(ours, right).norm(dim=2), (ours * right).sum(dim=2)))
    angle = torch.where(ours.norm(dim=2) > 0, angle, 90.0)
    counted = right.norm(dim=2) > 0
    return _where_finite((angle * counted).sum(dim=1) / counted.sum(dim=1).clamp_min(1), first, second)


def _pair(prediction: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    if prediction.shape != truth.shape:
        raise ValueError(f"prediction and truth differ in shape: {list(prediction.shape)} and {list(truth.shape)}")
    return _mesh(prediction), _mesh(truth)


def _mesh(vertices: Tensor) -> Tensor:
    if vertices.ndim != 3 or vertices.shape[1] < 1 or vertices.shape[2] != 3:
        raise ValueError(f"vertices must be [batch, vertex, 3] with a vertex at least, got {list(vertices.shape)}")
    return vertices.detach().double()


def _finite(first: Tensor, second: Tensor) -> Tensor:
    """Which pairs of a batch have nothing but numbers."""
    return first.isfinite().all(dim=2).all(dim=1) & second.isfinite().all(dim=2).all(dim=1)


def _where_finite(values: Tensor, first: Tensor, second: Tensor) -> Tensor:
    return torch.where(_finite(first, second), values, torch.nan)


def _one_by_one(metric: Callable[[Points, Points], float], first: Tensor, second: Tensor) -> Tensor:
    """A metric of NumPy arrays [n, 3] for each pair of a batch, where the batch is."""
    pairs = zip(first.cpu().numpy(), second.cpu().numpy(), _finite(first.cpu(), second.cpu()).tolist(), strict=True)
    values = [metric(ours, right) if finite else float("nan") for ours, right, finite in pairs]
    return torch.tensor(values, dtype=torch.float64, device=first.device)


def _box_centre(vertices: Tensor) -> Tensor:
    return (vertices.amin(dim=1, keepdim=True) + vertices.amax(dim=1, keepdim=True)) / 2


def _chamfer(prediction: Points, truth: Points) -> float:
    there, _ = cKDTree(truth).query(prediction)
    back, _ = cKDTree(prediction).query(truth)
    return float(np.mean(there**2) + np.mean(back**2))


def _drawn(count: int, points: int, seed: int) -> NDArray[np.int64]:
    return np.random.default_rng(seed).permutation(count)[:points] if points < count else np.arange(count)


def _assignment(prediction: Points, truth: Points) -> float:
    from scipy.optimize import linear_sum_assignment  # it takes a while, and a transfer asks for no EMD

    costs = cdist(prediction, truth)
    if not costs.any():
        return 0.0
    return float(costs[linear_sum_assignment(_reduced(costs))].mean())


def _reduced(costs: Points) -> Points:
    """Costs less a price for every row and column: the same assignments are best, and they are found sooner.

    Any prices would do; these nearly are those of the best assignment, from a few rounds of Sinkhorn's matrix scaling
    in float32. A row of the solver then looks at few columns before it finds its own.
    """
    least, softness = costs.min(axis=1, keepdims=True), costs.mean() * _SOFTNESS
    kernel = np.exp(((least - costs) / softness).astype(np.float32))
    kernel[kernel < _TINY] = 0  # a product with denormal floats takes ten times as long
    columns = np.ones(len(costs), np.float32)
    for _ in range(_ROUNDS):
        rows = 1 / np.maximum(kernel @ columns, _TINY)
        columns = 1 / np.maximum(rows @ kernel, _TINY)
    reduced = costs - softness * np.log(columns.astype(np.float64))
    reduced -= reduced.min(axis=1, keepdims=True)
    return reduced - reduced.min(axis=0)


def _lengths(vertices: Tensor, edges: Tensor) -> Tensor:
    return (vertices[:, edges[:, 0]] - vertices[:, edges[:, 1]]).norm(dim=2)


def _normals(vertices: Tensor, faces: Tensor) -> Tensor:
    a, b, c = (vertices[:, faces[:, corner]] for corner in range(3))
    return torch.linalg.cross(b - a, c - a)
