"""What stand-ins of body models are fitted with: principal shapes, and regressors of joints.

Results are rounded to fixed steps, so that the last bits of a linear algebra library do not reach the file.
"""

import numpy as np
from numpy.typing import NDArray

_METRES, _DIRECTIONS, _REGRESSION = 2.0**20, 2.0**24, 2.0**24
_NEAREST = 128  # vertices that a joint may be regressed from
_SUM_TO_ONE = 30.0  # how much the condition counts, against distances in metres


def principal_shapes(bodies: NDArray[np.float64], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean [vertex, 3] and principal directions [vertex, 3, count] of bodies [body, vertex, 3], in metres.

    A direction is what one standard deviation along it moves; the first body lies on its positive side. (The sign of
    its largest component would not do: symmetric bodies have two of equal size.)
    """
    mean = bodies.mean(axis=0)
    spread = (bodies - mean).reshape(len(bodies), -1)
    scores, lengths, axes = np.linalg.svd(spread, full_matrices=False)
    directions = (axes * (lengths / np.sqrt(len(bodies) - 1))[:, None])[:count]
    shaped = (directions * np.sign(scores[0, :count, None])).T.reshape(*mean.shape, -1)
    return on_grid(mean, _METRES), on_grid(shaped, _DIRECTIONS)


def fit_regressor(bodies: NDArray[np.float64], joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Regressor [joint, vertex] that gives joints [body, joint, 3] from bodies [body, vertex, 3].

    Least squares over all bodies, with weights that are not negative and sum to one; few are not zero.
    """
    regressor = np.zeros((joints.shape[1], bodies.shape[1]))
    for joint, row in enumerate(regressor):
        apart = np.linalg.norm(bodies.mean(axis=0) - joints[:, joint].mean(axis=0), axis=1)
        near = np.sort(np.argsort(apart, kind="stable")[:_NEAREST])
        row[near] = _convex_fit(bodies[:, near], joints[:, joint])
    return regressor


def _convex_fit(points: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights [point] of points [body, point, 3] whose weighted mean is nearest to target [body, 3]."""
    from scipy.optimize import nnls

    relative = points - target[:, None]
    equations = relative.transpose(0, 2, 1).reshape(-1, points.shape[1])
    system = np.concatenate([equations, np.full((1, points.shape[1]), _SUM_TO_ONE)])
    weights, _ = nnls(system, np.append(np.zeros(len(equations)), _SUM_TO_ONE))
    rounded = on_grid(weights / weights.sum(), _REGRESSION)
    rounded[rounded.argmax()] += 1 - rounded.sum()
    return rounded


def on_grid(values: NDArray[np.float64], per_unit: float) -> NDArray[np.float64]:
    """Values rounded to multiples of ``1 / per_unit``; none is minus zero, which is equal but other bytes."""
    return np.round(values * per_unit) / per_unit + 0.0
