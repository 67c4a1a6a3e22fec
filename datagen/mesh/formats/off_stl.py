"""OFF and STL files: the formats of shapes alone."""

import io
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.formats.surface import (
    Alone,
    Encoded,
    Format,
    Surface,
    numbered,
    numbers,
    one_mesh,
    shared_normals,
    unit,
)
from datagen.mesh.limits import is_binary_stl

_STL_HEADER = 80
_ROWS_AT_ONCE = 2**16
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


class OffContent(Alone):
    """The text of an OFF file: colours, comments and quads are kept; binary and 4-D ones are refused."""

    name: str | None = None

    def __init__(self, content: bytes, path: Path) -> None:
        self._lines = content.removeprefix(b"\xef\xbb\xbf").splitlines()
        self._told = [n for n, line in enumerate(self._lines) if line.partition(b"#")[0].strip()]
        first = self._words(0)
        kind = first[0].decode("ascii", "replace") if first else ""
        prefix = kind.removesuffix("OFF")
        if (
            not kind.endswith("OFF")
            or prefix not in ("", "C", "N", "CN", "ST", "STC", "STN", "STCN")
            or b"BINARY" in first
        ):
            raise ValueError(f"it begins with {kind[:20]!r}, not with OFF, COFF, NOFF or STOFF (as text)")
        self._has_normals = "N" in prefix
        counts, self._first = (first[1:], 1) if len(first) > 1 else (self._words(1), 2)
        self._count, faces = int(counts[0]), int(counts[1])
        if self._first + self._count + faces > len(self._told):
            raise ValueError(f"it ends before its {self._count:,} vertices and {faces:,} faces do (one on each line)")
        rows = [self._words(self._first + number) for number in range(self._count)]
        if any(len(row) < 3 for row in rows):
            raise ValueError("a vertex has fewer than three coordinates")
        self._rows = rows
        self.vertices = numbers([word for row in rows for word in row[:3]]).reshape(-1, 3)
        listed = [self._words(self._first + self._count + number) for number in range(faces)]
        sizes = [int(row[0]) for row in listed]
        if any(len(row) <= size or size < 0 for row, size in zip(listed, sizes, strict=True)):
            raise ValueError("a face has fewer corners than it says")
        corners = [int(word) for row, size in zip(listed, sizes, strict=True) for word in row[1 : size + 1]]
        self._faces = np.array(corners, np.int64), np.array(sizes, np.int64)
        self.only_here = ["face colours"] if any(len(r) > s + 1 for r, s in zip(listed, sizes, strict=True)) else []

    def _words(self, number: int) -> list[bytes]:
        return self._lines[self._told[number]].partition(b"#")[0].split() if number < len(self._told) else []

    @cached_property
    def surface(self) -> Surface:
        """Faces and colours of vertices."""
        after = 6 if self._has_normals else 3
        colours = [row[after : after + 4] for row in self._rows]
        return Surface(*self._faces, shading=self._faces[0] if self._has_normals else None, colours=_colours(colours))

    def rewritten(self, vertices: NDArray[np.float64]) -> Encoded:
        """Return the same text with other positions, and normals that follow them."""
        columns = vertices
        if self._has_normals:
            normals = shared_normals(vertices, self.surface, self.surface.corners, count=len(vertices))
            columns = np.concatenate([vertices, normals], axis=1)
        lines = list(self._lines)
        for number, (row, values) in enumerate(zip(self._rows, columns.tolist(), strict=True)):
            words = [b"%.9g" % value for value in values]
            lines[self._told[self._first + number]] = b" ".join(words + row[len(words) :])
        return Encoded(b"\n".join(lines) + b"\n")


def _colours(rows: list[list[bytes]]) -> NDArray[np.uint8] | None:
    """Colours [vertex, 4] of three or four numbers each, whole up to 255 or shares up to 1; else None."""
    lengths = {len(row) for row in rows}
    if lengths not in ({3}, {4}):
        return None
    values = numbers([word for row in rows for word in row]).reshape(len(rows), -1)
    if any(b"." in word for row in rows for word in row):
        values = values * 255
    opaque = np.full((len(rows), 4 - values.shape[1]), 255.0)
    return np.rint(np.clip(np.concatenate([values, opaque], axis=1), 0, 255)).astype(np.uint8)


def _built_off(surface: Surface, vertices: NDArray[np.float64], name: str, stem: str | None) -> Encoded:
    """An OFF file: polygons, and colours of vertices (COFF)."""
    coloured = surface.colours is not None
    rows: list[list[Any]] = vertices.tolist()
    row = "%.9g %.9g %.9g"
    if surface.colours is not None:
        rows = [[*each, *colour] for each, colour in zip(rows, surface.colours.tolist(), strict=True)]
        row += " %d %d %d %d"
    lines = ["COFF" if coloured else "OFF", f"{len(vertices)} {len(surface.sizes)} 0"]
    lines += [row % tuple(each) for each in rows]
    polygons = np.split(surface.corners, np.cumsum(surface.sizes)[:-1])
    lines += [" ".join(map(str, [len(polygon), *polygon.tolist()])) for polygon in polygons]
    parts = {"texture coordinates": surface.uvs, "materials": surface.materials or None, "normals": surface.shading}
    left_out = [name for name, part in parts.items() if part is not None]
    return Encoded("\n".join([*lines, ""]).encode(), {}, left_out)


class StlContent(Alone):
    """The triangles of an STL file, text or binary. Corners at exactly one place become one vertex, as first met."""

    only_here: list[str]

    def __init__(self, content: bytes, path: Path) -> None:
        self.name: str | None = None
        self._binary = is_binary_stl(content[: _STL_HEADER + 4], len(content))
        if self._binary:
            self._header = content[:_STL_HEADER]
            self._triangles = np.frombuffer(content, STL_TRIANGLE, -1, _STL_HEADER + 4)
            corners = self._triangles["corners"].reshape(-1, 3).astype(np.float64)
        elif content.lstrip().startswith(b"solid"):
            self.name = content.lstrip().split(b"\n", 1)[0][5:].strip().decode("utf-8", "replace") or None
            corners = _text_corners(content)
        else:
            raise ValueError("it is neither an STL text nor a binary STL whose length fits its number of triangles")
        number = numbered(corners)
        _, first = np.unique(number, return_index=True)
        self.vertices = corners[first]
        self._corners = number
        self.only_here = ["attributes"] if self._binary and self._triangles["attribute"].any() else []

    @property
    def surface(self) -> Surface:
        """The triangles; their normals are flat, so they say nothing of shading."""
        return Surface(self._corners, np.full(len(self._corners) // 3, 3, np.int64))

    def rewritten(self, vertices: NDArray[np.float64]) -> Encoded:
        """Return the same triangles elsewhere, in text where the file was text."""
        at = vertices[self._corners].reshape(-1, 3, 3)
        if not self._binary:
            return Encoded(_stl_text(at, self.name or ""))
        return Encoded(_stl_bytes(at, self._header, self._triangles["attribute"]))


def _text_corners(content: bytes) -> NDArray[np.float64]:
    if b"endsolid" not in content:
        raise ValueError("it ends before its solid does")
    lines = io.BytesIO(content if b"\n" in content else content.replace(b"\r", b"\n"))
    rows = (line.split() for line in lines if b"vertex" in line)
    parts = [np.empty((0, 3))]
    while some := list(islice(rows, _ROWS_AT_ONCE)):  # seven lines a triangle would take gigabytes at once
        if any(len(row) != 4 for row in some):
            raise ValueError("a facet has a corner without three numbers")
        parts.append(numbers([word for row in some for word in row[1:]]).reshape(-1, 3))
    if sum(map(len, parts)) % 3:
        raise ValueError("a facet has no three corners")
    return np.concatenate(parts)


def _flat_normals(at: NDArray[np.float64]) -> NDArray[np.float64]:
    return unit(np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]))


def _stl_text(at: NDArray[np.float64], name: str) -> bytes:
    facet = "facet normal %.6g %.6g %.6g\nouter loop\n" + "vertex %.9g %.9g %.9g\n" * 3 + "endloop\nendfacet\n"
    numbers = np.concatenate([_flat_normals(at), at.reshape(-1, 9)], axis=1)
    return (f"solid {name}\n" + facet * len(at) % tuple(numbers.ravel().tolist()) + f"endsolid {name}\n").encode()


def _stl_bytes(at: NDArray[np.float64], header: bytes, attribute: NDArray[Any] | int) -> bytes:
    triangles = np.zeros(len(at), STL_TRIANGLE)
    triangles["normal"], triangles["corners"], triangles["attribute"] = _flat_normals(at), at, attribute
    return header.ljust(_STL_HEADER, b"\0") + len(at).to_bytes(4, "little") + triangles.tobytes()


def _built_stl(surface: Surface, vertices: NDArray[np.float64], name: str, stem: str | None) -> Encoded:
    """A binary STL file: triangles and nothing else."""
    parts = {
        "texture coordinates": surface.uvs, "materials": surface.materials or None, "normals": surface.shading,
        "colours": surface.colours, "quads: written as triangles": surface.has_polygons or None,
    }  # fmt: skip
    left_out = ["shared vertices: each triangle has its own corners"]
    left_out += [name for name, part in parts.items() if part is not None]
    return Encoded(_stl_bytes(vertices[surface.faces], b"binary STL", 0), {}, left_out)


FORMATS = {".off": Format(one_mesh(OffContent), _built_off), ".stl": Format(one_mesh(StlContent), _built_stl)}
