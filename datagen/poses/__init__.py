"""Poses over named joints, and where they come from.

A pose is one axis-angle vector (radians) for each joint of a named tree, relative to the joint's parent, in axes
aligned with the rest pose: for people SMPL's 24 joints, body at rest in a T-pose, Y up, facing +Z, +X to the body's
left. Bodies carry it over to their own joints by name (:meth:`Poses.on`), so that one pose draws alike on all of them.

To add a source: one module here that defines a class with the members of :class:`PoseSource`, its section in
:mod:`datagen.recipe`, and one line in ``SOURCES``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import import_module
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datagen.common.assets import Asset
from datagen.mesh.rig import driven, drivers_of, world_rotations
from datagen.poses.skeletons import JOINTS, PARENTS
from datagen.recipe import PoseRecipe

__all__ = ["JOINTS", "PARENTS", "SOURCES", "PoseSource", "Poses", "draw_poses", "load_poses"]


@dataclass(frozen=True)
class Poses:
    """Some poses: axis-angle ``rotations`` [pose, joint, 3] in radians over the tree of ``joints`` and ``parents``."""

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    rotations: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.rotations)

    def __getitem__(self, poses: slice) -> "Poses":
        some = Poses(self.joints, self.parents, self.rotations[poses])
        if "_world" in vars(self):  # worked out for all of them, so for these
            vars(some)["_world"] = self._world[poses]
        return some

    def world(self) -> NDArray[np.float64]:
        """Rotations [pose, joint, 3, 3] of the joints relative to rest, in world axes; kept, and shared by slices."""
        return self._world

    @cached_property
    def _world(self) -> NDArray[np.float64]:
        return world_rotations(self.rotations, self.parents)

    def on(self, names: Sequence[str | None], parents: Sequence[int]) -> NDArray[np.float64]:
        """World rotations [pose, joint, 3, 3] for another joint tree, whose joints are called ``names``.

        A joint whose name these poses do not have (or None) follows its parent; a root without one stays as it is.
        """
        return driven(self.world(), drivers_of(names, parents, self.joints))


class PoseSource(Protocol):
    """Where poses come from: pose number p is a function of the recipe, its assets and p alone."""

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    assets: tuple[Asset, ...]

    def draw(self, pose: int) -> NDArray[np.float64]:
        """Pose number ``pose``: axis-angle [joint, 3] in radians."""
        ...


SOURCES = {
    "npt": "datagen.poses.joint_ranges:NptSource",
    "anatomical": "datagen.poses.range_of_motion:AnatomicalSource",
    "ranges": "datagen.poses.joint_ranges:RangeSource",
    "found": "datagen.poses.pose_files:FoundSource",
    "clips": "datagen.poses.animation_clips:ClipSource",
    "amass": "datagen.poses.amass:AmassSource",
    "file": "datagen.poses.pose_files:FileSource",
}


def load_poses(recipe: PoseRecipe) -> PoseSource:
    """The pose source of a recipe, loaded once a process."""
    return _load(recipe.model_dump_json())


@lru_cache(maxsize=8)
def _load(recipe: str) -> PoseSource:
    parsed = PoseRecipe.model_validate_json(recipe)
    module, name = SOURCES[parsed.distribution.name].split(":")
    source: PoseSource = getattr(import_module(module), name)(parsed)
    return source


@lru_cache(maxsize=20_000)
def _drawn(recipe: str, pose: int) -> NDArray[np.float64]:
    """A pose, kept: every identity takes the same ones."""
    return _load(recipe).draw(pose)


def draw_poses(recipe: PoseRecipe, poses: NDArray[np.integer] | range) -> Poses:
    """The poses of the given numbers."""
    source = load_poses(recipe)
    key = recipe.model_dump_json()
    drawn = [_drawn(key, int(pose)) for pose in poses]
    return Poses(source.joints, source.parents, np.stack(drawn) if drawn else np.empty((0, len(source.joints), 3)))
