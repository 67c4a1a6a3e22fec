"""OBJ files: the text is kept, and only positions and normals in it are written anew.

So materials, groups, smoothing groups, quads, vertex colours, comments and the order of everything stay as they are.
Continued lines are joined; names may be of any 8-bit encoding. Free-form surfaces are kept, not posed.

Data sets of pose transfer are tens of thousands of files of bare vertices and triangles: those are read whole by NumPy,
line by line only what is not so regular.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.files import read_bounded
from datagen.mesh.formats.surface import Encoded, Format, Surface, numbers, numbers_in, shared_normals
from datagen.mesh.geometries import require_known_names
from datagen.mesh.limits import BYTE_LIMIT

if TYPE_CHECKING:
    from datagen.mesh.formats.mtl import LibraryFiles

_PATTERNS = {
    (0, 1): re.compile(rb"\s*f(?:\s+-?\d+/-?\d+)+\s*"),
    (0, 2): re.compile(rb"\s*f(?:\s+-?\d+//-?\d+)+\s*"),
    (0, 1, 2): re.compile(rb"\s*f(?:\s+-?\d+/-?\d+/-?\d+)+\s*"),
}
_FACE = re.compile(rb"\s*f(?:\s+-?\d{1,18}(?:/(?:-?\d{1,18})?){0,2})*\s*")
_SECTIONS = (b"o", b"g")
_MOST_OBJECTS = 1_000  # that are asked whether they make one body
_ELEMENTS = (b"v", b"vt", b"vn", b"f", b"usemtl", b"mtllib", b"o", b"g", b"s", b"l", b"p")


class ObjContent:
    """The text of an OBJ file and what its lines mean."""

    geometries: tuple[str, ...] = ()
    _lost: tuple[str, ...] = ()

    def __init__(self, content: bytes, path: Path) -> None:
        if content[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in content[:4096]:
            raise ValueError("it is binary or UTF-16 text; OBJ is plain text: save it as UTF-8")
        text = content.removeprefix(b"\xef\xbb\xbf").replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
        self._path = path
        self._break = b"\n" if b"\n" in text or b"\r" not in text else b"\r"
        self._lines = text.split(self._break)
        self._at: dict[bytes, list[int]] = {element: [] for element in _ELEMENTS}
        vertices, faces = self._at[b"v"], self._at[b"f"]
        for number, line in enumerate(self._lines):
            start = line[:2]
            if start == b"v ":
                vertices.append(number)
            elif start == b"f ":
                faces.append(number)
            elif (words := line.split(None, 1)) and words[0] in self._at:
                self._at[words[0]].append(number)
        self.vertices = self._numbers(b"v", 3, needed=3)

    @property
    def name(self) -> str | None:
        """The first object's name."""
        return next(iter(self._names(b"o")), None)

    @property
    def only_here(self) -> list[str]:
        """Groups, smoothing groups, names of several objects, lines and points."""
        named = {b"g": "groups", b"s": "smoothing groups", b"l": "lines", b"p": "points"}
        objects = ["names of its objects"] if len(self._at[b"o"]) > 1 else []
        return [*self._lost, *objects, *(name for element, name in named.items() if self._at[element])]

    @property
    def sections(self) -> tuple[str, ...]:
        """Names of its objects, or of its groups where it is one object or none."""
        objects, groups = (
            tuple(dict.fromkeys(name for names in self._section_names(element) for name in names))
            for element in _SECTIONS
        )
        return objects if len(objects) > 1 else groups

    @property
    def extents(self) -> dict[str, NDArray[np.float64]]:
        """Least and greatest coordinates [2, 3] of its objects that have faces, unless they are one or very many."""
        names, (table, sizes) = [*self._names(b"o"), ""], self._face_corners
        object_of = np.repeat(self._section_of_face(b"o"), sizes)
        order = np.argsort(object_of, kind="stable")
        numbers, starts = np.unique(object_of[order], return_index=True)
        if not 1 < len(numbers) <= _MOST_OBJECTS:
            return {}
        corners = self.vertices[table[order, 0]]
        both = np.stack([extreme.reduceat(corners, starts) for extreme in (np.minimum, np.maximum)], axis=1)
        known = [names[number] or "unnamed" for number in numbers]
        again = [known[:place].count(name) for place, name in enumerate(known)]
        titles = [f"{name} ({count + 1})" if count else name for name, count in zip(known, again, strict=True)]
        return dict(zip(titles, both, strict=True))

    def only(self, wanted: Sequence[str]) -> "ObjContent":
        """Return the objects and groups of these names, with the vertices of their faces alone.

        Raises
        ------
        MeshError
            The file has none of such a name.
        """
        known = [name for element in _SECTIONS for names in self._section_names(element) for name in names]
        require_known_names(wanted, known, self._path, what="object or group")
        kept = np.any([self._is_in(element, wanted) for element in _SECTIONS], axis=0)
        only = ObjContent(self._text_of(kept), self._path)
        taken = {name for element in _SECTIONS for names in only._section_names(element) for name in names}
        others = [name for name in dict.fromkeys(known) if name not in taken]
        only._lost = (f"other objects and groups: {', '.join(others)}",) if others else ()
        return only

    def _is_in(self, element: bytes, wanted: Sequence[str]) -> NDArray[np.bool_]:
        """Which faces [face] are in sections of these names."""
        sections = [not set(names).isdisjoint(wanted) for names in self._section_names(element)]
        return np.array([*sections, False])[self._section_of_face(element)]

    def _section_names(self, element: bytes) -> list[list[str]]:
        """Names of each line that begins a section: an object has one, with spaces or not, a group may have several."""
        return [line.split() if element == b"g" else [line] for line in self._names(element)]

    def _section_of_face(self, element: bytes) -> NDArray[np.int64]:
        """Number [face] of the line of an element that holds for each face, -1 before the first."""
        return np.searchsorted(np.array(self._at[element], np.int64), np.array(self._at[b"f"], np.int64)) - 1

    def _text_of(self, kept: NDArray[np.bool_]) -> bytes:
        """The text with these faces alone: without lines that they do not need, and with numbers that fit."""
        table, sizes = self._face_corners
        lines: list[bytes | None] = list(self._lines)
        columns, corners = [], table[np.repeat(kept, sizes)]
        for column, element in zip(corners.T, (b"v", b"vt", b"vn"), strict=True):
            used = np.unique(column[column >= 0])
            self._drop(lines, element, used)
            columns.append(np.where(column < 0, 0, np.searchsorted(used, column) + 1))
        for element in (*_SECTIONS, b"usemtl"):
            self._drop(lines, element, self._section_of_face(element)[kept])
        for element in (b"l", b"p", b"f"):
            self._drop(lines, element, np.flatnonzero(kept if element == b"f" else []))
        words = iter([_corner_word(*each) for each in np.stack(columns, axis=1).tolist()])
        for place in np.array(self._at[b"f"])[kept].tolist():
            count = len(_words(self._lines[place])) - 1
            lines[place] = b" ".join([b"f", *(next(words) for _ in range(count))]) + self._end
        return self._break.join(line for line in lines if line is not None)

    def _drop(self, lines: list[bytes | None], element: bytes, kept: NDArray[np.int64]) -> None:
        """Leave out all lines of an element but those of these numbers."""
        for place in np.delete(np.array(self._at[element], np.int64), np.unique(kept[kept >= 0])):
            lines[place] = None

    @cached_property
    def _face_corners(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers [corner, 3] of vertex, texture coordinate and normal (-1 for none), and corners of each face."""
        try:
            table, sizes = _corners(self._of(b"f"))
        except (ValueError, OverflowError):
            lines = self._of(b"f")
            wrong = next((n for n, line in enumerate(lines) if not _FACE.fullmatch(line.partition(b"#")[0])), None)
            if wrong is None:
                raise
            line = self._of(b"f")[wrong].decode("utf-8", "replace")
            raise ValueError(f"line {self._at[b'f'][wrong] + 1} is no face: {line[:60]!r}") from None
        line_of = np.repeat(np.array(self._at[b"f"], np.int64), sizes)
        for column, element in enumerate((b"v", b"vt", b"vn")):
            before = np.searchsorted(np.array(self._at[element], np.int64), line_of)
            numbers = table[:, column].copy()
            table[:, column] = np.where(numbers < 0, numbers + before, numbers - 1)
            self._require_known(table[:, column], element, needed=column == 0, backwards=numbers < 0)
        return table, sizes

    def _require_known(self, found: NDArray[Any], element: bytes, *, needed: bool, backwards: NDArray[Any]) -> None:
        lowest = 0 if needed else -1
        wrong = (found >= len(self._at[element])) | (found < lowest) | (backwards & (found < 0))
        if wrong.any():
            what = {b"v": "vertex", b"vt": "texture coordinate", b"vn": "normal"}[element]
            number = found[wrong][0] + 1
            raise ValueError(f"a face names {what} {number}, but there are {len(self._at[element])} (from 1)")

    @cached_property
    def surface(self) -> Surface:
        """The faces, with materials from the libraries beside the file."""
        table, sizes = self._face_corners
        names = self._names(b"usemtl")
        known = {material.name: material for material in self._libraries.materials} if names else {}
        used = list(dict.fromkeys(name for name in names if name in known))
        current = self._section_of_face(b"usemtl")
        number_of = np.array([used.index(name) if name in used else -1 for name in names] + [-1], np.int64)
        return Surface(
            corners=table[:, 0],
            sizes=sizes,
            uvs=self._uvs(table[:, 1]),
            shading=self._shading[0] if len(table) and self._shading[0].min() >= 0 else None,
            colours=self._colours(),
            material_of=number_of[current] if used else None,
            materials=tuple(known[name] for name in used),
        )

    def _uvs(self, numbers: NDArray[np.int64]) -> NDArray[np.float64] | None:
        if not self._at[b"vt"] or not (numbers >= 0).any():
            return None
        written = np.concatenate([self._numbers(b"vt", 2, needed=1), np.zeros((1, 2))])
        return written[numbers]

    def _colours(self) -> NDArray[np.uint8] | None:
        lines = self._of(b"v")
        rows = [_words(line) for line in lines] if lines and len(_words(lines[0])) == 7 else []
        if not rows or any(len(row) != 7 for row in rows):
            return None
        written = _as_numbers([row[4:] for row in rows], 3)
        colours = np.clip(written / (255 if written.max(initial=0) > 1 else 1), 0, 1)
        return np.concatenate([np.rint(colours * 255), np.full((len(rows), 1), 255.0)], axis=1).astype(np.uint8)

    @cached_property
    def _shading(self) -> tuple[NDArray[np.int64], bool]:
        """Group [corner] of every corner, one for each vertex and normal that go together, -1 where there is no normal.

        And whether the groups are the file's normals: so where no two vertices share one, and each can stay in place.
        """
        table, _ = self._face_corners
        with_normal = table[:, 2] >= 0
        both = table[with_normal, 2] * len(self.vertices) + table[with_normal, 0]
        pairs, group = np.unique(both, return_inverse=True)
        if len(np.unique(pairs // max(len(self.vertices), 1))) == len(pairs):
            return table[:, 2], True
        groups = np.full(len(table), -1, np.int64)
        groups[with_normal] = group.ravel()
        return groups, False

    def rewritten(self, vertices: NDArray[np.float64]) -> Encoded:
        """Return the text with other positions; normals follow them, edges that were sharp stay so."""
        lines: list[bytes | None] = list(self._lines)
        for number, line in zip(self._at[b"v"], self._position_lines(vertices), strict=True):
            lines[number] = line
        shading, in_place = self._shading
        if (shading >= 0).any():
            normals = shared_normals(vertices, self.surface, shading)
            (self._replace_normals if in_place else self._renumber_normals)(lines, normals, shading)
        return Encoded(self._break.join(line for line in lines if line is not None), {}, list(self._lost))

    def _position_lines(self, vertices: NDArray[np.float64]) -> list[bytes]:
        written = vertex_lines(vertices).encode().splitlines()
        rest = [[*line.split(None, 4), b""][4] for line in self._of(b"v")]
        end = self._end
        return [b"%b %b" % (line, tail) if tail else line + end for line, tail in zip(written, rest, strict=True)]

    @property
    def _end(self) -> bytes:
        return b"\r" if self._lines[self._at[b"v"][0]].endswith(b"\r") else b""

    def _replace_normals(
        self, lines: list[bytes | None], normals: NDArray[np.float64], shading: NDArray[np.int64]
    ) -> None:
        used = np.unique(shading[shading >= 0])
        for number, row in zip(used.tolist(), normals[used].tolist(), strict=True):
            lines[self._at[b"vn"][number]] = _normal_line(row) + self._end

    def _renumber_normals(
        self, lines: list[bytes | None], normals: NDArray[np.float64], shading: NDArray[np.int64]
    ) -> None:
        """One block of normals where the first was, and faces that name them; the rest of each face stays as it is."""
        numbers = iter((shading + 1).tolist())
        for place in self._at[b"f"]:
            words = _words(self._lines[place])
            corners = [_with_normal(word, next(numbers)) for word in words[1:]]
            lines[place] = b" ".join([b"f", *corners]) + self._end
        for place in self._at[b"vn"]:
            lines[place] = None
        block = (self._end + self._break).join(_normal_line(row) for row in normals.tolist())
        lines[self._at[b"vn"][0]] = block + self._end

    def companions(self) -> Encoded:
        """Return the material libraries and their textures."""
        return Encoded(b"", self._libraries.beside, self._libraries.missing)

    @cached_property
    def _libraries(self) -> "LibraryFiles":
        from datagen.mesh.formats.mtl import read_library

        return read_library(self._path.parent, self._names(b"mtllib"))

    def _of(self, element: bytes) -> list[bytes]:
        return [self._lines[number] for number in self._at[element]]

    def _names(self, element: bytes) -> list[str]:
        return [[*line.split(None, 1), b""][1].strip().decode("utf-8", "replace") for line in self._of(element)]

    def _numbers(self, element: bytes, columns: int, *, needed: int) -> NDArray[np.float64]:
        """The first numbers [line, column] of the lines of an element; 0 where a line has fewer."""
        lines = self._of(element)
        table = _regular_rows(lines, element)
        if table is not None and table.shape[1] >= columns:
            return np.ascontiguousarray(table[:, :columns])
        rows = [_words(line)[1 : columns + 1] for line in lines]
        try:
            if any(len(row) < needed for row in rows):
                raise ValueError
            return _as_numbers(rows, columns)
        except ValueError:
            at = next(n for n, row in zip(self._at[element], rows, strict=True) if not _is_numbers(row, needed))
            shown = self._lines[at][:60].decode("utf-8", "replace").strip()
            raise ValueError(f"line {at + 1} is not {needed} numbers: {shown!r}") from None


def _words(line: bytes) -> list[bytes]:
    return (line.partition(b"#")[0] if b"#" in line else line).split()


def _as_numbers(rows: list[list[bytes]], columns: int) -> NDArray[np.float64]:
    padded = [row if len(row) == columns else [*row, *[b"0"] * (columns - len(row))] for row in rows]
    return numbers([word for row in padded for word in row]).reshape(len(rows), columns)


def _is_numbers(row: list[bytes], needed: int) -> bool:
    try:
        return len([float(word) for word in row]) >= needed
    except ValueError:
        return False


def _corner_word(vertex: int, uv: int, normal: int) -> bytes:
    """A corner by its numbers from 1, 0 for none."""
    if normal:
        return b"%d/%d/%d" % (vertex, uv, normal) if uv else b"%d//%d" % (vertex, normal)
    return b"%d/%d" % (vertex, uv) if uv else b"%d" % vertex


def _with_normal(corner: bytes, number: int) -> bytes:
    return b"%b/%d" % (corner.rpartition(b"/")[0], number) if number else corner


def _normal_line(normal: list[float]) -> bytes:
    return b"vn %.6f %.6f %.6f" % tuple(normal)


def _regular_rows(lines: list[bytes], element: bytes) -> NDArray[np.float64] | None:
    """Numbers [line, column] where all lines have equally many, else None; a NaN marks where a line begins."""
    with suppress(ValueError):
        table = numbers_in(b"\n".join(lines).replace(element, b"nan ")).reshape(len(lines), -1)
        if np.isnan(table[:, :1]).all() and table.shape[1] > 1:
            return table[:, 1:]
    return None


def _corners(lines: list[bytes]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers [corner, 3] as they are written, 0 where there is none, and corners [line] of each face."""
    with suppress(ValueError):  # anything but vertices alone
        written = numbers_in(b"\n".join(lines).replace(b"f", b" 0 "), np.int64)
        starts = np.flatnonzero(written == 0)  # no vertex has this number
        if len(starts) == len(lines):
            table = np.zeros((len(written) - len(lines), 3), np.int64)
            table[:, 0] = written[written != 0]
            return table, np.diff(starts, append=len(written)) - 1
    return _written_corners(lines), np.array([len(_words(line)) - 1 for line in lines], np.int64)


def _written_corners(lines: list[bytes]) -> NDArray[np.int64]:
    """The same of faces with texture coordinates or normals; files hold one form of corner, as a rule."""
    bare = [line.partition(b"#")[0] if b"#" in line else line for line in lines]
    for columns, pattern in _PATTERNS.items():
        if bare and all(map(pattern.fullmatch, bare)):
            joined = b" ".join(bare).replace(b"f", b" ").replace(b"/", b" ")
            numbers = np.fromstring(joined, dtype=np.int64, sep=" ").reshape(-1, len(columns))
            table = np.zeros((len(numbers), 3), np.int64)
            table[:, columns] = numbers
            return table
    corners = [[*word.split(b"/"), b"", b""][:3] for line in bare for word in line.split()[1:]]
    return np.array([[int(part or b"0") for part in corner] for corner in corners], np.int64).reshape(-1, 3)


def vertex_lines(vertices: NDArray[np.floating]) -> str:
    """Return vertices [vertex, 3] as lines of a file, with nine significant digits: as many as tell all float32 apart.

    So what is read back is the same number bit for bit; with the six or eight decimals that are common it is not.
    """
    return "v %.9g %.9g %.9g\n" * len(vertices) % tuple(vertices.ravel().tolist())


def face_lines(faces: NDArray[np.integer]) -> str:
    """Return triangles [face, 3] as lines of a file, which counts vertices from 1."""
    return "f %d %d %d\n" * len(faces) % tuple((faces.ravel().astype(np.int64) + 1).tolist())


def _built(surface: Surface, vertices: NDArray[np.float64], name: str, stem: str | None) -> Encoded:
    from datagen.mesh.formats.obj_export import built_obj

    return built_obj(surface, vertices, name, stem)


def read_obj(path: Path, geometries: Sequence[str]) -> ObjContent:
    """Read a file as one mesh, or objects and groups of it by name (MeshError where it has none of that name)."""
    content = ObjContent(read_bounded(path, limit=BYTE_LIMIT), path)
    return content.only(geometries) if geometries else content


def _names(path: Path) -> tuple[str, ...]:
    return read_obj(path, ()).sections


FORMATS = {".obj": Format(read_obj, _built, _names)}
