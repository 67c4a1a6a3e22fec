"""PLY files, text or binary: everything in them is kept, positions and normals of vertices are written anew."""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.formats.mtl import NamedFiles, texture_beside
from datagen.mesh.formats.ply_header import ORDERS, ElementValues, read_header, read_tables
from datagen.mesh.formats.surface import Encoded, Format, Image, Material, Surface, numbered, one_mesh, shared_normals

_COLOURS = ("red", "green", "blue", "alpha")
_NORMALS = ("nx", "ny", "nz")
_UVS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_FACES = ("vertex_indices", "vertex_index")


class PlyContent:
    """The bytes of a PLY file and what they mean."""

    name: str | None = None
    geometries: tuple[str, ...] = ()

    def __init__(self, content: bytes, path: Path) -> None:
        self._content, self._path, self._header = content, path, read_header(content)
        text = content[self._header.end :] if self._header.form == "ascii" else b""
        self._rows = [line for line in text.splitlines() if line.strip()]
        self._tables = read_tables(content, self._header, self._rows)
        if "vertex" not in self._tables:
            raise ValueError("it has no vertices")
        self._vertex = self._tables["vertex"].single
        kinds = {each.name: each for element in self._header.elements if element.name == "vertex"
                 for each in element.properties}  # fmt: skip
        if any(axis not in kinds or kinds[axis].kind[0] != "f" for axis in "xyz"):
            raise ValueError("its vertices need x, y and z of type float or double")
        if self._tables["vertex"].lists:
            raise ValueError(f"its vertices have a list, {next(iter(self._tables['vertex'].lists))}: export without it")
        self.vertices = self._columns("x", "y", "z").astype(np.float64)

    def _columns(self, *names: str) -> NDArray[Any]:
        return np.stack([self._vertex[name] for name in names], axis=1)

    @cached_property
    def surface(self) -> Surface:
        """Faces, texture coordinates of vertices or of corners, colours, and the texture."""
        if "tristrips" in self._tables:
            raise ValueError("it holds triangle strips: export triangles")
        lists = self._tables["face"].lists if "face" in self._tables else {}
        listed = next((lists[name] for name in _FACES if name in lists), (np.empty(0), np.empty(0, np.int64)))
        corners, sizes = listed[0].astype(np.int64), listed[1]
        return Surface(
            corners,
            sizes,
            uvs=self._uvs(corners, lists),
            shading=self._group[corners] if self._group is not None and _known(corners, len(self.vertices)) else None,
            colours=self._colours,
            material_of=np.zeros(len(sizes), np.int64) if self._texture else None,
            materials=(Material("texture", (1.0, 1.0, 1.0, 1.0), self._texture),) if self._texture else (),
        )

    @cached_property
    def _group(self) -> NDArray[np.int64] | None:
        """Vertices [vertex] that share a normal: those at one place with one normal, as along a seam."""
        if not set(_NORMALS) <= set(self._vertex):
            return None
        return numbered(self._columns("x", "y", "z", *_NORMALS).astype(np.float64))

    def _uvs(self, corners: NDArray[np.int64], lists: dict[str, Any]) -> NDArray[np.float64] | None:
        named = next((names for names in _UVS if set(names) <= set(self._vertex)), None)
        if named and _known(corners, len(self.vertices)):
            return self._columns(*named).astype(np.float64)[corners]
        wedges = lists.get("texcoord", (np.empty(0), None))[0]
        return wedges.astype(np.float64).reshape(-1, 2) if corners.size and wedges.size == 2 * corners.size else None

    @property
    def _colours(self) -> NDArray[np.uint8] | None:
        if not set(_COLOURS[:3]) <= set(self._vertex):
            return None
        found = [self._vertex[name] for name in _COLOURS if name in self._vertex]
        opaque = [np.full(len(self.vertices), 255)] if len(found) == 3 else []
        return np.clip(np.stack(found + opaque, axis=1), 0, 255).astype(np.uint8)

    @property
    def only_here(self) -> list[str]:
        """Properties of vertices and faces, and elements, that are of this file alone."""
        known = {*"xyz", *_NORMALS, *_COLOURS, *(name for names in _UVS for name in names)}
        known_of = {"vertex": known, "face": {*_FACES, "texcoord", "texnumber"}}
        left = [
            f"{element.name} property {each.name}" if element.name in known_of else f"element {element.name}"
            for element in self._header.elements
            for each in element.properties
            if each.name not in known_of.get(element.name, ())
        ]
        return list(dict.fromkeys(left))

    def rewritten(self, vertices: NDArray[np.float64]) -> Encoded:
        """Return the same file with other positions, and normals that follow them."""
        columns = {axis: vertices[:, number] for number, axis in enumerate("xyz")}
        if self._group is not None:
            surface = self.surface
            groups = int(self._group.max()) + 1
            normals = shared_normals(vertices, surface, self._group[surface.corners], count=groups)
            columns |= {name: normals[self._group, axis] for axis, name in enumerate(_NORMALS)}
        write = self._text if self._header.form == "ascii" else self._binary
        return Encoded(write(self._tables["vertex"], columns))

    def _binary(self, table: ElementValues, columns: dict[str, NDArray[np.float64]]) -> bytes:
        element = next(each for each in self._header.elements if each.name == "vertex")
        kind = np.dtype([(each.name, ORDERS[self._header.form] + each.kind) for each in element.properties])
        values = np.frombuffer(self._content, kind, element.count, table.start).copy()
        for name, column in columns.items():
            values[name] = column
        return self._content[: table.start] + values.tobytes() + self._content[table.end :]

    def _text(self, table: ElementValues, columns: dict[str, NDArray[np.float64]]) -> bytes:
        place = {name: number for number, name in enumerate(self._vertex)}
        words = [row.split() for row in self._rows[table.start : table.end]]
        for name, column in columns.items():
            for row, value in zip(words, column.tolist(), strict=True):
                row[place[name]] = b"%.9g" % value
        rows = [*self._rows[: table.start], *map(b" ".join, words), *self._rows[table.end :]]
        return self._content[: self._header.end] + b"\n".join(rows) + b"\n"

    def companions(self) -> Encoded:
        """Return the texture that a comment names (``TextureFile``, as MeshLab writes it)."""
        texture_beside(self._files, self._texture_name)
        return Encoded(b"", self._files.contents, list(dict.fromkeys(self._files.missing)))

    @property
    def _texture_name(self) -> str:
        return next((line.partition(" ")[2] for line in self._header.comments if line.startswith("TextureFile ")), "")

    @cached_property
    def _files(self) -> NamedFiles:
        return NamedFiles(self._path.parent)

    @cached_property
    def _texture(self) -> Image | None:
        return texture_beside(self._files, self._texture_name)


def _known(corners: NDArray[np.int64], count: int) -> bool:
    """Whether corners name vertices that there are; the check of the mesh says so where they do not."""
    return not corners.size or bool(corners.min() >= 0 and corners.max() < count)


def _built(surface: Surface, vertices: NDArray[np.float64], name: str, stem: str | None) -> Encoded:
    """A binary PLY file: polygons, colours, texture coordinates of corners, and smooth normals where there are any."""
    columns: list[tuple[str, str, NDArray[Any]]] = [(axis, "f4", vertices[:, n]) for n, axis in enumerate("xyz")]
    left_out = []
    if surface.shading is not None:
        normals = shared_normals(vertices, surface, surface.corners, count=len(vertices))
        columns += [(name, "f4", normals[:, axis]) for axis, name in enumerate(_NORMALS)]
        left_out += ["sharp edges: normals are smooth"] if _is_sharp(surface) else []
    if surface.colours is not None:
        columns += [(name, "u1", surface.colours[:, n]) for n, name in enumerate(_COLOURS)]
    table = np.empty(len(vertices), np.dtype([(name, "<" + kind) for name, kind, _ in columns]))
    for field, _, column in columns:
        table[field] = column
    left_out += ["materials"] if surface.materials else []
    return Encoded(_header_of(columns, surface, len(vertices)) + table.tobytes() + _face_bytes(surface), {}, left_out)


def _is_sharp(surface: Surface) -> bool:
    assert surface.shading is not None
    pairs = numbered(np.stack([surface.corners, surface.shading], axis=1))
    return int(pairs.max(initial=0)) + 1 > len(np.unique(surface.corners))


def _header_of(columns: list[tuple[str, str, NDArray[Any]]], surface: Surface, count: int) -> bytes:
    kinds = {"f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {kinds[kind]} {name}" for name, kind, _ in columns]
    lines += [f"element face {len(surface.sizes)}", "property list int int vertex_indices"]
    lines += ["property list int float texcoord"] if surface.uvs is not None else []
    return "\n".join([*lines, "end_header\n"]).encode()


def _face_bytes(surface: Surface) -> bytes:
    """Each face's length and corners, and the same for its texture coordinates, all in words of four bytes."""
    starts = np.cumsum(surface.sizes) - surface.sizes
    parts = [(surface.sizes, surface.corners.astype("<i4").view("<u4").reshape(-1, 1))]
    if surface.uvs is not None:
        parts.append((surface.sizes, surface.uvs.astype("<f4").view("<u4")))
    width = [part.shape[1] for _, part in parts]
    words = len(parts) + sum(width) * surface.sizes
    at = np.cumsum(words) - words
    out = np.zeros(int(words.sum()), "<u4")
    polygon = np.repeat(np.arange(len(surface.sizes)), surface.sizes)
    within = np.arange(len(surface.corners)) - starts[polygon]
    for columns, part in zip(width, (part for _, part in parts), strict=True):
        out[at] = columns * surface.sizes
        for column in range(columns):
            out[at[polygon] + 1 + columns * within + column] = part[:, column]
        at = at + 1 + columns * surface.sizes
    return out.tobytes()


FORMATS = {".ply": Format(one_mesh(PlyContent), _built)}
