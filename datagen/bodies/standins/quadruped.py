"""A procedural animal on SMAL's skeleton: the licence-free material of SMAL's stand-in.

Tapered capsules along the bones of a skeleton melt into one closed surface. Other animals of the same mesh come from
drawing the length and the thickness of every bone: each vertex follows its bones, stretched along and across.

Frame: SMAL's own, +X from tail to head, +Y to the left, +Z up, metres; the origin lies in the middle of the trunk.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.standins.fit import on_grid
from datagen.mesh.surface_nets import surface_nets
from datagen.poses.skeletons import SMAL_JOINTS, SMAL_PARENTS

_SPINE = {
    "root": (-0.40, 0, 0.02), "pelvis0": (-0.32, 0, 0.03), "spine": (-0.20, 0, 0.03), "spine0": (-0.08, 0, 0.02),
    "spine1": (0.04, 0, 0.01), "spine2": (0.15, 0, 0.00), "spine3": (0.26, 0, 0.00), "Neck": (0.38, 0, 0.08),
    "Head": (0.58, 0, 0.30), "Mouth": (0.63, 0, 0.245),
    "Tail1": (-0.48, 0, 0.07), "Tail2": (-0.545, 0, 0.045), "Tail3": (-0.60, 0, 0.00), "Tail4": (-0.64, 0, -0.055),
    "Tail5": (-0.67, 0, -0.115), "Tail6": (-0.69, 0, -0.175), "Tail7": (-0.705, 0, -0.235),
}  # fmt: skip
_LEFT = {
    "LLeg1": (0.28, 0.10, -0.06), "LLeg2": (0.24, 0.105, -0.21), "LLeg3": (0.265, 0.105, -0.40),
    "LFoot": (0.265, 0.105, -0.545),
    "LLegBack1": (-0.38, 0.085, -0.04), "LLegBack2": (-0.32, 0.10, -0.21), "LLegBack3": (-0.44, 0.10, -0.38),
    "LFootBack": (-0.42, 0.10, -0.545), "LEar": (0.565, 0.05, 0.365),
}  # fmt: skip
_TIPS = {
    "Tail7": (-0.715, 0, -0.295), "Head": (0.81, 0, 0.225), "Mouth": (0.775, 0, 0.175), "LEar": (0.55, 0.078, 0.455),
    "LFoot": (0.325, 0.105, -0.57), "LFootBack": (-0.36, 0.10, -0.57),
}  # fmt: skip
_RADII = {
    "root": (0.125, 0.13), "pelvis0": (0.13, 0.125), "spine": (0.125, 0.125), "spine0": (0.125, 0.135),
    "spine1": (0.135, 0.145), "spine2": (0.145, 0.145), "spine3": (0.14, 0.10), "Neck": (0.10, 0.065),
    "Head": (0.078, 0.040), "Mouth": (0.040, 0.024), "LEar": (0.030, 0.018),
    "LLeg1": (0.068, 0.048), "LLeg2": (0.045, 0.028), "LLeg3": (0.028, 0.024), "LFoot": (0.030, 0.026),
    "LLegBack1": (0.085, 0.058), "LLegBack2": (0.056, 0.028), "LLegBack3": (0.028, 0.024), "LFootBack": (0.030, 0.026),
    "Tail1": (0.030, 0.028), "Tail2": (0.028, 0.026), "Tail3": (0.026, 0.024), "Tail4": (0.024, 0.022),
    "Tail5": (0.022, 0.020), "Tail6": (0.020, 0.018), "Tail7": (0.018, 0.014),
}  # fmt: skip
"""Radius of each bone at its joint and at its end, in metres; the right side mirrors the left."""

_ALONG = {"root": "pelvis0", "spine3": "Neck", "Neck": "Head"}  # where a joint with several children points
_CELL, _MELT, _SOFTNESS, _FAINTEST = 0.023, 0.012, 0.02, 0.02
_REGIONS = {
    "trunk": ("root", "pelvis0", "spine", "spine0", "spine1", "spine2", "spine3"),
    "legs": ("Leg1", "Leg2", "Leg3", "Foot", "LegBack1", "LegBack2", "LegBack3", "FootBack"),
    "neck": ("Neck",),
    "head": ("Head", "Mouth"),
    "tail": tuple(f"Tail{number}" for number in range(1, 8)),
    "ears": ("Ear",),
}
_SPREAD = {"trunk": 0.12, "legs": 0.20, "neck": 0.20, "head": 0.14, "tail": 0.25, "ears": 0.25}
_OWN_SPREAD = 0.05
"""Standard deviations of the logarithm of lengths and thicknesses: of a region's bones together, and of each."""


@dataclass(frozen=True)
class Quadruped:
    """The animal as it was modelled: a closed mesh, joints [35, 3], tips of the bones [35, 3], weights [vertex, 35]."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    joints: NDArray[np.float64]
    ends: NDArray[np.float64]
    weights: NDArray[np.float64]
    parents: tuple[int, ...] = SMAL_PARENTS

    def drawn(self, random: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Another animal: vertices [vertex, 3] and joints [35, 3], with lengths and thicknesses drawn at random."""
        lengths, thicknesses = _drawn_scales(random), _drawn_scales(random)
        joints = self.joints.copy()
        for joint, parent in enumerate(self.parents[1:], start=1):
            joints[joint] = joints[parent] + lengths[parent] * (self.joints[joint] - self.joints[parent])
        along = self.ends - self.joints
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        stretch = (lengths - thicknesses)[:, None, None] * along[:, :, None] * along[:, None, :]
        stretch += thicknesses[:, None, None] * np.eye(3)
        matrices = np.einsum("vk,kij->vij", self.weights, stretch)
        offsets = self.weights @ (joints - np.einsum("kij,kj->ki", stretch, self.joints))
        return np.einsum("vij,vj->vi", matrices, self.vertices) + offsets, joints


@cache
def quadruped() -> Quadruped:
    """The animal, made once a process (under a second)."""
    joints, ends, radii = _skeleton()
    low, high = joints.min(axis=0) - 0.25, joints.max(axis=0) + 0.25
    high[1] = _CELL * np.ceil(high[1] / _CELL)
    low[1] = -high[1]  # the grid is its own mirror image
    axes = [np.arange(first, last + _CELL / 2, _CELL) for first, last in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = _field(points.reshape(-1, 3), joints, ends, radii).reshape(points.shape[:3])
    cells, faces = surface_nets(field)
    vertices = on_grid(_onto_surface(low + cells * _CELL, joints, ends, radii), 2.0**20)
    return Quadruped(vertices, faces, joints, ends, _weights(vertices, joints, ends, radii))


def _skeleton() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Joints [35, 3], ends of their bones [35, 3], radii [35, 2]."""
    places, tips = _mirrored(_SPINE | _LEFT), _mirrored(_TIPS)
    radii = _RADII | {"R" + name[1:]: _RADII[name] for name in _LEFT}
    joints = np.array([places[name] for name in SMAL_JOINTS], np.float64)
    ends = np.array([tips[name] if name in tips else places[_next(name)] for name in SMAL_JOINTS], np.float64)
    return joints, ends, np.array([radii[name] for name in SMAL_JOINTS])


def _mirrored(places: dict[str, tuple[float, float, float]]) -> dict[str, tuple[float, float, float]]:
    left = [name for name in places if name in _LEFT]
    return places | {"R" + name[1:]: (places[name][0], -places[name][1], places[name][2]) for name in left}


def _next(name: str) -> str:
    children = [child for child, parent in zip(SMAL_JOINTS, SMAL_PARENTS, strict=True) if SMAL_JOINTS[parent] == name]
    return _ALONG.get(name) or next(child for child in children if child != name)


def _distances(
    points: NDArray[np.float64], joints: NDArray[np.float64], ends: NDArray[np.float64], radii: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Signed distances [point, bone] from tapered capsules."""
    found = np.empty((len(points), len(joints)))
    for bone, (start, end, (first, last)) in enumerate(zip(joints, ends, radii, strict=True)):
        axis = end - start
        along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
        apart = np.linalg.norm(points - start - along[:, None] * axis, axis=1)
        found[:, bone] = apart - first - along * (last - first)
    return found


def _field(
    points: NDArray[np.float64], joints: NDArray[np.float64], ends: NDArray[np.float64], radii: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The capsules' smooth union: a soft minimum of their distances."""
    distances = _distances(points, joints, ends, radii)
    nearest = distances.min(axis=1)
    return nearest - _MELT * np.log(np.exp((nearest[:, None] - distances) / _MELT).sum(axis=1))


def _onto_surface(points: NDArray[np.float64], *skeleton: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points moved along the field's gradient until it vanishes."""
    step = 1e-4
    for _ in range(4):
        value = _field(points, *skeleton)
        gradient = np.stack([(_field(points + step * axis, *skeleton) - value) / step for axis in np.eye(3)], axis=1)
        points = points - (value / np.maximum((gradient**2).sum(axis=1), 0.25))[:, None] * gradient
    return points


def _weights(vertices: NDArray[np.float64], *skeleton: NDArray[np.float64]) -> NDArray[np.float64]:
    """Skinning weights [vertex, bone] that fade with the distance from the bones' capsules."""
    distances = _distances(vertices, *skeleton)
    weights = np.exp((distances.min(axis=1, keepdims=True) - distances) / _SOFTNESS)
    weights = on_grid(np.where(weights < _FAINTEST, 0, weights), 2.0**20)
    return weights / weights.sum(axis=1, keepdims=True)


def _drawn_scales(random: np.random.Generator) -> NDArray[np.float64]:
    """A factor for each of the 35 bones: its region's times its own, left and right alike."""
    factors: dict[str, float] = {}
    for region, bones in _REGIONS.items():
        common = random.normal(0, _SPREAD[region])
        factors |= {bone: float(np.exp(common + random.normal(0, _OWN_SPREAD))) for bone in bones}
    return np.array([factors[name if name in factors else name[1:]] for name in SMAL_JOINTS])
