"""The clips of a glTF file, and the rotations of its nodes at any moment of them (3.11, appendix C)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.errors import BodyError
from datagen.mesh.formats.gltf import Gltf, reading

_CUBIC, _STEP = "CUBICSPLINE", "STEP"


@dataclass(frozen=True)
class Track:
    """Keyframes of a node's rotation: ``times`` [key] in seconds, ``values`` [key, 4] as (x, y, z, w).

    CUBICSPLINE has ``values`` [key, 3, 4]: in-tangent, value, out-tangent.
    """

    times: NDArray[np.float64]
    values: NDArray[np.float64]
    interpolation: str

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the unit quaternion [4] at ``time``; before the first and after the last key, that key's."""
        cubic = self.interpolation == _CUBIC
        values = self.values[:, 1] if cubic else self.values
        after = int(np.searchsorted(self.times, time, side="right"))
        if after in (0, len(self.times)):
            return _unit(values[min(after, len(values) - 1)])
        before, width = after - 1, self.times[after] - self.times[after - 1]
        if self.interpolation == _STEP:
            return _unit(values[before])
        share = (time - self.times[before]) / width
        if cubic:
            tangents = self.values[before, 2] * width, self.values[after, 0] * width
            return _hermite(values[before], values[after], *tangents, share)
        return _slerp(_unit(values[before]), _unit(values[after]), share)


@dataclass(frozen=True)
class Clip:
    """A named animation from ``start`` to ``end`` (seconds), with the rotations of the nodes that it turns."""

    name: str
    start: float
    end: float
    rotations: dict[int, Track]


def read_clips(file: Gltf) -> dict[str, Clip]:
    """Return the clips by name, in the file's order; those that turn nothing are left out.

    Raises
    ------
    BodyError
        Keyframes that are damaged.
    """
    clips = []
    for number, animation in enumerate(file.json.get("animations", ())):
        with reading(file.path, f"animation {number}"):
            clips.append(_clip(file, number, animation))
    return {clip.name: clip for clip in clips if clip.rotations}


def world_frames(file: Gltf, clip: Clip, time: float, nodes: Sequence[int]) -> NDArray[np.float64]:
    """Axes [given node, 3, 3] (columns, as long as at rest) of nodes in the scene at a moment of a clip.

    Translations are not computed, and animated scales are taken to be those at rest.

    Raises
    ------
    BodyError
        A keyframe is not a rotation.
    """
    rotations = file.rotations.copy()
    for node, track in clip.rotations.items():
        rotations[node] = track.at(time)
    if not np.isfinite(rotations).all():
        raise BodyError(f"{file.path}: clip {clip.name!r} has a key near {time:.2f} s that is no rotation. Repair it")
    frames = Rotation.from_quat(rotations).as_matrix() * file.scales[:, None, :]
    for node in file.order:
        parent = file.parents[node]
        if parent >= 0:
            frames[node] = frames[parent] @ frames[node]
    return frames[list(nodes)]


def _clip(file: Gltf, number: int, animation: dict[str, Any]) -> Clip:
    tracks: dict[int, Track] = {}
    for channel in animation["channels"]:
        target = channel["target"]
        if target["path"] == "rotation" and "node" in target:
            if not 0 <= target["node"] < len(file.nodes):
                raise ValueError(f"there is no node {target['node']}")
            tracks[target["node"]] = _track(file, animation["samplers"][channel["sampler"]])
    start = min((track.times[0] for track in tracks.values()), default=0.0)
    end = max((track.times[-1] for track in tracks.values()), default=0.0)
    return Clip(str(animation.get("name") or f"clip{number}"), float(start), float(end), tracks)


def _track(file: Gltf, sampler: dict[str, Any]) -> Track:
    interpolation = sampler.get("interpolation", "LINEAR")
    times = file.accessor(sampler["input"])[:, 0].astype(np.float64)
    values = file.accessor(sampler["output"]).astype(np.float64)
    shape = (len(times), 3, 4) if interpolation == _CUBIC else (len(times), 4)
    if (
        not np.isfinite(times).all()
        or not len(times)
        or values.size != np.prod(shape)
        or not (np.diff(times) > 0).all()
    ):
        raise BodyError(f"{file.path}: an animation's keyframes are damaged. Export it again")
    return Track(times, values.reshape(shape), interpolation)


def _unit(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.sqrt((quaternion * quaternion).sum())
    return quaternion / length if length > 0 else np.full(4, np.nan)


def _slerp(first: NDArray[np.float64], second: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    cosine = float((first * second).sum())
    if cosine < 0:  # the shorter way
        cosine, second = -cosine, -second
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-6:
        return _unit(first + (second - first) * share)
    return _unit(np.sin((1 - share) * angle) * first + np.sin(share * angle) * second)


def _hermite(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    leaving: NDArray[np.float64],
    arriving: NDArray[np.float64],
    share: float,
) -> NDArray[np.float64]:
    """Appendix C.5: the cubic through two keys with the given tangents (already times the interval), renormalised."""
    square, cube = share**2, share**3
    values = (2 * cube - 3 * square + 1) * first + (3 * square - 2 * cube) * second
    return _unit(values + (cube - 2 * square + share) * leaving + (cube - square) * arriving)
