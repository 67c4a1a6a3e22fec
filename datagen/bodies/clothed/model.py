"""People of Anny in clothes: the skin that shows, then the parts of an outfit, draped over the person in every pose."""

import importlib.metadata
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from datagen.bodies import load_body
from datagen.bodies.anny.model import AnnyModel
from datagen.bodies.clothed.figure import BODY_VERTICES, Figure, helper_quads
from datagen.bodies.clothed.fitting import FittedGarment, Wearer, fit
from datagen.bodies.clothed.garments import Garment, Part, covered, garment_of
from datagen.bodies.skinning import Rest, rig_of, skin
from datagen.common.assets import Asset, file_asset
from datagen.mesh.geometry import triangles_of
from datagen.mesh.rig import Rig, drivers_of, part_transforms
from datagen.poses import JOINTS, PARENTS, Poses
from datagen.recipe import AnnyBody, ClothedBody, GarmentFile

DRAPING = Asset("outfits and draping", "Apache-2.0", "7")
"""To get another version with any change of outfits, cuts or draping that changes bytes: data must not mix."""
_GRID = 2.0**20


def _postures() -> Poses:
    """What patterns have room for: the T-pose, arms raised, sitting."""
    degrees = np.zeros((3, len(JOINTS), 3))
    for side, sign in (("left", 1), ("right", -1)):
        degrees[1, JOINTS.index(f"{side}_shoulder"), 2] = 60 * sign
        degrees[2, [JOINTS.index(f"{side}_hip"), JOINTS.index(f"{side}_knee")], 0] = -80, 80
    return Poses(JOINTS, PARENTS, np.radians(degrees))


_POSTURES = _postures()


@dataclass(frozen=True, eq=False)
class Person:
    """A dressed identity at rest: the skin that is kept and its faces, the body that cloth touches, and the garment."""

    skin: Rest
    skin_faces: NDArray[np.int64]
    body: Rest
    garment: Garment

    @cached_property
    def cloth(self) -> Any:
        """The garment ready to be draped, made when asked for: it needs Warp."""
        from datagen.bodies.clothed.draping import Cloth

        return Cloth(self.garment, self.body, body_faces())


class ClothedModel:
    """See :class:`datagen.bodies.BodyModel`; frame: metres, Y up, facing +Z, +X to the body's left.

    Parameters are Anny's, the outfit's number, and how many times its own ease it has.
    """

    def __init__(self, recipe: ClothedBody) -> None:
        self._recipe = recipe
        self._shown, self._whole = _anny(recipe.body), _anny(recipe.body.model_copy(update={"topology": "makehuman"}))
        self.parameter_names = (*self._shown.parameter_names, "outfit", "ease")
        self.joints = self._shown.joints
        warp = Asset("warp-lang", "Apache-2.0", importlib.metadata.version("warp-lang"))
        self._outfits = [self._fitted(number) for number in range(len(recipe.outfits))]
        files = (part for outfit in self._outfits for part in outfit if isinstance(part, FittedGarment))
        worn = (
            file_asset(Path(its.recipe.path), licence="as the file's owner states", name=its.where) for its in files
        )
        self.assets = (*self._shown.assets, warp, DRAPING, *worn)
        joints = self._whole.bones.joints
        self._joints = {joint: joints.index(joint) for joint in joints if joint}
        self.person = lru_cache(maxsize=4)(self._person)

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """Anny's draws, outfit ``identity`` modulo their number, and ease uniform in the recipe's range."""
        own = self._shown.draw_identity(random, identity)
        return np.array([*own, identity % len(self._recipe.outfits), random.uniform(*self._recipe.ease)])

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3] of that identity: skin first."""
        person = self.person(tuple(parameters.tolist()))
        garment = person.garment.shown_faces + len(person.skin.vertices)
        return np.concatenate([person.skin_faces, garment]).astype(np.int32)

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32; each pose is draped from the T-pose, alone."""
        person = self.person(tuple(parameters.tolist()))
        world, garment = self._whole.world_rotations(poses), person.garment
        if self._recipe.method == "skinned":
            dressed = skin(garment.rest, world)
        else:
            dressed = np.stack([self._draped(person, poses, pose) for pose in range(len(poses))])
        return np.concatenate([skin(person.skin, world), dressed[:, garment.shown]], axis=1)

    def world_rotations(self, poses: Poses) -> NDArray[np.float64]:
        """World rotations [pose, bone, 3, 3] of Anny's bones relative to their rest."""
        return self._whole.world_rotations(poses)

    def _draped(self, person: Person, poses: Poses, pose: int) -> NDArray[np.float32]:
        from datagen.bodies.clothed.draping import Path

        time = np.arange(self._recipe.solver.frames + 1) / self._recipe.solver.frames
        turned = (time * time * (3 - 2 * time))[:, None, None] * poses.rotations[pose]
        world = self._whole.world_rotations(Poses(poses.joints, poses.parents, turned))
        world = np.round(world * _GRID) / _GRID
        transforms = part_transforms(world, person.body.joints, person.body.parents)
        begun = skin(person.garment.rest, world[:1])[0]
        path = Path(skin(person.body, world), np.round(transforms * _GRID) / _GRID, begun)
        draped: NDArray[np.float32] = person.cloth.drape(path, self._recipe.solver)
        return draped

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig:
        """Anny's bones; garments have the weights of the skin below them, which is all that ``skinned`` ones follow."""
        person, bones = self.person(tuple(parameters.tolist())), self._whole.bones
        weights = [person.skin.weights, scipy.sparse.csr_array(person.garment.rest.weights)[person.garment.shown]]
        rest = Rest(np.empty((0, 3)), person.skin.joints, scipy.sparse.vstack(weights).tocsr(), bones.parents)
        drivers = drivers_of(bones.joints, bones.parents, joints)
        return rig_of(rest, bones.labels, drivers, self._whole.corrections)

    def undressed(
        self, parameters: NDArray[np.float64], joints: tuple[str, ...]
    ) -> tuple[Rig, NDArray[np.float64], NDArray[np.int64]]:
        """The whole body below the clothes: its rig, vertices [v, 3] at Anny's rest, and triangles [f, 3]."""
        body, bones = self.person(tuple(parameters.tolist())).body, self._whole.bones
        drivers = drivers_of(bones.joints, bones.parents, joints)
        return rig_of(body, bones.labels, drivers, self._whole.corrections), body.vertices, body_faces()

    def part_labels(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """What each vertex [vertex] belongs to: 0 skin, from 1 on the parts of the outfit, innermost first."""
        person = self.person(tuple(parameters.tolist()))
        garment = person.garment.part[person.garment.shown]
        return np.concatenate([np.zeros(len(person.skin.vertices)), garment]).astype(np.int32)

    def _fitted(self, outfit: int) -> tuple[Part, ...]:
        """The parts of an outfit, its files read and fitted to the person that they were made for."""
        subdivide, name = self._recipe.solver.subdivide, self._recipe.outfits[outfit]
        return tuple(
            fit(part, self._wearer(part), where=f"part {number} of the outfit {name!r}", most_subdivided=subdivide)
            if isinstance(part, GarmentFile) else part
            for number, part in enumerate(self._recipe.outfit(outfit), 1)
        )  # fmt: skip

    def _wearer(self, part: GarmentFile) -> Wearer:
        told = part.fits.model_dump()
        phenotypes = np.array([told.get(name, 0.0) for name in self._shown.parameter_names])
        return Wearer(self._whole.rest(phenotypes), self._whole.corrections, self._shown.t_pose(phenotypes)[0])

    def _person(self, parameters: tuple[float, ...]) -> Person:
        *own, outfit, ease = parameters
        whole, shown = (model.rest(np.array(own)) for model in (self._whole, self._shown))
        parts, solver = self._outfits[int(outfit)], self._recipe.solver
        garment = garment_of(
            Figure(whole, self._joints), parts, ease=ease, subdivide=solver.subdivide, detail=self._recipe.detail
        )
        body = _some(whole, np.arange(BODY_VERTICES))
        from datagen.bodies.clothed.draping import outside, require_outside

        if self._recipe.method == "draped":
            require_outside(garment, body, body_faces(), name=f"the outfit {self._recipe.outfits[int(outfit)]!r}")
        garment = outside(garment, body, body_faces())
        postures = tuple(skin(garment.rest, self._whole.world_rotations(_POSTURES)))
        faces = self._shown.faces(np.array(own))
        seen = faces[~covered(Figure(shown, self._joints), parts)[faces].all(axis=1)]
        used, renumbered = np.unique(seen.astype(np.int64), return_inverse=True)
        return Person(_some(shown, used), renumbered.reshape(-1, 3), body, replace(garment, postures=postures))


def _anny(recipe: AnnyBody) -> AnnyModel:
    body = load_body(recipe)
    assert isinstance(body, AnnyModel)
    return body


def _some(rest: Rest, vertices: NDArray[np.int64]) -> Rest:
    return Rest(rest.vertices[vertices], rest.joints, scipy.sparse.csr_array(rest.weights)[vertices], rest.parents)


@lru_cache(maxsize=1)
def body_faces() -> NDArray[np.int64]:
    """Triangles [face, 3] of MakeHuman's body."""
    return triangles_of(helper_quads()["body"])
