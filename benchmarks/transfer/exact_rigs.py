"""What exact rigs lose by noise: ``python -m benchmarks.transfer.exact_rigs DATASET [--noise 0.02]``.

No network: the dataset's own rig is fitted to the noisy source, that is, its body at rest, weights and joints are
given, and the pose alone is sought by least squares, from the true one on. The target is posed by its own rig as found.
*Vertices alone* asks nothing else of the pose; with *the spread of the seen poses* a pose counts as less likely the
further it is from their mean, by their covariance. PMD, means, medians in brackets; half a minute for 60 triples.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from datagen.common.arrays import Floats
from datagen.mesh.geometry import bounding_box
from datagen.mesh.rig import skinned, world_rotations
from datagen.store import Dataset, open_dataset
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.evaluation.disturbances import add_noise
from training.evaluation.robustness import Case, cases_of
from training.inference.mesh_reading import normalised
from training.objectives import PMD_UNIT

_STEP = 1e-4  # radians and metres: rotations are rounded to 1e-6
_LEAST_NOISE = 1e-6  # that residuals are counted in
_LEAST_VARIANCE = 1e-4  # of a rotation's numbers, radians squared: joints that hardly turn may a little


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="with rigs and evaluation triples")
    parser.add_argument("--noise", type=float, default=0.02, help="standard deviation, half the longest box edge = 1")
    parser.add_argument("--triples", type=int, default=60)
    options = parser.parse_args()
    dataset = open_dataset(options.dataset)
    cases = cases_of(dataset, options.triples)
    identities = {identity for case in cases for identity in (case.triple[0], case.triple[2])}
    bodies = BodiesAtRest(dataset, sorted(identities))
    print("| given beside the exact rigs | PMD x1e-4 | at most |\n|---|---:|---:|")
    for name, spread in (("vertices alone", None), ("the spread of the seen poses", Spread(dataset))):
        errors = [error(bodies, case, options.noise, spread) for case in cases]
        print(f"| {name} | {np.mean(errors):.2f} ({np.median(errors):.2f}) | {max(errors):.1f} |", flush=True)


class Spread:
    """How poses [..., 3 joints] lie about the mean of the seen ones: numbers whose squares sum to their distance."""

    def __init__(self, dataset: Dataset) -> None:
        seen = dataset.rotations()[dataset.grid.poses("seen")]
        seen = seen.reshape(len(seen), -1)
        covariance = np.cov(seen.T) + _LEAST_VARIANCE * np.eye(seen.shape[1])
        self._mean, self._whitening = seen.mean(axis=0), np.linalg.inv(np.linalg.cholesky(covariance))

    def __call__(self, poses: Floats) -> NDArray[np.float64]:
        return (poses - self._mean) @ self._whitening.T


class Body:
    """A body by its rig."""

    def __init__(self, bodies: BodiesAtRest, identity: int) -> None:
        row = bodies.identities.index(identity)
        self._rig, self._rest = bodies.rigs[row], bodies.vertices[row]
        self._tree: list[int] = list(bodies.dataset.attributes["joint_parents"])

    def posed(self, poses: Floats) -> NDArray[np.float64]:
        """Vertices [pose, vertex, 3] in metres for axis-angles [pose, 3 joints]."""
        world = world_rotations(poses.reshape(len(poses), -1, 3), self._tree)
        return skinned(self._rest, self._rig.weights, self._rig.transforms(world))


def error(bodies: BodiesAtRest, case: Case, noise: float, spread: Spread | None) -> float:
    """PMD of a transfer whose source has noise, in `PMD_UNIT`."""
    source, target = (Body(bodies, identity) for identity in (case.triple[0], case.triple[2]))
    noisy = add_noise(case.source, noise, case.number).vertices
    sigma = max(noise, _LEAST_NOISE) * float(bounding_box(case.source.vertices).half)
    true = bodies.dataset.rotations()[case.triple[1]].reshape(-1).astype(np.float64)
    shift = (case.source.vertices - source.posed(true[None])[0]).mean(axis=0)

    def residuals(guesses: Floats) -> NDArray[np.float64]:
        poses, shifts = guesses[:, :-3], guesses[:, None, -3:]
        missed = ((source.posed(poses) + shifts - noisy) / sigma).reshape(len(guesses), -1)
        return missed if spread is None else np.concatenate([missed, spread(poses)], axis=1)

    def slopes(guess: Floats) -> NDArray[np.float64]:
        around = residuals(guess + _STEP * np.concatenate([np.zeros((1, len(guess))), np.eye(len(guess))]))
        return (around[1:] - around[0]).T / _STEP

    start = np.concatenate([true, shift])
    found = least_squares(lambda guess: residuals(guess[None])[0], start, jac=slopes, max_nfev=6).x
    output = normalised(target.posed(found[None, :-3])[0])
    return case.score(output).pmd / PMD_UNIT


if __name__ == "__main__":
    main()
