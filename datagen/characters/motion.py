"""The mesh of a GLB file as one of its animations moves it: by nodes, joints and morph targets (glTF 3.7, 3.11)."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.characters.animation import Clip, read_clips
from datagen.common.errors import BodyError, MeshError
from datagen.common.printable import nearest
from datagen.mesh.files import MeshFile
from datagen.mesh.formats.glb import GlbContent, solid_nodes
from datagen.mesh.formats.gltf import Gltf, reading
from datagen.mesh.geometries import listed
from datagen.mesh.geometry import InFaces, Mesh
from datagen.mesh.limits import FRAME_LIMIT, require_thickness

_PATHS = ("rotation", "translation", "scale", "weights")
_ROUNDING = 1e-4  # of a frame: times are float32


def animation_names(path: Path) -> tuple[str, ...]:
    """Names of a GLB's animations that move a mesh; none where they are damaged: at rest it can be used."""
    if path.suffix.lower() != ".glb":
        return ()
    try:
        return tuple(_animations(Gltf(path)))
    except BodyError:
        return ()


@dataclass(frozen=True, eq=False)
class Motion:
    """A mesh of a GLB file at the frames of one of its animations, so many a second, from its first key to its last."""

    file: MeshFile
    clip: Clip
    frames_per_second: float

    @classmethod
    def of(cls, file: MeshFile, animation: str, *, frames_per_second: float) -> "Motion":
        """The animation of that name.

        Raises
        ------
        MeshError
            The file has none of that name, or it has more than FRAME_LIMIT frames.
        BodyError
            Its animations, meshes or skins are damaged.
        """
        content = file.content
        clips = _animations(content.gltf) if isinstance(content, GlbContent) else {}
        if animation not in clips:
            near, there = nearest(animation, clips), listed(clips) or "none"
            raise MeshError(f"{file.path} has no animation {animation!r} that moves a mesh{near}; it has {there}")
        found = cls(file, clips[animation], frames_per_second)
        if found.count > FRAME_LIMIT:
            raise MeshError(
                f"{file.path}, animation {animation!r} has {found.count:,} frames at {frames_per_second:g} a second, "
                f"more than {FRAME_LIMIT:,}: take fewer a second, or cut it"
            )
        return found

    @property
    def count(self) -> int:
        """Of frames."""
        duration = self.clip.end - self.clip.start
        return int(duration * self.frames_per_second + _ROUNDING) + 1

    def mesh(self, frame: int) -> Mesh:
        """The mesh at a frame, in world space as the file's own.

        Raises
        ------
        MeshError
            It is nothing that has a pose: flat there, or not finite.
        BodyError
            The animation is damaged there.
        """
        time = self.clip.start + frame / self.frames_per_second
        where = f"{self.file.path}, animation {self.clip.name!r} at {time:.2f} s"
        with reading(self.file.path, f"animation {self.clip.name!r}"):
            weights = {node: track.at(time) for node, track in self.clip.of("weights").items()}
            vertices = self._content.moved(self._world(time), weights)
        mesh = Mesh(vertices, self.file.mesh.faces)
        require_thickness(np.asarray(InFaces.checked(mesh, name=where).mesh.vertices, np.float64), Path(where))
        return mesh

    @cached_property
    def _content(self) -> GlbContent:
        assert isinstance(self.file.content, GlbContent)
        return self.file.content

    def _world(self, time: float) -> NDArray[np.float64]:
        """Matrices [node, 4, 4] of the nodes in the scene."""
        file = self._content.gltf
        turns, scales, places = file.rotations.copy(), file.scales.copy(), file.local[:, :3, 3].copy()
        for path, values in (("rotation", turns), ("scale", scales), ("translation", places)):
            for node, track in self.clip.of(path).items():
                values[node] = track.at(time)
        moved = sorted({node for node, path in self.clip.tracks if path != "weights"})
        local = file.local.copy()
        local[moved, :3, :3] = Rotation.from_quat(turns[moved]).as_matrix() * scales[moved, None]
        local[moved, :3, 3] = places[moved]
        return file.in_scene(local)


def _animations(file: Gltf) -> dict[str, Clip]:
    with reading(file.path, "its meshes and skins"):
        movers = _movers(file)
        solids = set(solid_nodes(file).values())
    moving = {}
    for name, clip in read_clips(file, _PATHS).items():
        kept = {at: track for at, track in clip.tracks.items() if at[0] in (solids if at[1] == "weights" else movers)}
        if kept:  # the others move cameras, lights, or what is not there
            starts, ends = zip(*((track.times[0], track.times[-1]) for track in kept.values()), strict=True)
            moving[name] = replace(clip, tracks=kept, start=float(min(starts)), end=float(max(ends)))
    return moving


def _movers(file: Gltf) -> set[int]:
    """Nodes that move a mesh: its own, or its skin's joints in the place of its own (3.7.3.3), and all above these."""
    solids = set(solid_nodes(file).values())
    found = {node for node in solids if "skin" not in file.nodes[node]}
    skins = {file.nodes[node]["skin"] for node in solids - found}
    found |= {joint for skin in skins for joint in file.json["skins"][skin]["joints"]}
    for node in reversed(file.order):  # children before their parents
        if node in found and file.parents[node] >= 0:
            found.add(file.parents[node])
    return found
