"""The clips of a glTF file, and how its nodes and morph targets stand at any moment of them (3.11, appendix C)."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.errors import BodyError
from datagen.mesh.formats.gltf import Gltf, reading

_CUBIC, _STEP = "CUBICSPLINE", "STEP"
_WIDTHS = {"rotation": 4, "translation": 3, "scale": 3}


@dataclass(frozen=True)
class Track:
    """Keyframes of what moves a node: ``times`` [key] in seconds, ``values`` [key, n].

    Rotations (``turns``) are quaternions (x, y, z, w); else they are factors or a place (n = 3), or weights of morph
    targets. CUBICSPLINE has ``values`` [key, 3, n]: in-tangent, value, out-tangent.
    """

    times: NDArray[np.float64]
    values: NDArray[np.float64]
    interpolation: str
    turns: bool = True

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the value [n] at ``time``, of rotations a unit quaternion; outside of the keys the nearest key's."""
        cubic, done = self.interpolation == _CUBIC, _unit if self.turns else np.asarray
        values = self.values[:, 1] if cubic else self.values
        after = int(np.searchsorted(self.times, time, side="right"))
        if after in (0, len(self.times)):
            return done(values[min(after, len(values) - 1)])
        before, width = after - 1, self.times[after] - self.times[after - 1]
        if self.interpolation == _STEP:
            return done(values[before])
        share = (time - self.times[before]) / width
        if cubic:
            tangents = self.values[before, 2] * width, self.values[after, 0] * width
            return done(_hermite(values[before], values[after], *tangents, share))
        if not self.turns:
            return values[before] + (values[after] - values[before]) * share
        return _slerp(_unit(values[before]), _unit(values[after]), share)


@dataclass(frozen=True)
class Clip:
    """A named animation from ``start`` to ``end`` (seconds): a track for each node and what of it is moved.

    That is ``rotation``, ``translation``, ``scale`` or ``weights``.
    """

    name: str
    start: float
    end: float
    tracks: dict[tuple[int, str], Track]

    def of(self, path: str) -> dict[int, Track]:
        """Tracks of that kind by node."""
        return {node: track for (node, its), track in self.tracks.items() if its == path}


def read_clips(file: Gltf, paths: Collection[str] = ("rotation",)) -> dict[str, Clip]:
    """Return the clips by name, in the file's order, with the tracks of ``paths``; those that have none are left out.

    Raises
    ------
    BodyError
        Keyframes that are damaged.
    """
    clips = []
    for number, animation in enumerate(file.json.get("animations", ())):
        with reading(file.path, f"animation {number}"):
            clips.append(_clip(file, number, animation, paths))
    return {clip.name: clip for clip in clips if clip.tracks}


def world_frames(file: Gltf, clip: Clip, time: float, nodes: Sequence[int]) -> NDArray[np.float64]:
    """Axes [given node, 3, 3] (columns, as long as at rest) of nodes in the scene at a moment of a clip.

    Translations are not computed, and animated scales are taken to be those at rest.

    Raises
    ------
    BodyError
        A keyframe is not a rotation.
    """
    rotations = file.rotations.copy()
    for node, track in clip.of("rotation").items():
        rotations[node] = track.at(time)
    if not np.isfinite(rotations).all():
        raise BodyError(f"{file.path}: clip {clip.name!r} has a key near {time:.2f} s that is no rotation. Repair it")
    frames = Rotation.from_quat(rotations).as_matrix() * file.scales[:, None, :]
    return file.in_scene(frames)[list(nodes)]


def _clip(file: Gltf, number: int, animation: dict[str, Any], paths: Collection[str]) -> Clip:
    tracks: dict[tuple[int, str], Track] = {}
    for channel in animation["channels"]:
        target = channel["target"]
        if target["path"] in paths and "node" in target:
            if not 0 <= target["node"] < len(file.nodes):
                raise ValueError(f"there is no node {target['node']}")
            sampler = animation["samplers"][channel["sampler"]]
            tracks[target["node"], target["path"]] = _track(file, sampler, target["path"])
    start = min((track.times[0] for track in tracks.values()), default=0.0)
    end = max((track.times[-1] for track in tracks.values()), default=0.0)
    return Clip(str(animation.get("name") or f"clip{number}"), float(start), float(end), tracks)


def _track(file: Gltf, sampler: dict[str, Any], path: str) -> Track:
    interpolation = sampler.get("interpolation", "LINEAR")
    times = file.accessor(sampler["input"])[:, 0].astype(np.float64)
    values = file.accessor(sampler["output"]).astype(np.float64)
    vectors = len(times) * (3 if interpolation == _CUBIC else 1)
    width = _WIDTHS.get(path, values.size // max(vectors, 1))
    if (
        not np.isfinite(times).all()
        or not len(times)
        or values.size != vectors * width
        or not (np.diff(times) > 0).all()
    ):
        raise BodyError(f"{file.path}: an animation's keyframes are damaged. Export it again")
    shape = (len(times), 3, width) if interpolation == _CUBIC else (len(times), width)
    return Track(times, values.reshape(shape), interpolation, turns=path == "rotation")


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
    """Appendix C.5: the cubic through two keys with the given tangents (already times the interval)."""
    square, cube = share**2, share**3
    values = (2 * cube - 3 * square + 1) * first + (3 * square - 2 * cube) * second
    return values + (cube - 2 * square + share) * leaving + (cube - square) * arriving
