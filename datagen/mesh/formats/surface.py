"""What the mesh formats have in common: polygons, texture coordinates, shading, colours and materials of one mesh.

A reader makes a :class:`Surface`, and a file of another format is made from it. Where the format stays the same it is
not used for writing: there the file itself is written again with other positions.
"""

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import MeshError
from datagen.common.files import read_bounded
from datagen.mesh.limits import BYTE_LIMIT


@dataclass(frozen=True)
class Image:
    """A texture: its file name (no folder) and the bytes of that file."""

    name: str
    content: bytes

    @property
    def mime(self) -> str | None:
        """``image/png`` or ``image/jpeg``, told by the first bytes; None for anything else."""
        if self.content.startswith(b"\x89PNG"):
            return "image/png"
        return "image/jpeg" if self.content.startswith(b"\xff\xd8") else None


@dataclass(frozen=True)
class Material:
    """A name, a base colour (red, green, blue, alpha in [0, 1]) and the texture that it is multiplied with."""

    name: str
    colour: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)
    image: Image | None = None


@dataclass(frozen=True)
class Surface:
    """Polygons over n vertices and what they look like.

    ``corners`` [corner] int64: the vertex at each corner, polygon after polygon; ``sizes`` [polygon] int64: corners of
    each. ``uvs`` [corner, 2] float64, the origin at the lower left of the texture, or None. ``shading`` [corner] int64:
    corners of one number share a normal (edges between numbers are sharp); None where the file has no normals.
    ``colours`` [vertex, 4] uint8, sRGB and alpha, or None. ``material_of`` [polygon] int64 indexes ``materials``, -1
    for none.
    """

    corners: NDArray[np.int64]
    sizes: NDArray[np.int64]
    uvs: NDArray[np.float64] | None = None
    shading: NDArray[np.int64] | None = None
    colours: NDArray[np.uint8] | None = None
    material_of: NDArray[np.int64] | None = None
    materials: tuple[Material, ...] = ()

    @property
    def triangle_corners(self) -> NDArray[np.int64]:
        """Triangles [face, 3] as numbers of corners; a polygon becomes a fan around its first corner."""
        pieces = np.maximum(self.sizes - 2, 0)
        starts = np.repeat(np.cumsum(self.sizes) - self.sizes, pieces)
        step = np.arange(len(starts)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        return np.stack([starts, starts + step + 1, starts + step + 2], axis=1)

    @property
    def faces(self) -> NDArray[np.int64]:
        """Triangles [face, 3] of vertices."""
        return self.corners[self.triangle_corners]

    @property
    def polygon_of_face(self) -> NDArray[np.int64]:
        """The polygon [face] that each triangle is of."""
        return np.repeat(np.arange(len(self.sizes)), np.maximum(self.sizes - 2, 0))

    @property
    def has_polygons(self) -> bool:
        """Whether any polygon has more than three corners."""
        return bool((self.sizes > 3).any())


@dataclass(frozen=True)
class Encoded:
    """A file's bytes, files to lie beside it (name -> bytes), and what the format could not hold (one line each)."""

    content: bytes
    beside: dict[str, bytes] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


class Content(Protocol):
    """A file that was read: what every format's reader returns.

    ``vertices`` [n, 3] float64 in the file's unit and axes; ``name`` of the object, None where the file gives none;
    ``geometries``: names of those that it is made of, of formats that have any; ``only_here``: what the file has that a
    :class:`Surface` has no place for.
    """

    @property
    def name(self) -> str | None: ...
    @property
    def geometries(self) -> tuple[str, ...]: ...
    @property
    def vertices(self) -> NDArray[np.float64]: ...
    @property
    def surface(self) -> Surface: ...
    @property
    def only_here(self) -> list[str]: ...

    def rewritten(self, vertices: NDArray[np.float64]) -> Encoded:
        """Return the same file with other positions [n, 3]."""

    def companions(self) -> Encoded:
        """Files that this one names, to be copied along (``content`` is empty)."""


class Alone:
    """Content that names no files beside it, and is made of nothing that has a name."""

    geometries: tuple[str, ...] = ()

    def companions(self) -> Encoded:
        """Nothing."""
        return Encoded(b"")


@dataclass(frozen=True)
class Format:
    """How the files of a format are read and built.

    ``read``: path, and names of the geometries to take, none for all -> :class:`Content`. ``build``: surface, vertices
    [n, 3], the object's name, and the file's stem, None where no files may lie beside it -> :class:`Encoded`.
    ``names``: path -> names of the geometries that can be taken, of formats that have any.
    """

    read: Callable[[Path, Sequence[str]], Content]
    build: Callable[[Surface, NDArray[np.float64], str, str | None], Encoded]
    names: Callable[[Path], tuple[str, ...]] = lambda _: ()


def one_mesh(content: Callable[[bytes, Path], Content]) -> Callable[[Path, Sequence[str]], Content]:
    """Return ``read`` of a format whose files are one mesh as a whole."""

    def read(path: Path, geometries: Sequence[str]) -> Content:
        if geometries:
            raise MeshError(
                f"{path} is one mesh as a whole; only a GLB and an OBJ have geometries to choose: save "
                f"{geometries[0]!r} by itself"
            )
        return content(read_bounded(path, limit=BYTE_LIMIT), path)

    return read


def shared_normals(
    vertices: NDArray[np.float64], surface: Surface, shading: NDArray[np.int64], *, count: int = 0
) -> NDArray[np.float64]:
    """Return unit normals [group, 3] of groups of corners: the mean of their polygons' normals, weighted by area.

    ``vertices`` [n, 3]; ``shading`` [corner] as in :class:`Surface`, -1 for corners without a normal; ``count``: groups
    at least. A group without area gets +Y.
    """
    at = vertices[surface.faces]
    doubled = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
    shaded = shading >= 0
    area = [np.bincount(surface.polygon_of_face, doubled[:, axis], len(surface.sizes)) for axis in range(3)]
    summed = [np.bincount(shading[shaded], np.repeat(each, surface.sizes)[shaded], count) for each in area]
    return unit(np.stack(summed, axis=1))


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors [n, 3] of length one; +Y where there is no length."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-300, vectors / np.maximum(length, 1e-300), (0.0, 1.0, 0.0))


def numbered(rows: NDArray[Any]) -> NDArray[np.int64]:
    """A number for each row [row, column], equal for rows that are equal byte for byte, in order of appearance."""
    plain = np.ascontiguousarray(rows + 0.0 if rows.dtype.kind == "f" else rows)  # -0.0 becomes 0.0
    whole = plain.view([("", plain.dtype)] * plain.shape[1]).ravel()
    _, first, number = np.unique(whole.view(f"V{whole.dtype.itemsize}"), return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[number.ravel()]


def numbers(words: Sequence[bytes]) -> NDArray[np.float64]:
    """Return the numbers [word] that words of a text stand for; ValueError where one stands for none.

    An array of the words themselves would be as wide as the longest of them.
    """
    found = numbers_in(b" ".join(words))
    if len(found) != len(words):
        raise ValueError(f"{len(words):,} words are {len(found):,} numbers")
    return found


def numbers_in(text: bytes, kind: type[np.generic] = np.float64) -> NDArray[Any]:
    """Return the numbers of a text, which white space parts; ValueError where anything else is in it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy only warns where it stops at what is no number
        try:
            return np.fromstring(text, kind, sep=" ")
        except DeprecationWarning as error:
            raise ValueError(str(error)) from error


def one_word(name: str) -> str:
    """Return a name as OBJ and MTL files can hold it: without spaces, and not empty."""
    return re.sub(r"\s+", "_", name.strip()) or "mesh"


def linear(colours: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """SRGB colours [vertex, 4] of 8 bits -> linear ones of 16 bits, as glTF has them (IEC 61966-2-1)."""
    share = colours / 255.0
    bent = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    bent[:, 3] = share[:, 3]
    return np.rint(bent * 65535).astype(np.uint16)


def srgb(colours: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Linear colours [vertex, 4] in [0, 1] -> sRGB of 8 bits."""
    share = np.clip(colours, 0, 1)
    bent = np.where(share <= 0.0031308, share * 12.92, 1.055 * share ** (1 / 2.4) - 0.055)
    bent[:, 3] = share[:, 3]
    return np.rint(bent * 255).astype(np.uint8)
