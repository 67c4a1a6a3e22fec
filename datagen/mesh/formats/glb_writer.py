"""GLB files written: still, or as one morph target a frame with an animation over them.

An animation is held frame by frame: in memory are one frame and the table of weights, frames x frames numbers of four
bytes (16 MB at the limit of 2,000 frames); the frames themselves wait in a temporary file beside the output, 24 bytes a
vertex and frame. The file is as large: 6,890 vertices x 100 frames are 17 MB.
"""

import json
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import MeshError
from datagen.common.files import atomic_file
from datagen.mesh.formats.surface import Surface, shared_normals, unit
from datagen.mesh.limits import FRAME_LIMIT, GLB_LIMIT

Json = dict[str, Any]
_KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 9: "MAT3", 16: "MAT4"}
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views


@dataclass
class GlbParts:
    """JSON and binary chunk of a file in the making."""

    json: Json
    chunks: list[bytes] = field(default_factory=list)
    length: int = 0

    def view(self, content: bytes, **more: int) -> int:
        """Add a buffer view, padded to four bytes; its number."""
        views = self.json.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": self.length, "byteLength": len(content)} | more)
        self.chunks.append(content + bytes(-len(content) % 4))
        self.length += len(self.chunks[-1])
        return len(views) - 1

    def accessor(self, values: NDArray[Any], *, view: int, offset: int = 0, **more: Any) -> int:
        """Add an accessor [count, width] on a buffer view; its number."""
        accessors = self.json.setdefault("accessors", [])
        described = {
            "bufferView": view, "componentType": _KINDS[values.dtype.str[1:]], "count": len(values),
            "type": _SHAPES[values.shape[1]],
        }  # fmt: skip
        accessors.append(described | ({"byteOffset": offset} if offset else {}) | more)
        return len(accessors) - 1

    def attribute(self, values: NDArray[Any], *, normalized: bool = False) -> int:
        """Add values [vertex, width]; anything but integers in rows of whole four bytes becomes float32."""
        whole = values.dtype.kind in "iu" and values.dtype.itemsize * values.shape[1] % 4 == 0
        stored = np.ascontiguousarray(values if whole else values.astype(np.float32))
        more = {"normalized": True} if normalized and whole else {}
        return self.accessor(stored, view=self.view(stored.tobytes(), target=_VERTICES), **more)

    def indices(self, corners: NDArray[Any]) -> int:
        """Add the corners of triangles, in two bytes each where that suffices."""
        small = corners.max(initial=0) < 65535
        stored = corners.astype(np.uint16 if small else np.uint32)[:, None]
        return self.accessor(stored, view=self.view(stored.tobytes(), target=_INDICES))

    def positions(self, values: NDArray[np.float32]) -> int:
        """Add positions [vertex, 3] with the bounds that the specification wants."""
        bounds = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.accessor(values, view=self.view(values.tobytes(), target=_VERTICES), **bounds)


@dataclass
class Block:
    """Vertices [k] of the draft that primitives share, below a node of this transform [4, 4] to world space."""

    vertices: NDArray[np.int64]
    primitives: list[Json]
    world: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    has_normals: bool = True

    @cached_property
    def _to_local(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.inv(self.world), np.float64)

    def arrays(self, positions: NDArray[np.float64], normals: NDArray[np.float64] | None) -> list[NDArray[np.float32]]:
        """Positions, and normals where it has any, in the node's space, from those [n, 3] of all in world space."""
        local = positions[self.vertices] @ self._to_local[:3, :3].T + self._to_local[:3, 3]
        if normals is None or not self.has_normals:
            return [local.astype(np.float32)]
        return [local.astype(np.float32), unit(normals[self.vertices] @ self.world[:3, :3]).astype(np.float32)]


@dataclass
class Draft:
    """A file that lacks only positions and normals; it can be filled once.

    ``of`` [written vertex]: the mesh's vertex at each; ``group`` [written vertex]: its group in the surface's shading,
    or None for a file without normals.
    """

    parts: GlbParts
    blocks: list[Block]
    surface: Surface
    of: NDArray[np.int64]
    group: NDArray[np.int64] | None

    @property
    def frame_bytes(self) -> int:
        """What a frame of an animation takes: positions, and normals where there are any, in four bytes a number."""
        return sum(12 * len(block.vertices) * (2 if block.has_normals else 1) for block in self.blocks)

    def arrays(self, vertices: NDArray[np.float64]) -> list[list[NDArray[np.float32]]]:
        """Positions, and normals where there are any, of each block, from the mesh's vertices [n, 3] in world space."""
        normals = None
        if self.group is not None:
            assert self.surface.shading is not None
            groups = int(self.group.max()) + 1
            normals = shared_normals(vertices, self.surface, self.surface.shading, count=groups)[self.group]
        return [block.arrays(vertices[self.of], normals) for block in self.blocks]

    def static(self, vertices: NDArray[np.float64]) -> bytes:
        """Return the file with these vertices [n, 3]."""
        return b"".join(_glb(self._filled(self.arrays(vertices)), 0))

    def _filled(self, arrays: list[list[NDArray[np.float32]]]) -> GlbParts:
        for block, (positions, *normals) in zip(self.blocks, arrays, strict=True):
            added = {"POSITION": self.parts.positions(positions)}
            if normals:
                added["NORMAL"] = self.parts.attribute(normals[0])
            for primitive in block.primitives:
                primitive["attributes"] |= added
        return self.parts

    def animated(self, frames: Iterable[NDArray[np.float64]], out: Path, *, frames_per_second: float) -> None:
        """Write the file with frames [frame, n, 3] as an animation."""
        iterator = iter(frames)
        first = next(iterator, None)
        if first is None:
            raise MeshError(f"{out}: an animation needs at least one frame")
        base = self.arrays(first)
        parts = self._filled(base)
        with atomic_file(out) as file, tempfile.TemporaryFile(dir=out.parent) as spool:
            targets = self._spooled(iterator, base, spool)
            if targets:
                self._animate(len(targets), targets, spool.tell(), frames_per_second)
            size = parts.length + spool.tell()
            if size > GLB_LIMIT:
                raise MeshError(
                    f"{out}: {len(targets) + 1} frames need {size:,} bytes, a GLB file holds 4 GiB: use fewer"
                )
            file.writelines(_glb(parts, spool.tell()))
            spool.seek(0)
            shutil.copyfileobj(spool, file, 2**20)

    def _spooled(
        self, frames: Iterator[NDArray[np.float64]], base: list[list[NDArray[np.float32]]], spool: IO[bytes]
    ) -> list[list[list[tuple[list[float], list[float]]]]]:
        """Write what differs from the first frame; bounds [frame][block][positions, normals] of it."""
        bounds: list[list[list[tuple[list[float], list[float]]]]] = []
        for frame in frames:
            if len(bounds) + 2 > FRAME_LIMIT:
                raise MeshError(
                    f"more than {FRAME_LIMIT:,} frames: an animated GLB of so many plays nowhere. Use every second"
                )
            bounds.append([])
            for block, first in zip(self.arrays(frame), base, strict=True):
                moves = [after - before for after, before in zip(block, first, strict=True)]
                spool.writelines(each.tobytes() for each in moves)
                bounds[-1].append([(each.min(axis=0).tolist(), each.max(axis=0).tolist()) for each in moves])
        return bounds

    def _animate(self, count: int, bounds: list[Any], size: int, frames_per_second: float) -> None:
        times = (np.arange(count + 1) / frames_per_second).astype(np.float32)[:, None]
        ends: dict[str, Any] = {"min": [0.0], "max": [float(times[-1, 0])]}
        weights = np.eye(count + 1, count, -1, np.float32).reshape(-1, 1)  # frame k shows target k - 1 alone
        sampler = {
            "input": self.parts.accessor(times, view=self.parts.view(times.tobytes()), **ends),
            "output": self.parts.accessor(weights, view=self.parts.view(weights.tobytes())),
            "interpolation": "LINEAR",
        }
        views = self.parts.json["bufferViews"]
        views.append({"buffer": 0, "byteOffset": self.parts.length, "byteLength": size, "byteStride": 12,
                      "target": _VERTICES})  # fmt: skip
        self._add_targets(bounds, len(views) - 1)
        for mesh in self.parts.json["meshes"]:
            mesh["weights"] = [0.0] * count
        nodes = [number for number, each in enumerate(self.parts.json["nodes"]) if "mesh" in each]
        channels = [{"sampler": 0, "target": {"node": node, "path": "weights"}} for node in nodes]
        self.parts.json["animations"] = [{"name": "poses", "samplers": [sampler], "channels": channels}]

    def _add_targets(self, bounds: list[list[list[tuple[list[float], list[float]]]]], view: int) -> None:
        accessors = self.parts.json["accessors"]
        offset = 0
        for frame in bounds:
            for block, arrays in zip(self.blocks, frame, strict=True):
                target = {}
                for name, (low, high) in zip(("POSITION", "NORMAL"), arrays, strict=False):
                    target[name] = len(accessors)
                    accessors.append({"bufferView": view, "byteOffset": offset, "componentType": 5126, "type": "VEC3",
                                      "count": len(block.vertices), "min": low, "max": high})  # fmt: skip
                    offset += 12 * len(block.vertices)
                for primitive in block.primitives:
                    primitive.setdefault("targets", []).append(target)


def _glb(parts: GlbParts, more: int) -> list[bytes]:
    """Header, JSON and binary chunk; ``more`` bytes of the binary chunk are to follow."""
    size = parts.length + more
    described = parts.json | ({"buffers": [{"byteLength": size}]} if size else {})
    text = json.dumps(described, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = b"glTF" + np.array([2, 28 + len(text) + size, len(text)], "<u4").tobytes() + b"JSON"
    return [head, text, np.array([size], "<u4").tobytes(), b"BIN\0", *parts.chunks]
