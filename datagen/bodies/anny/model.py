"""Anny (Bregier et al. 2025): phenotype-driven human body, code Apache-2.0, assets CC0, data inside its wheel.

Anny rests in an A-pose, Z up, facing -Y. Poses here are SMPL's (T-pose, Y up, facing +Z), so that one pose draws
alike on all of Anny's rigs and on the SMPL family: points at rest are first turned to SMPL's axes, and every arm bone
carries a fixed correction C that takes its A-pose to the T-pose: its world rotation is that of the SMPL joint times C.
"""

import contextlib
import importlib.metadata
import io
import os
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from filelock import FileLock
from numpy.typing import NDArray

from datagen.bodies.anny.identities import Population, draw_local_changes, draw_uniform
from datagen.bodies.anny.rigs import Bones, t_pose_corrections
from datagen.bodies.anny.shape import AnnyShape
from datagen.bodies.skinning import Rest, remembering, rig_of, skin
from datagen.common.assets import Asset
from datagen.common.errors import BodyError
from datagen.mesh.rig import Rig, drivers_of, part_transforms
from datagen.poses import JOINTS, Poses
from datagen.recipe import AnnyBody


class AnnyModel:
    """See :class:`datagen.bodies.BodyModel`; frame: metres, Y up, facing +Z, +X to the body's left.

    Parameters are Anny's phenotypes, followed by its local changes as ``local.NAME`` where the recipe asks for any.
    ``bones`` are the rig's; ``corrections`` [bone, 3, 3] turn them from its rest to the T-pose, in world axes.
    """

    joints = JOINTS

    def __init__(self, recipe: AnnyBody) -> None:
        model = _load_anny(recipe)
        self._recipe = recipe
        self._shape = AnnyShape(model)
        self._population = Population(model) if recipe.ages == "population" else None
        self.parameter_names = (
            *self._shape.phenotypes,
            *(f"local.{label}" for label in self._shape.local_changes),
        )
        self.assets = _assets(recipe)
        self._faces = model.get_triangular_faces().numpy().astype(np.int32)
        self.bones = Bones.of(recipe.rig, model.bone_labels, model.bone_parents)
        weights = model.dense_vertex_bone_weights.numpy().astype(np.float64)
        self._weights = scipy.sparse.csr_array(weights[:, self.bones.order])
        heads = model.template_bone_heads.numpy()[self.bones.order]
        self.corrections = t_pose_corrections(self.bones, _y_up(heads))
        self._shared_rig = lru_cache(maxsize=4)(self._rig_but_joints)
        self.rest = remembering(self._rest)

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """Phenotypes as the recipe's ``ages`` says, within its ranges, then local changes."""
        ranges, names = self._recipe.phenotypes, self._shape.phenotypes
        if self._population:
            phenotypes = self._population.draw(random, ranges, names)
        else:
            phenotypes = draw_uniform(random, ranges, names)
        local = draw_local_changes(random, self._shape.local_changes, self._recipe.local_changes)
        return np.concatenate([phenotypes, local])

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3]; the same for all identities."""
        return self._faces

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32, feet and all where the body model puts them (no grounding)."""
        return skin(self.rest(parameters), self.world_rotations(poses))

    def world_rotations(self, poses: Poses) -> NDArray[np.float64]:
        """World rotations [pose, bone, 3, 3] of the rig's bones relative to their rest."""
        return poses.on(self.bones.joints, self.bones.parents) @ self.corrections

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig:
        """The bones that carry a pose joint; twist bones, metacarpals and the like are folded into these."""
        shared, kept = self._shared_rig(joints)
        heads = _y_up(self._shape.heads(tuple(parameters.tolist())))[self.bones.order]
        return replace(shared, joints=heads[kept].astype(np.float32))

    def _rig_but_joints(self, joints: tuple[str, ...]) -> tuple[Rig, list[int]]:
        """What the rigs of all identities share, and the bones whose heads are its joints."""
        drivers = drivers_of(self.bones.joints, self.bones.parents, joints)
        rest = Rest(np.empty((0, 3)), np.zeros((len(drivers), 3)), self._weights, self.bones.parents)
        rig = rig_of(rest, self.bones.labels, drivers, self.corrections)
        return rig, [self.bones.labels.index(name) for name in rig.names]

    def t_pose(self, parameters: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Vertices [vertex, 3] and bone heads [bone, 3] in SMPL's T-pose, which is no pose of the rig's own."""
        rest = self.rest(parameters)
        transforms = part_transforms(self.corrections, rest.joints, rest.parents)
        heads = (transforms[..., :3] @ rest.joints[..., None])[..., 0] + transforms[..., 3]
        return skin(rest, self.corrections[None])[0].astype(np.float64), heads

    def _rest(self, parameters: NDArray[np.float64]) -> Rest:
        """The identity in Anny's A-pose, bones as joints."""
        points = _y_up(self._shape.points(tuple(parameters.tolist())))
        if not np.isfinite(points).all():
            raise BodyError(f"Anny gave a body with non-finite coordinates for the parameters {parameters.tolist()}")
        count = self._weights.shape[0]
        return Rest(points[:count], points[count:][self.bones.order], self._weights, self.bones.parents)


def _y_up(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(x, y, z) -> (x, z, -y): from Anny's axes to SMPL's."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def _assets(recipe: AnnyBody) -> tuple[Asset, ...]:
    version = importlib.metadata.version("anny")
    anny = Asset("anny", "code Apache-2.0, assets CC0-1.0", version)
    soma = Asset("SOMA-X mesh and rig in anny", "Apache-2.0", version)
    return (anny, soma) if "soma" in (recipe.topology, recipe.rig) else (anny,)


def _load_anny(recipe: AnnyBody) -> Any:
    """Anny at rest, read from its cache, which the first use of a topology or rig fills (about 10 s).

    Its blend shapes are taken as they come ("original"): compacted ones depend on the threads that compacted them.
    """
    with contextlib.suppress(ImportError):
        import datagen.common.quiet_warp  # noqa: F401  by which Anny makes its coarser topologies
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's, about sparse tensors in Anny
        import anny
        from anny.paths import get_anny_cache_path

        from datagen.bodies.anny.first_load import read_in_bulk  # it brings torch, which the command line waits with

        cache = Path(get_anny_cache_path())
        try:
            with _alone_with_whole_files(cache), read_in_bulk():
                return anny.Anny(
                    rig=recipe.rig,
                    topology=recipe.topology,
                    local_changes="default" if recipe.local_changes else "none",
                    skinning_method="lbs",
                    phenotype_blendshapes="original",
                )
        except Exception as error:  # whatever its parsers, its cache or the disk raise
            raise BodyError(
                f"Anny could not be loaded with topology {recipe.topology!r} and rig {recipe.rig!r} (cache {cache}): "
                f"{error}. If its cache is damaged, remove it and run the same command again: rm -r '{cache}'"
            ) from error


@contextlib.contextmanager
def _alone_with_whole_files(cache: Path) -> Iterator[None]:
    """Keep other processes from Anny's cache, and remove what a build that never ended left there.

    Anny writes its cache in place. A lock keeps two workers from building at once, and a mark left by a build
    that failed or was killed makes the next one start from what was there before it.
    """
    cache.mkdir(parents=True, exist_ok=True)
    with FileLock(cache / "dsffnet.lock"):
        mark = cache / "dsffnet-building"
        if mark.exists():
            _forget_since(cache, mark)
        mark.touch()
        yield
        mark.unlink()


def _forget_since(cache: Path, mark: Path) -> None:
    began = mark.stat().st_mtime
    for file in cache.rglob("*.safetensors"):
        if file.stat().st_mtime >= began:
            os.unlink(file)
