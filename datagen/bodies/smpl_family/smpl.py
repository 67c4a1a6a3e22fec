"""SMPL, SMPL-H and SMPL-X (Loper et al. 2015, Romero et al. 2017, Pavlakos et al. 2019) from files of the user's.

All three rest in a T-pose, Y up, facing +Z, +X to the body's left, which is our frame. A pose over SMPL's 24 joints
drives the joints that share a name; SMPL's ``left_hand`` and ``right_hand``, which SMPL-H and SMPL-X lack, bend the
roots of their four fingers, as on Anny. Hands are flat, faces neutral, unless the poses name their joints.
"""

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.skinning import rig_of
from datagen.bodies.smpl_family.blend_shapes import LayoutBody, require_betas
from datagen.bodies.smpl_family.model_file import ModelFile, read_model
from datagen.bodies.smpl_family.model_search import FAMILIES, find_model
from datagen.common.assets import Asset, file_asset
from datagen.common.errors import BodyError
from datagen.mesh.rig import Rig, drivers_of
from datagen.poses import JOINTS, Poses
from datagen.recipe import SmplBody

_LICENCE = "{title} licence of its publishers: non-commercial research only ({website})"
_KNUCKLES = ("index1", "middle1", "ring1", "pinky1")


def joint_names(model: str) -> tuple[str, ...]:
    """Names of a model's own joints in its order: 24 of smpl, 52 of smplh, 55 of smplx (as the package smplx has)."""
    from smplx import joint_names as named  # type: ignore[import-untyped,unused-ignore]

    return {
        "smpl": JOINTS,
        "smplh": tuple(named.SMPLH_JOINT_NAMES[:52]),
        "smplx": tuple(named.JOINT_NAMES[:55]),
    }[model]


class SmplModel:
    """See :class:`datagen.bodies.BodyModel`; frame: metres, Y up, facing +Z, +X to the body's left."""

    def __init__(self, recipe: SmplBody) -> None:
        file = read_model(find_model(recipe.path, model=recipe.model, gender=recipe.gender))
        self._names = joint_names(recipe.model)
        _require_joints(file, recipe.model, len(self._names))
        require_betas(file, recipe.betas, shape_parameters(file, recipe.model))
        family = FAMILIES[recipe.model]
        licence = file.note or _LICENCE.format(title=family.title, website=family.website)
        name = f"{family.title} {recipe.gender}"
        self.assets: tuple[Asset, ...] = (file_asset(file.path, licence=licence, name=name),)
        self.joints = (*JOINTS, *(name for name in self._names if name not in JOINTS))
        self.parameter_names = tuple(f"beta{number}" for number in range(recipe.betas))
        self._range = recipe.beta_range
        self._body = LayoutBody(file, betas=recipe.betas, reach=recipe.beta_range)

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """Shape parameters [beta], uniform within the recipe's range (NPT's data_generation.py: +-4)."""
        return random.uniform(-self._range, self._range, len(self.parameter_names))

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3]; the same for all identities."""
        return self._body.faces

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32, the pelvis where the model puts it (no translation, no grounding)."""
        return self._body.vertices(parameters, poses.on(_driven_by(self._names, poses.joints), self._body.parents))

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig:
        """The model's joints; its pose blend shapes are no part of it."""
        drivers = drivers_of(_driven_by(self._names, joints), self._body.parents, joints)
        return rig_of(self._body.rest(parameters), self._names, drivers)


def shape_parameters(file: ModelFile, model: str) -> int:
    """How many of a file's shape directions are of the body: SMPL-X files add facial expressions after them.

    Its files have 300 + 100 directions, or 10 + 10 in the older ones (the package smplx splits them likewise).
    """
    directions = file.shapedirs.shape[-1]
    if model != "smplx":
        return directions
    return min(directions, 300 if directions >= 400 else 10)


def _driven_by(names: tuple[str, ...], joints: tuple[str, ...]) -> list[str]:
    """The pose joint that each joint obeys: its own, or the hand's for a knuckle that the poses do not name."""
    drivers = []
    for name in names:
        side, _, part = name.partition("_")
        borrowed = part in _KNUCKLES and name not in joints
        drivers.append(f"{side}_hand" if borrowed else name)
    return drivers


def _require_joints(file: ModelFile, model: str, expected: int) -> None:
    if len(file.parents) != expected:
        kinds = {24: "smpl", 52: "smplh", 55: "smplx"}
        found = len(file.parents)
        hint = f"; --set data.body.model={kinds[found]}" if found in kinds else ""
        raise BodyError(f"{file.path} has {found} joints, but {FAMILIES[model].title} has {expected}{hint}")
