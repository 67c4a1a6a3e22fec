"""What the names of joints say: on which side they are, and which part of a body they belong to."""

import re
from collections.abc import Sequence

_WORD = r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+"
_SIDES = {"l": 1, "left": 1, "r": -1, "right": -1}
_FORE = {"arm", "forearm", "hand", "elbow", "wrist", "finger", "thumb", "index", "middle", "ring", "pinky", "wing"}
_GIRDLES = {"clavicle", "collar", "shoulder"}
_FORE |= _GIRDLES
_LIMB = _FORE | {"leg", "foot", "thigh", "calf", "shin", "knee", "ankle", "toe", "toes", "paw", "hoof", "hip"}
_HEAD = {"head", "jaw", "mouth", "eye", "horn", "antler", "tongue", "snout", "skull"}
_PLAIN = [("ears", {"ear", "ears"}), ("tail", {"tail"}), ("neck", {"neck"}), ("head", _HEAD)]


def words(name: str) -> list[str]:
    """Return the words of a name, in lower case: ``IKBackLeg.L`` -> ik, back, leg, l; ``lThigh`` -> l, thigh."""
    return [word.lower() for word in re.findall(_WORD, name)]


def side(name: str) -> int:
    """+1 for a joint of the left side, -1 for one of the right, 0 for neither."""
    return next((_SIDES[word] for word in words(name) if word in _SIDES), 0)


def pairs(names: Sequence[str]) -> list[tuple[int, int]]:
    """Numbers (left, right) of joints whose names differ in their side only."""
    at = {(_without_side(name), side(name)): number for number, name in enumerate(names)}
    return [(number, at[key, -1]) for (key, which), number in at.items() if which == 1 and (key, -1) in at]


def parts(names: Sequence[str], parents: Sequence[int]) -> list[str]:
    """Return the part of each joint: torso, neck, head, ears, forelimbs, hindlimbs or tail.

    It is what its name says, or else its parent's part; a root without a telling name is torso.
    The bone of a girdle lies inside of the torso, so that its joint counts as torso, although its name speaks of limbs.
    """
    found: list[str] = []
    for name, parent in zip(names, parents, strict=True):
        if parent >= 0 and found[parent] == "torso" and _girdle(name) and not _girdle(names[parent]):
            found.append("torso")
        else:
            found.append(part_in(name) or (found[parent] if parent >= 0 else "torso"))
    return found


def part_in(name: str) -> str | None:
    """Return the part that a joint's own name tells, if it does."""
    found = set(words(name))
    for part, words_of_part in _PLAIN:
        if found & words_of_part:
            return part
    if not found & _LIMB:
        return "torso" if found & {"spine", "torso", "chest", "pelvis", "hips", "back"} else None
    if found & {"back", "hind", "rear"}:
        return "hindlimbs"
    return "forelimbs" if found & (_FORE | {"front", "fore"}) else "hindlimbs"


def _girdle(name: str) -> bool:
    return bool(_GIRDLES.intersection(words(name)))


def _without_side(name: str) -> tuple[str, ...]:
    pieces = re.findall(_WORD + r"|\d+|[^A-Za-z\d]+", name)
    return tuple("*" if piece.lower() in _SIDES else piece for piece in pieces)
