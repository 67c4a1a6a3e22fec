"""How identities of Anny are drawn: uniform, or as plausible people; and their local changes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, betaincinv

from datagen.recipe import PhenotypeRanges, Range

_OLDEST = 90.0  # years; Anny's own samples are uniform from birth to this


def draw_uniform(random: np.random.Generator, ranges: PhenotypeRanges, names: Sequence[str]) -> NDArray[np.float64]:
    """Every phenotype of ``names`` uniform within its range."""
    return np.array([random.uniform(*getattr(ranges, name)) for name in names])


def draw_local_changes(random: np.random.Generator, labels: Sequence[str], strength: float) -> NDArray[np.float64]:
    """Local changes [label] uniform within +- ``strength``, where Anny allows +-1; left and right get the same."""
    drawn: dict[str, float] = {}
    for label in labels:
        pair = label.removeprefix("l-").removeprefix("r-")
        if pair not in drawn:
            drawn[pair] = random.uniform(-strength, strength)
    return np.array([drawn[label.removeprefix("l-").removeprefix("r-")] for label in labels])


class Population:
    """Plausible people, from the distribution that Anny's authors calibrated to WHO growth charts.

    Gender and years of age are uniform; height, weight, muscle and proportions are Beta distributions that depend on
    both. Each is drawn through its inverse distribution function, so that ranges cut it off exactly and the numpy
    generator is the only source of randomness (Anny's own sampler draws from torch's global one).
    """

    def __init__(self, model: Any) -> None:
        from anny.shape_distribution import SimpleShapeDistribution

        calibrated = SimpleShapeDistribution(model)
        mapping = calibrated.morphological_age_mapping
        self._ages, self._years = mapping.anny_age_anchors.numpy(), mapping.morphological_age_anchors.numpy()
        self._tables = {
            (sex, name): _table(getattr(calibrated, f"{sex}_conditional_{name}_distribution"))
            for sex in ("boys", "girls")
            for name in ("height", "weight", "muscle", "proportions")
        }

    def draw(self, random: np.random.Generator, ranges: PhenotypeRanges, names: Sequence[str]) -> NDArray[np.float64]:
        """Phenotypes of ``names`` of one person within the ranges."""
        gender = random.uniform(*ranges.gender)
        age = self._draw_age(random, ranges.age)
        person = {"gender": gender, "age": age}
        sex = "boys" if gender <= 0.5 else "girls"
        for name in ("height", "weight", "muscle", "proportions"):
            ages, alpha, beta = self._tables[sex, name]
            shape = float(np.interp(age, ages, alpha)), float(np.interp(age, ages, beta))
            person[name] = _truncated_beta(random, shape, getattr(ranges, name))
        return np.array([person[name] for name in names])

    def _draw_age(self, random: np.random.Generator, within: Range) -> float:
        youngest, oldest = np.interp(within, self._ages, self._years)
        years = random.uniform(youngest, max(youngest, min(oldest, _OLDEST)))
        return float(np.clip(np.interp(years, self._years, self._ages), *within))


def _table(distribution: Any) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    tensors = distribution.age_anchors, distribution.alpha_anchors, distribution.beta_anchors
    ages, alpha, beta = (tensor.numpy() for tensor in tensors)
    return ages, alpha, beta


def _truncated_beta(random: np.random.Generator, shape: tuple[float, float], within: Range) -> float:
    """A Beta variate within a range, to nine decimals: versions of the special functions differ in the last bits."""
    low, high = (float(betainc(*shape, bound)) for bound in within)
    value = float(betaincinv(*shape, random.uniform(low, high)))
    return float(np.clip(round(value, 9), *within))
