"""OBJ files made from the content of another format, with their material library and textures."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.formats.mtl import library_text
from datagen.mesh.formats.obj import vertex_lines
from datagen.mesh.formats.surface import Encoded, Image, Material, Surface, numbered, one_word, shared_normals

_SUFFIXES = {"image/png": ".png", "image/jpeg": ".jpg"}


def built_obj(surface: Surface, vertices: NDArray[np.float64], name: str, stem: str | None) -> Encoded:
    """Return an OBJ file, with ``stem``.mtl and textures named after it; without them where ``stem`` is None."""
    materials = _told_apart(surface.materials) if stem else ()
    images = _images(materials, stem) if stem else {}
    lines = [f"mtllib {stem}.mtl"] if materials else []
    lines += [f"o {one_word(name)}", *_coloured_lines(vertices, surface.colours)]
    columns: list[NDArray[np.int64] | None] = [surface.corners, None, None]
    if surface.uvs is not None:
        columns[1], rows = _distinct(surface.uvs)
        lines += ["vt {:.9g} {:.9g}".format(*row) for row in rows.tolist()]
    if surface.shading is not None:
        columns[2] = surface.shading
        lines += ["vn {:.6f} {:.6f} {:.6f}".format(*row) for row in shared_normals(vertices, surface, surface.shading)]
    lines += _face_lines(columns, surface, materials)
    beside = {file: image.content for file, image in images.values()}
    if materials:
        text = library_text(materials, {material: file for material, (file, _) in images.items()})
        beside[f"{stem}.mtl"] = text.encode()
    return Encoded("\n".join([*lines, ""]).encode(), beside, [] if stem or not surface.materials else ["materials"])


def _told_apart(materials: tuple[Material, ...]) -> tuple[Material, ...]:
    """The materials under names without spaces that differ from each other."""
    found: dict[str, Material] = {}
    for number, material in enumerate(materials):
        name = one_word(material.name)
        found[f"{name}_{number}" if name in found else name] = material
    return tuple(Material(name, material.colour, material.image) for name, material in found.items())


def _images(materials: tuple[Material, ...], stem: str) -> dict[str, tuple[str, Image]]:
    """File name and texture of the materials that have one; a texture that several use is written once."""
    name_of: dict[bytes, str] = {}
    found = {}
    for material in materials:
        if material.image:
            suffix = _SUFFIXES.get(material.image.mime or "", _plain_suffix(material.image.name))
            file = name_of.setdefault(material.image.content, f"{one_word(stem)}-{len(name_of)}{suffix}")
            found[material.name] = (file, material.image)
    return found


def _plain_suffix(name: str) -> str:
    """The ending of a file's name; none where it could be anything but that, as in a name that somebody else chose."""
    suffix = Path(name).suffix
    return suffix if re.fullmatch(r"\.\w{1,8}", suffix, re.ASCII) else ""


def _coloured_lines(vertices: NDArray[np.float64], colours: NDArray[np.uint8] | None) -> list[str]:
    if colours is None:
        return vertex_lines(vertices).splitlines()
    rows = np.concatenate([vertices, colours[:, :3] / 255], axis=1)
    return ["v {:.9g} {:.9g} {:.9g} {:.4f} {:.4f} {:.4f}".format(*row) for row in rows.tolist()]


def _distinct(rows: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The number of each row among the distinct ones, and these."""
    number = numbered(rows.astype(np.float32))
    _, first = np.unique(number, return_index=True)
    return number, rows[first]


def _face_lines(
    columns: list[NDArray[np.int64] | None], surface: Surface, materials: tuple[Material, ...]
) -> Iterator[str]:
    """Faces in their order, with a line before each that changes the material."""
    corner, numbers = _corner_form(columns)
    material_of = surface.material_of if materials and surface.material_of is not None else -np.ones(len(surface.sizes))
    at, current = 0, -1
    for size, material in zip(surface.sizes.tolist(), material_of.astype(int).tolist(), strict=True):
        if material != current:
            current = material
            yield f"usemtl {materials[material].name if material >= 0 else 'none'}"
        yield "f" + corner * size % tuple(numbers[at * corner.count("%d") : (at + size) * corner.count("%d")])
        at += size


def _corner_form(columns: list[NDArray[np.int64] | None]) -> tuple[str, list[int]]:
    """How a corner is written, and all numbers to write, from 1."""
    there = [column for column in columns if column is not None]
    form = {(True, True): " %d/%d/%d", (True, False): " %d/%d", (False, True): " %d//%d", (False, False): " %d"}
    numbers = (np.stack(there, axis=1) + 1).ravel().tolist()
    return form[columns[1] is not None, columns[2] is not None], numbers
