"""OBJ files of bare vertices and triangles, read and written several times faster than by a general library.

Data sets of pose transfer are tens of thousands of such files. Whatever else a file may hold (texture coordinates,
polygons, relative indices ...) is left to :mod:`datagen.mesh.geometry`, which asks here first.
"""

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

_OTHER_VERTEX_DATA = (b"vn", b"vt", b"vp")


def vertex_lines(vertices: NDArray[np.float32]) -> str:
    """Vertices [vertex, 3] as lines of an OBJ file, with nine significant digits: as many as tell all float32 apart.

    So what is read back is the same number bit for bit; with the six or eight decimals that are common it is not.
    """
    return "v %.9g %.9g %.9g\n" * len(vertices) % tuple(vertices.ravel().tolist())


def face_lines(faces: NDArray[np.integer]) -> str:
    """Triangles [face, 3] as lines of an OBJ file, which counts vertices from 1."""
    return "f %d %d %d\n" * len(faces) % tuple((faces.ravel().astype(np.int64) + 1).tolist())


def read_plain(content: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
    """Vertices [vertex, 3] and triangles [face, 3] of a plain OBJ file; None where it is anything else, or broken."""
    vertices: list[bytes] = []
    faces: list[bytes] = []
    lines_of = {b"v ": vertices, b"f ": faces}
    for line in content.splitlines():
        start = line[:2]
        if start in lines_of:
            lines_of[start].append(line[2:])
        elif start[:1] in (b"v", b"f", b" ", b"\t") and start not in _OTHER_VERTEX_DATA:
            return None
    if b"\\" in content:  # lines that go on in the next
        return None
    positions, corners = _triples(vertices, np.float64), _triples(faces, np.int64)
    if positions is None or corners is None or corners.min() < 1:
        return None
    return positions, corners - 1


def _triples(lines: list[bytes], kind: type[np.generic]) -> NDArray[Any] | None:
    """The three numbers of each line [line, 3]."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy only warns where it stops at what is no number
            numbers = np.fromstring(b"\n".join(lines), dtype=kind, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    return numbers.reshape(-1, 3) if lines and numbers.size == 3 * len(lines) else None
