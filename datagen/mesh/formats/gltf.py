"""Reading glTF 2.0 files (.glb, .gltf): buffers, accessors, and the tree of nodes.

Skins are read by :mod:`datagen.characters.skin`, clips by :mod:`datagen.characters.animation`, both together make
:mod:`datagen.characters.character`.
Written on plain JSON and NumPy: of the readers that there are for Python, pygltflib leaves accessors undecoded and
trimesh drops skins and clips, and what is needed here is small. Section numbers are those of Khronos' specification.
"""

import base64
import os
import struct
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from functools import cached_property
from itertools import count, takewhile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.common.errors import BodyError, UnsafeFileError
from datagen.common.files import read_bounded, resolve_within
from datagen.mesh.limits import DAMAGE, parse_json

SUFFIXES = (".glb", ".gltf")
_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942

_LISTS = ("nodes", "accessors", "bufferViews", "buffers", "skins", "meshes", "animations")
LARGEST = 2**30
"""Bytes at most of a file, of the files beside it, and of all that is taken out of it; a million vertices' positions
have 12 MB."""
Json = dict[str, Any]


@contextmanager
def reading(path: Path, part: str = "") -> Iterator[None]:
    """Turn what Python raises on content that is not as the specification wants it into one BodyError."""
    try:
        yield
    except DAMAGE as error:
        what = f"{part} cannot be read, " if part else ""
        raise BodyError(
            f"{path} is damaged ({what}{type(error).__name__}: {error}). Export or copy it again"
        ) from error


class Gltf:
    """One file, read on demand.

    Raises
    ------
    BodyError
        The file cannot be read, is damaged, or needs an extension that is not understood (such as compression).
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self._binary: bytes | None = None
        self._taken: dict[Hashable, int] = {}
        self._total = 0
        self.json = self._parse()
        packed = [str(name) for name in self.json.get("extensionsRequired", ()) if "compression" in str(name)]
        if packed:
            raise BodyError(f"{path} is packed with {packed[0]}. Export it again without compression")

    @cached_property
    def nodes(self) -> list[Json]:
        """The nodes as they stand in the file."""
        return self.json.get("nodes", [])

    @cached_property
    def parents(self) -> list[int]:
        """Parent of each node; -1 for roots (3.5.2: nodes are trees)."""
        with reading(self.path, "the tree of its nodes"):
            parents = [-1] * len(self.nodes)
            for number, node in enumerate(self.nodes):
                for child in node.get("children", ()):
                    if child < 0 or parents[child] >= 0:
                        raise ValueError(f"node {child}, a child of node {number}, has another parent, or is none")
                    parents[child] = number
            return parents

    @cached_property
    def order(self) -> list[int]:
        """Node numbers, parents before their children."""
        found = [number for number, parent in enumerate(self.parents) if parent < 0]
        for number in found:  # grows while it is read
            found += self.nodes[number].get("children", ())
        if len(found) < len(self.nodes):
            lost = min(set(range(len(self.nodes))) - set(found))
            raise BodyError(f"{self.path} is damaged: node {lost} is its own ancestor. Export it again")
        return found

    @cached_property
    def local(self) -> NDArray[np.float64]:
        """Matrices [node, 4, 4] of the nodes relative to their parents, as the file shows the scene at rest."""
        return np.array([_local(node) for node in self.nodes]).reshape(-1, 4, 4)

    @cached_property
    def rotations(self) -> NDArray[np.float64]:
        """Quaternions [node, 4] (x, y, z, w) of the nodes relative to their parents at rest."""
        return np.array([_rotation(node) for node in self.nodes], np.float64).reshape(-1, 4)

    @cached_property
    def scales(self) -> NDArray[np.float64]:
        """Factors [node, 3] along the axes of the nodes at rest."""
        return np.array([_scale(node) for node in self.nodes], np.float64).reshape(-1, 3)

    @cached_property
    def world(self) -> NDArray[np.float64]:
        """Matrices [node, 4, 4] of the nodes in the scene at rest."""
        return self.in_scene(self.local)

    def in_scene(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return matrices [node, 4, 4] (or [node, 3, 3]) of the nodes in the scene, of those relative to parents."""
        world = local.copy()
        for number in self.order:
            if self.parents[number] >= 0:
                world[number] = world[self.parents[number]] @ world[number]
        return world

    @cached_property
    def shown(self) -> set[int]:
        """Nodes of the scene that a viewer shows (3.5.1): the file's choice, else the first; all where it has none."""
        with reading(self.path, "the list of its scenes"):
            scenes = self.json.get("scenes") or [{"nodes": range(len(self.nodes))}]
            wanted = set(scenes[self.json.get("scene", 0)].get("nodes", ()))
        for number in self.order:  # parents before their children
            if self.parents[number] in wanted:
                wanted.add(number)
        return wanted

    def accessor(self, number: int) -> NDArray[Any]:
        """Elements [count, width] of an accessor (3.6.2): strided, sparse and normalised ones included."""
        with reading(self.path, f"accessor {number}"):
            return self._accessor(number)

    def view(self, number: int) -> bytes:
        """Return the bytes of a buffer view."""
        length = self.json["bufferViews"][number]["byteLength"]
        return self._elements(number, 0, np.dtype(np.uint8), length, 1).tobytes()

    def inverse_bind(self, skin: Json) -> NDArray[np.float64]:
        """Return the inverse bind matrices [joint, 4, 4] of a skin (3.7.3); identity where it has none."""
        joints = len(skin["joints"])
        if "inverseBindMatrices" not in skin:
            return np.tile(np.eye(4), (joints, 1, 1))
        columns = self.accessor(skin["inverseBindMatrices"])[:joints].astype(np.float64)
        return columns.reshape(-1, 4, 4).transpose(0, 2, 1)

    def influences(self, attributes: Json) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return joints and weights [vertex, influence] of a primitive, all of its sets side by side (3.7.3.3).

        Raises
        ------
        BodyError
            It has none.
        """
        sets = list(takewhile(lambda each: {f"JOINTS_{each}", f"WEIGHTS_{each}"} <= attributes.keys(), count()))
        if not sets:
            raise BodyError(f"{self.path}: a skinned mesh has no weights. Bind it to its armature and export it again")
        joints, weights = (
            np.concatenate([self.accessor(attributes[f"{what}_{each}"]) for each in sets], axis=1)
            for what in ("JOINTS", "WEIGHTS")
        )
        return joints, weights

    def require_room(self, what: Hashable, size: int) -> None:
        """Count bytes that are taken out of the file, once for each ``what``: many entries may name the same ones.

        Raises
        ------
        ValueError
            It is more than any file holds.
        """
        if size < 0:
            raise ValueError("a size is below 0")
        if what not in self._taken:
            self._taken[what] = size
            self._total += size
        if self._total > LARGEST:
            raise ValueError(f"what it describes takes {self._total:,} bytes, more than any character has")

    def _accessor(self, number: int) -> NDArray[Any]:
        accessor = self.json["accessors"][number]
        kind, width, size = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
        self.require_room(("accessor", number), size * width * kind.itemsize)
        if "bufferView" in accessor:
            values = self._elements(accessor["bufferView"], accessor.get("byteOffset", 0), kind, size, width)
        else:
            values = np.zeros((size, width), kind)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where, what = sparse["indices"], sparse["values"]
            index_kind = np.dtype(_TYPES[where["componentType"]])
            place = (where["bufferView"], where.get("byteOffset", 0), index_kind, sparse["count"], 1)
            values = values.copy()
            values[self._elements(*place)[:, 0]] = self._elements(
                what["bufferView"], what.get("byteOffset", 0), kind, sparse["count"], width
            )
        if accessor.get("normalized") and kind.kind != "f":
            largest = float(np.iinfo(kind.name).max)
            return np.maximum(values.astype(np.float64) / largest, -1.0)  # 3.6.2.2
        return values

    def _elements(self, view: int, offset: int, kind: "np.dtype[Any]", count: int, width: int) -> NDArray[Any]:
        where = self.json["bufferViews"][view]
        start, size = where.get("byteOffset", 0) + offset, width * kind.itemsize
        stride = where.get("byteStride") or size
        if stride < size or offset + (count - 1) * stride + size > where["byteLength"]:
            raise ValueError(f"{count} elements do not fit into buffer view {view}")
        buffer = self._buffers[where["buffer"]]
        return np.ndarray((count, width), kind, buffer, start, (stride, kind.itemsize))

    @cached_property
    def _buffers(self) -> list[bytes]:
        found: list[bytes] = []
        for number, each in enumerate(self.json.get("buffers", ())):
            found.append(self._buffer(number, each, LARGEST - sum(map(len, found))))
        return found

    def _buffer(self, number: int, buffer: Json, limit: int) -> bytes:
        uri = buffer.get("uri")
        if uri is None:
            if number or self._binary is None:
                raise ValueError(f"buffer {number} is nowhere")
            return self._binary
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        beside = self._beside(uri)
        try:
            return read_bounded(beside, limit=limit)
        except OSError as error:
            raise BodyError(f"{self.path} needs {beside}, which cannot be read ({error.strerror})") from error

    @property
    def files(self) -> list[Path]:
        """The file itself, and those beside it that hold its buffers."""
        with reading(self.path, "the list of its buffers"):
            uris = [buffer.get("uri", "data:") for buffer in self.json.get("buffers", ())]
            return [self.path, *(self._beside(uri) for uri in uris if not uri.startswith("data:"))]

    def _beside(self, uri: str) -> Path:
        try:
            return resolve_within(self.path.parent, os.path.normpath(unquote(uri)))
        except UnsafeFileError as error:
            raise BodyError(
                f"{self.path} names a file outside of its folder: {uri}. Put its buffers beside it"
            ) from error

    def _parse(self) -> Json:
        try:
            content = read_bounded(self.path, limit=LARGEST)
            parsed = parse_json(self._json_chunk(content) if content[:4] == b"glTF" else content)
            if str(parsed["asset"]["version"]).split(".")[0] != "2":
                raise ValueError(f"glTF version {parsed['asset']['version']}")
            for name in _LISTS:
                values = parsed.get(name, [])
                if not isinstance(values, list) or not all(isinstance(each, dict) for each in values):
                    raise ValueError(f"{name} is not a list of objects")
            return parsed
        except OSError as error:
            raise BodyError(f"{self.path} cannot be read: {error.strerror}") from error
        except DAMAGE as error:
            raise BodyError(f"{self.path} is not a sound glTF 2.0 file ({error}). Export or copy it again") from error

    def _json_chunk(self, content: bytes) -> bytes:
        length = struct.unpack_from("<I", content, 8)[0]
        if length > len(content):
            raise ValueError(f"{len(content)} of {length} bytes")
        chunks = dict(_chunks(content[:length]))
        self._binary = chunks.get(_BINARY_CHUNK)
        return chunks[_JSON_CHUNK]


def _chunks(content: bytes) -> Iterator[tuple[int, bytes]]:
    at = 12
    while at + 8 <= len(content):
        length, kind = struct.unpack_from("<II", content, at)
        yield kind, content[at + 8 : at + 8 + length]
        at += 8 + length


def _local(node: Json) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(_rotation(node)).as_matrix() * _scale(node)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _rotation(node: Json) -> NDArray[np.float64]:
    if "matrix" not in node:
        return np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), np.float64)
    return Rotation.from_matrix(_frame(node) / _scale(node)).as_quat()


def _scale(node: Json) -> NDArray[np.float64]:
    """Factors [3]; of a matrix, the lengths of its axes, all of them negative where it mirrors."""
    if "matrix" not in node:
        return np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    return np.linalg.norm(_frame(node), axis=0) * np.sign(np.linalg.det(_frame(node)))


def _frame(node: Json) -> NDArray[np.float64]:
    return np.array(node["matrix"], np.float64).reshape(4, 4).T[:3, :3]


TRIANGLES, STRIP, FAN = SOLID = (4, 5, 6)
"""Modes of a primitive with faces (3.7.2.1)."""


def triangles(corners: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Return triangles [face, 3] of a list, strip or fan (3.7.2.1), all wound alike."""
    if mode == TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if mode == FAN:
        return np.stack([np.full_like(corners[2:], corners[0]), corners[1:-1], corners[2:]], axis=1)
    strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    strip[1::2] = strip[1::2, ::-1]
    return strip
