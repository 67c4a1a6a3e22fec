"""Anny's shape space in plain numpy: from phenotypes and local changes to points at rest.

Anny's own tables (Bregier et al. 2025, section 3): a blend shape belongs to some variations of phenotypes, such as
(female, old, minmuscle); its weight is the product of their shares, and a phenotype's value shares itself out linearly
between the two variations next to it. Local changes are pairs of blend shapes, one for either sign.

Everything is added up element by element in a fixed order: a matrix product would give other last bits on another
number of threads, as would the basis that Anny compacts its blend shapes into (its singular vectors differ by 1e-8).
"""

from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

_AGE_OF_NEWBORN = -1 / 3  # the first of the five ages; the variations of all other phenotypes begin at 0
_UNSET = 0.5  # what Anny gives to phenotypes that it is not asked for


class AnnyShape:
    """Points [point, 3] at rest, vertices first and then bone heads, in metres: Anny's axes, Z up, facing -Y."""

    def __init__(self, model: Any) -> None:
        self.phenotypes = tuple(model.phenotype_labels)
        self.local_changes = tuple(model.local_change_labels)
        mask = model.stacked_phenotype_blend_shapes_mask.numpy() > 0
        used, self._vertices = self._ever_used(mask), len(model.template_vertices)
        vertices, heads = model.blendshapes.numpy(), model.bone_heads_blendshapes.numpy()
        self._mask = mask[used]
        self._blends = _flat(vertices[: len(mask)][used], heads[: len(mask)][used])
        self._local = scipy.sparse.csr_array(_flat(vertices[len(mask) :], heads[len(mask) :]))
        self._template = _flat(model.template_vertices.numpy()[None], model.template_bone_heads.numpy()[None])[0]

    def heads(self, parameters: tuple[float, ...]) -> NDArray[np.float64]:
        """Bone heads [bone, 3] alone: the last of the points, to the bit, at a fraction of the time."""
        return self.points(parameters, first=self._vertices)

    def points(self, parameters: tuple[float, ...], first: int = 0) -> NDArray[np.float64]:
        """Points [point, 3] from number ``first`` on, of phenotypes in their order, followed by local changes."""
        values = dict(zip(self.phenotypes, parameters, strict=False))
        flat = self._template[3 * first :].copy()
        weights = _weights(self._mask, variation_shares(values))
        for blend in np.flatnonzero(weights):
            flat += weights[blend] * self._blends[blend, 3 * first :]
        for row, weight in _local_weights(parameters[len(self.phenotypes) :]):
            some = slice(self._local.indptr[row], self._local.indptr[row + 1])
            columns = self._local.indices[some] - 3 * first
            flat[columns[columns >= 0]] += weight * self._local.data[some][columns >= 0]
        return flat.reshape(-1, 3)

    def _ever_used(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Blend shapes [blend] whose weight is not always zero, as it is for extremes of what stays unset."""
        anything = {name: np.full(count, 1.0) for name, count in _variations().items() if name in self.phenotypes}
        shares = [anything.get(name, own) for name, own in _shares({}).items()]
        return _weights(mask, np.concatenate(shares)) > 0


def variation_shares(values: dict[str, float]) -> NDArray[np.float64]:
    """Share [variation] of every phenotype's variations, in Anny's order; phenotypes without a value have 0.5."""
    return np.concatenate(list(_shares(values).values()))


def _shares(values: dict[str, float]) -> dict[str, NDArray[np.float64]]:
    return {
        name: np.full(count, 1 / count) if name == "race" else _hats(values.get(name, _UNSET), name, count)
        for name, count in _variations().items()
    }


def _hats(value: float, name: str, count: int) -> NDArray[np.float64]:
    """Linear interpolation: 1 at the variation's own place, 0 from the next one's on."""
    first = _AGE_OF_NEWBORN if name == "age" else 0.0
    step = (1.0 - first) / (count - 1)
    return np.clip(1.0 - np.abs((value - first) / step - np.arange(count)), 0.0, 1.0)


def _variations() -> dict[str, int]:
    from anny.models.model_data import PHENOTYPE_VARIATIONS

    return {name: len(variations) for name, variations in PHENOTYPE_VARIATIONS.items()}


def _weights(mask: NDArray[np.bool_], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    weights = np.ones(len(mask))
    for belongs, share in zip(mask.T, shares, strict=True):
        weights[belongs] *= share
    return weights


def _local_weights(values: tuple[float, ...]) -> list[tuple[int, float]]:
    """Row and weight of the blend shapes of local changes: even rows for positive values, odd ones for negative."""
    return [(2 * change + (value < 0), abs(value)) for change, value in enumerate(values) if value != 0]


def _flat(vertices: NDArray[np.float64], heads: NDArray[np.float64]) -> NDArray[np.float64]:
    both = np.concatenate([vertices, heads], axis=1)
    return both.reshape(len(both), both.shape[1] * 3)
