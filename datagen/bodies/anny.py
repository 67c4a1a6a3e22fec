"""Anny (Bregier et al. 2025): phenotype-driven human body, code Apache-2.0, assets CC0, data inside its wheel.

Anny rests in an A-pose, Z up, facing -Y. Poses here are SMPL's (T-pose, Y up, facing +Z), so that one pose draws
alike on Anny and on the SMPL family: the vertices are first turned to SMPL's axes, and every arm joint carries a
fixed correction C that takes its A-pose bone to the T-pose: its world rotation is that of the SMPL joint times C.
"""

import contextlib
import importlib.metadata
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.assets import Asset
from datagen.bodies.skinning import Rest, skin
from datagen.errors import BodyError
from datagen.poses import JOINTS, Poses
from datagen.recipe import AnnyBody

_RIG = "mixamo"
_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # (x, y, z) -> (x, z, -y)
_SIDES = {"left": "Left", "right": "Right"}
_CENTRE = {"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head"}
_LIMBS = {
    "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase",
    "collar": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand",
}  # fmt: skip
_KNUCKLES = ("HandIndex1", "HandMiddle1", "HandRing1", "HandPinky1")


def rig_joints(joint: str) -> tuple[str, ...]:
    """Mixamo bones that carry the rotation of an SMPL joint; SMPL's hand joint bends the four fingers' roots."""
    if joint in _CENTRE:
        return (_CENTRE[joint],)
    side, part = joint.split("_")
    parts = _KNUCKLES if part == "hand" else (_LIMBS[part],)
    return tuple(_SIDES[side] + name for name in parts)


class AnnyModel:
    """See :class:`datagen.bodies.BodyModel`; frame: metres, Y up, facing +Z, +X to the body's left."""

    joints = JOINTS

    def __init__(self, recipe: AnnyBody) -> None:
        self._model = _load_anny(recipe.topology)
        self.parameter_names = tuple(self._model.phenotype_labels)
        self.assets = (Asset("anny", "code Apache-2.0, assets CC0-1.0", importlib.metadata.version("anny")),)
        self._ranges = [getattr(recipe.phenotypes, name) for name in self.parameter_names]
        self._faces = self._model.get_triangular_faces().numpy().astype(np.int32)
        self._weights = self._model.dense_vertex_bone_weights.numpy().astype(np.float64)
        self._parents = [int(parent) for parent in self._model.bone_parents]
        self._bones = [label.split(":")[-1] for label in self._model.bone_labels]
        smpl = {bone: joint for joint in JOINTS for bone in rig_joints(joint)}
        self._names = [smpl.get(bone) for bone in self._bones]
        self._correction = self._t_pose_corrections()

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """Phenotype parameters, uniform within the recipe's ranges."""
        return np.array([random.uniform(low, high) for low, high in self._ranges])

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3]; the same for all identities."""
        return self._faces

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32, feet and all where the body model puts them (no grounding)."""
        return skin(self._rest(parameters), self.world_rotations(poses))

    def world_rotations(self, poses: Poses) -> NDArray[np.float64]:
        """World rotations [pose, bone, 3, 3] of the rig's bones relative to their rest."""
        return poses.on(self._names, self._parents) @ self._correction

    def _rest(self, parameters: NDArray[np.float64]) -> Rest:
        import torch

        names = zip(self.parameter_names, parameters, strict=True)
        with torch.no_grad():
            coefficients = self._model.get_phenotype_blendshape_coefficients(
                **{name: torch.tensor([value], dtype=torch.float64) for name, value in names}
            )
            rest = self._model.get_rest_model(coefficients)
        vertices, joints = (rest[key][0].numpy() @ _TO_Y_UP.T for key in ("rest_vertices", "rest_bone_heads"))
        if not (np.isfinite(vertices).all() and np.isfinite(joints).all()):
            raise BodyError(f"Anny gave a body with non-finite coordinates for the phenotypes {parameters.tolist()}")
        return Rest(vertices, joints, self._weights, self._parents)

    def _t_pose_corrections(self) -> NDArray[np.float64]:
        """World rotations [bone, 3, 3] that take the template's A-pose arms to SMPL's T-pose; identity elsewhere."""
        joints = self._model.template_bone_heads.numpy() @ _TO_Y_UP.T
        corrections = np.tile(np.eye(3), (len(self._bones), 1, 1))
        for side, outward in (("Left", 1.0), ("Right", -1.0)):
            for bone, child in (("Arm", "ForeArm"), ("ForeArm", "Hand")):
                this, end = self._bones.index(side + bone), self._bones.index(side + child)
                inherited = corrections[self._parents[this]]
                direction = inherited @ (joints[end] - joints[this])
                turn = Rotation.align_vectors([[outward, 0.0, 0.0]], [direction])[0].as_matrix()
                self._give_to_subtree(corrections, this, turn @ inherited)
        return corrections

    def _give_to_subtree(self, corrections: NDArray[np.float64], root: int, value: NDArray[np.float64]) -> None:
        below = {root}
        for bone, parent in enumerate(self._parents):
            if parent in below:
                below.add(bone)
        corrections[sorted(below)] = value


def _load_anny(topology: str) -> Any:
    """Anny at rest, read from its cache, which the first use of a topology fills (about 30 s).

    Anny writes that cache in place. A lock keeps two workers from building at once, and a mark left by a build
    that was killed makes the next one start from nothing.
    """
    _silence_warp()
    with contextlib.redirect_stdout(io.StringIO()):
        import anny
        from anny.paths import get_anny_cache_path

        cache = Path(get_anny_cache_path())
        cache.mkdir(parents=True, exist_ok=True)
        with FileLock(cache / "dsffnet.lock"):
            mark = cache / "dsffnet-building"
            if mark.exists():
                _forget_since(cache, mark)
            mark.touch()
            try:
                model = anny.Anny(rig=_RIG, topology=topology, skinning_method="lbs")
            except Exception as error:
                raise BodyError(
                    f"Anny could not be loaded with topology {topology!r} (cache {cache}): {error}. "
                    f"If its cache is damaged, remove it and run the same command again: rm -r '{cache}'"
                ) from error
            mark.unlink()
    return model


def _silence_warp() -> None:
    """Warp, which Anny uses to make its coarser topologies, greets with its devices; where it is missing, so be it."""
    with contextlib.suppress(ImportError):
        import warp

        warp.config.quiet = True


def _forget_since(cache: Path, mark: Path) -> None:
    began = mark.stat().st_mtime
    for file in cache.rglob("*.safetensors"):
        if file.stat().st_mtime >= began:
            os.unlink(file)
