"""What bodies of SMPL's layout share: shape blend shapes, regressed joints, pose blend shapes, skinning.

As in :mod:`datagen.bodies.skinning`, factors are rounded to steps of powers of two that are chosen so that float64
holds every product and every partial sum exactly: matrix products then give the same bits whatever the BLAS, the
CPU or the number of threads. The steps are some nanometres, far below the micrometre of the skinning itself.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.skinning import VERTICES_AT_ONCE, Rest, remembering, skin
from datagen.bodies.smpl_family.model_file import ModelFile
from datagen.common.errors import BodyError

_STEPS = 2.0**20  # parameters, rotations: a step of a millionth
_SHAPED_STEPS = 2.0**24  # metres at rest, from which joints are regressed: 60 nanometres
_MANTISSA = 52


class LayoutBody:
    """A model file made ready: parameters to an identity at rest, identity and rotations to vertices.

    Parameters
    ----------
    file
        The model, in our frame (see :func:`turned`).
    betas
        How many shape parameters are in use.
    reach
        The largest magnitude that they will have.
    """

    def __init__(self, file: ModelFile, *, betas: int, reach: float) -> None:
        self.faces, self.parents = file.faces, file.parents
        self._template, self._weights = file.template, file.weights
        self._shapedirs = _exact_beside(file.shapedirs[..., :betas], largest=reach, steps=_STEPS, axis=-1)
        extent = float(np.abs(self._template).max() + reach * np.abs(self._shapedirs).sum(axis=-1).max())
        self._regressor = _exact_beside(file.regressor, largest=extent, steps=_SHAPED_STEPS, axis=1)
        by_feature = np.ascontiguousarray(file.posedirs.reshape(-1, file.posedirs.shape[-1]).T)
        self._posedirs = _exact_beside(by_feature, largest=2.0, steps=_STEPS, axis=0) if by_feature.any() else None
        self.rest = remembering(self._rest)

    def _rest(self, betas: NDArray[np.float64]) -> Rest:
        """The identity of shape parameters [beta]: SMPL's equations 8 and 10, by the reference implementation."""
        import torch
        from smplx.lbs import blend_shapes, vertices2joints  # type: ignore[import-untyped,unused-ignore]

        rounded = torch.from_numpy(_round(betas, _STEPS))[None]
        offsets = blend_shapes(rounded, torch.from_numpy(self._shapedirs))[0].numpy()
        vertices = _round(self._template + offsets, _SHAPED_STEPS)
        joints = vertices2joints(torch.from_numpy(self._regressor), torch.from_numpy(vertices)[None])[0].numpy()
        return Rest(vertices, joints, self._weights, self.parents)

    def vertices(self, betas: NDArray[np.float64], world: NDArray[np.float64]) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32 in metres for world rotations [pose, joint, 3, 3] relative to rest."""
        rest = self.rest(betas)
        if self._posedirs is None:
            return skin(rest, world)
        posed = np.empty((len(world), len(rest.vertices), 3), np.float32)
        at_once = max(1, VERTICES_AT_ONCE // len(rest.vertices))
        for first in range(0, len(world), at_once):
            some = slice(first, first + at_once)
            posed[some] = skin(rest, world[some], self.correctives(world[some]))
        return posed

    def correctives(self, world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pose blend shapes [pose, vertex, 3] in metres (SMPL's equation 9): linear in R - I, R relative to parents."""
        assert self._posedirs is not None
        world = _round(world, _STEPS)
        relative = world[:, list(self.parents[1:])].swapaxes(-1, -2) @ world[:, 1:]
        features = _round(relative - np.eye(3), _STEPS).reshape(len(world), -1)
        return (features @ self._posedirs).reshape(len(world), -1, 3)


def require_betas(file: ModelFile, wanted: int, available: int) -> None:
    """Refuse to use more shape parameters than the file has.

    Raises
    ------
    BodyError
        With both numbers.
    """
    if wanted > available:
        raise BodyError(
            f"{file.path} has {available} shape parameters, but data.body.betas asks for {wanted}; "
            f"--set data.body.betas={available}"
        )


def turned(file: ModelFile, axes: Sequence[int]) -> ModelFile:
    """The same model in another frame, whose axis i is axis ``axes[i]`` of the old one (an even permutation).

    Rotations turn along, so the pose blend shapes' nine inputs of each joint are permuted by rows and by columns.
    """
    order = list(axes)
    features = np.arange(file.posedirs.shape[-1]).reshape(-1, 3, 3)[:, order][:, :, order].ravel()
    return replace(
        file,
        template=file.template[:, order],
        shapedirs=file.shapedirs[:, order],
        posedirs=file.posedirs[:, order][..., features],
    )


def _exact_beside(values: NDArray[np.float64], *, largest: float, steps: float, axis: int) -> NDArray[np.float64]:
    """Values rounded so that their products with numbers of the given steps sum exactly along ``axis``.

    ``largest`` bounds those numbers: no partial sum then exceeds ``largest`` times the sum of magnitudes.
    """
    bound = max(float(np.abs(values).sum(axis=axis).max()) * largest, 1.0)
    return _round(values, 2.0 ** (_MANTISSA - int(np.frexp(bound)[1])) / steps)


def _round(values: NDArray[np.float64], per_unit: float) -> NDArray[np.float64]:
    return np.round(values * per_unit) / per_unit
