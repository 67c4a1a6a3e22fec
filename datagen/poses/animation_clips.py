"""Poses from the animation clips of rigged glTF characters: moments of what an animator made.

A joint's rotation is taken relative to its own character's bind pose, in world axes, and handed on by joint name: a
wolf's gallop turns a cow's thigh by the angles that it turns the wolf's. Translations are left out: limbs hang on the
body, and where the body is does not matter to a mesh that is normalised to its box.
"""

from collections.abc import Sequence
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.characters.character import Character, load_characters, shared_joints
from datagen.common.errors import RecipeError
from datagen.common.seeding import Stream, generator
from datagen.recipe import ClipPoses, PoseRecipe

Choice = tuple[Character, str]
_STEPS = 2.0**30  # in a radian: coarser than what one CPU's arithmetic differs from another's


class ClipSource:
    """See :class:`datagen.poses.PoseSource`: moments of clips, over the joints that all of the characters share."""

    def __init__(self, recipe: PoseRecipe) -> None:
        wanted = recipe.distribution
        assert isinstance(wanted, ClipPoses)
        characters = load_characters(wanted.path, wanted.characters)
        self.joints, self.parents = shared_joints(characters)
        self.assets = tuple(dict.fromkeys(asset for character in characters for asset in character.assets))
        self._seed, self._seen, self._jitter = recipe.seed, recipe.seen, np.radians(wanted.jitter)
        chosen = _matching(_all_clips(characters), wanted.clips or ("*",), "clips")
        held_out = _matching(chosen, wanted.held_out, "held_out")
        self._for_seen = [choice for choice in chosen if choice not in held_out]
        self._for_unseen = held_out or chosen
        if not self._for_seen:
            raise RecipeError("data.poses.distribution.held_out leaves no clip for the seen poses. Hold out fewer")

    def draw(self, pose: int) -> NDArray[np.float64]:
        """Axis-angle [joint, 3] in radians: clip uniform among those allowed, moment uniform within it, then jitter."""
        random = generator(self._seed, Stream.POSE, pose)
        allowed = self._for_seen if pose < self._seen else self._for_unseen
        character, name = allowed[random.integers(len(allowed))]
        clip = character.clips[name]
        turns = self.at(character, name, random.uniform(clip.start, clip.end))
        if self._jitter:
            jitter = Rotation.from_rotvec(random.uniform(-self._jitter, self._jitter, turns.shape))
            turns = (Rotation.from_rotvec(turns) * jitter).as_rotvec()
        return np.round(turns * _STEPS) / _STEPS

    def at(self, character: Character, clip: str, time: float) -> NDArray[np.float64]:
        """Axis-angle [joint, 3] in radians, relative to the parent, of a character at a moment of a clip (seconds)."""
        moment = character.pose(clip, time)
        world = np.stack([moment[character.names.index(joint)] for joint in self.joints])
        relative = world.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                relative[joint] = world[parent].T @ world[joint]
        return Rotation.from_matrix(relative).as_rotvec()


def shared_skeleton(path: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names and parents of the joints that all characters of a folder (or: animals) share."""
    return shared_joints(load_characters(path))


def _all_clips(characters: Sequence[Character]) -> list[Choice]:
    found = [(character, clip) for character in characters for clip in character.clips]
    if not found:
        raise RecipeError(
            f"{' and '.join(str(each.path) for each in characters)}: no animation clips. Choose other poses: "
            "--set data.poses.distribution.name=ranges"
        )
    return found


def _matching(choices: list[Choice], patterns: Sequence[str], field: str) -> list[Choice]:
    """Choices whose clip matches one of the patterns, whatever their case: files differ in it."""
    for pattern in patterns:
        if not any(_fits(clip, pattern) for _, clip in choices):
            known = ", ".join(sorted({clip for _, clip in choices}))
            raise RecipeError(f"data.poses.distribution.{field}: no clip is called {pattern!r}; there are {known}")
    return [choice for choice in choices if any(_fits(choice[1], pattern) for pattern in patterns)]


def _fits(clip: str, pattern: str) -> bool:
    return fnmatchcase(clip.lower(), pattern.lower())
