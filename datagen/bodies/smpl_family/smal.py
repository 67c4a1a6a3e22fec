"""SMAL (Zuffi et al. 2017): animals of four legs in SMPL's layout, 33 to 35 joints, from files of the user's.

Its own frame has +X from tail to head, +Y to the animal's left and +Z up; it is turned to ours (Y up, facing +Z, +X
to the left) when the file is read, which only renames axes. Poses are over SMAL's joints, in our frame.

Without a data file, shape parameters are uniform within +- ``beta_range``, around the mean of all animals. With
SMAL's data file (``cluster_means`` [family, 41], ``cluster_cov``), identity i is of family i modulo their number: the
family's mean, plus deviations uniform within +- ``beta_range`` standard deviations of that family in every
parameter (the square root of its covariance's diagonal; without ``cluster_cov``, within +- ``beta_range``).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.skinning import rig_of
from datagen.bodies.smpl_family.blend_shapes import LayoutBody, require_betas, turned
from datagen.bodies.smpl_family.model_file import read_arrays, read_model
from datagen.bodies.smpl_family.model_search import FAMILIES, find_model
from datagen.common.assets import Asset, file_asset
from datagen.common.errors import BodyError
from datagen.mesh.rig import Rig, drivers_of
from datagen.poses import Poses
from datagen.poses.skeletons import SMAL_JOINTS
from datagen.recipe import SmalBody

NATIVE_AXES = (1, 2, 0)
"""Our axis i is this axis of SMAL's frame: +X is its +Y, +Y its +Z, +Z its +X."""

_LICENCE = f"SMAL licence of its publishers: non-commercial research only ({FAMILIES['smal'].website})"


class SmalModel:
    """See :class:`datagen.bodies.BodyModel`; frame: the model's unit (about metres), Y up, facing +Z, +X to the left.

    ``joints`` are all 35 of SMAL's names: of a model with 33, the ears' move nothing.
    """

    joints = SMAL_JOINTS

    def __init__(self, recipe: SmalBody) -> None:
        file = read_model(find_model(recipe.path, model="smal"))
        if not 33 <= len(file.parents) <= len(SMAL_JOINTS):
            raise BodyError(f"{file.path} has {len(file.parents)} joints, but SMAL has 33 to 35; is it another model?")
        require_betas(file, recipe.betas, file.shapedirs.shape[-1])
        self._names = SMAL_JOINTS[: len(file.parents)]
        self.assets: tuple[Asset, ...] = (file_asset(file.path, licence=file.note or _LICENCE, name="SMAL"),)
        self.parameter_names = tuple(f"beta{number}" for number in range(recipe.betas))
        self._means, self._ranges = np.zeros((1, recipe.betas)), np.full((1, recipe.betas), recipe.beta_range)
        if recipe.families is not None:
            data = Path(recipe.families)
            self._means, deviations = _families(data, recipe.betas)
            self._ranges = recipe.beta_range * deviations
            self.assets += (file_asset(data, licence=_LICENCE, name="SMAL families"),)
        reach = float((np.abs(self._means) + self._ranges).max())
        self._body = LayoutBody(turned(file, NATIVE_AXES), betas=recipe.betas, reach=reach)

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """Shape parameters [beta]: the mean of family ``identity`` modulo their number, and a uniform deviation."""
        family = identity % len(self._means)
        return self._means[family] + random.uniform(-1, 1, len(self.parameter_names)) * self._ranges[family]

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3]; the same for all identities."""
        return self._body.faces

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32, the root where the model puts it (no translation, no grounding)."""
        return self._body.vertices(parameters, poses.on(self._names, self._body.parents))

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig:
        """The model's joints; its pose blend shapes are no part of it."""
        drivers = drivers_of(self._names, self._body.parents, joints)
        return rig_of(self._body.rest(parameters), self._names, drivers)


def _families(path: Path, betas: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means and standard deviations [family, beta] of SMAL's families, from its data file."""
    arrays = read_arrays(path, ("cluster_means",), optional=("cluster_cov",), what="SMAL's data file")
    means = np.asarray(arrays["cluster_means"], np.float64)
    if means.ndim != 2 or means.shape[1] < betas or not np.isfinite(means).all():
        raise BodyError(
            f"{path}: 'cluster_means' has the shape {list(means.shape)}, but finite numbers [families, {betas} or more]"
            f" are needed; --set data.body.betas={means.shape[-1] if means.ndim else 1} asks for less"
        )
    deviations = np.ones_like(means)
    if "cluster_cov" in arrays:
        covariances = np.asarray(arrays["cluster_cov"], np.float64)
        if covariances.shape != (*means.shape, means.shape[1]) or not np.isfinite(covariances).all():
            raise BodyError(
                f"{path}: 'cluster_cov' has the shape {list(covariances.shape)}, not one covariance for each family"
            )
        deviations = np.sqrt(np.clip(np.diagonal(covariances, axis1=1, axis2=2), 0, None))
    return means[:, :betas], deviations[:, :betas]
