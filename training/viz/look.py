"""What the faces of a mesh look like in its file: colours of vertices, materials and their textures."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from datagen.common.arrays import Floats, Integers
from datagen.mesh.formats.surface import Image, Material, Surface, numbered

_LARGEST = 1024  # pixels of a texture's side, as it is drawn
_MOST_PIXELS = 2**26  # of one that is read at all
_MOST_TEXTURES = 64  # of a mesh; the others leave base colours
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA")  # TIFF: libtiff writes its complaints to stderr
_SEEN = 0.02  # difference of colours by which materials are told from grey, and from each other


@dataclass(frozen=True, eq=False)
class Paint:
    """A base colour (linear RGB in 0..1) and the texture [h, w, 3] (sRGB, uint8) that it is multiplied with."""

    color: tuple[float, float, float]
    texture: npt.NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Look:
    """Paints of faces over the colours of vertices.

    Parameters
    ----------
    paints
        One or more.
    paint_of
        Number [face] of each face's paint.
    uvs
        Texture coordinates [face, 3, 2], the origin at the lower left; None where no paint has a texture.
    colors
        sRGB [vertex, 3] in 0..1, by which paints are multiplied; None: white.
    """

    paints: tuple[Paint, ...]
    paint_of: Integers
    uvs: Floats | None = None
    colors: Floats | None = None

    def fits(self, vertices: int, faces: int) -> bool:
        """Whether it can be that of a mesh with so many vertices and faces."""
        return len(self.paint_of) == faces and (self.colors is None or len(self.colors) == vertices)

    def painted(self, faces: Integers, weights: Floats) -> Floats:
        """Return linear RGB [p, 3] of paints at points of faces [p], by their barycentric weights [3, p]."""
        numbers = self.paint_of[faces]
        found = np.array([paint.color for paint in self.paints])[numbers]
        for number, paint in enumerate(self.paints):
            at = np.flatnonzero(numbers == number)
            if paint.texture is not None and self.uvs is not None and len(at):
                places = np.einsum("kp,pkc->pc", weights[:, at], self.uvs[faces[at]])
                found[at] *= _texels(paint.texture, places)
        return found

    def split(self, faces: Integers) -> tuple[Integers, Integers, Floats]:
        """Return the mesh for a renderer with one texture coordinate a vertex.

        Returns
        -------
        tuple
            The vertex [w] that each of the written ones is, triangles [face, 3] of these, and their coordinates [w, 2].
        """
        corners = np.asarray(faces, np.int64).ravel()
        uvs = np.zeros((len(corners), 2)) if self.uvs is None else self.uvs.reshape(-1, 2)
        number = numbered(np.concatenate([corners[:, None].astype(np.float64), uvs.astype(np.float32)], axis=1))
        _, first = np.unique(number, return_index=True)
        return corners[first], number.reshape(-1, 3), uvs[first]


def look_of(surface: Surface) -> Look | None:
    """Return what a file says of its faces; None where that is nothing, or one grey for all.

    Transparency is not drawn. A texture that cannot be read leaves the base colour.
    """
    paints = tuple(_paints(surface.materials))
    if surface.colours is None and not _is_seen(paints):
        return None
    faces = len(surface.polygon_of_face)
    of_polygon = np.full(len(surface.sizes), -1) if surface.material_of is None else surface.material_of
    paint_of = of_polygon[surface.polygon_of_face] if faces else np.empty(0, np.int64)
    none = Paint((1.0, 1.0, 1.0) if surface.colours is not None else (0.6, 0.6, 0.6))
    return Look(
        (*paints, none),
        np.where(paint_of < 0, len(paints), paint_of),
        None if surface.uvs is None else surface.uvs[surface.triangle_corners],
        None if surface.colours is None else surface.colours[:, :3] / 255,
    )


def _is_seen(paints: tuple[Paint, ...]) -> bool:
    colors = np.array([paint.color for paint in paints]).reshape(-1, 3)
    differs = len(colors) and max(np.ptp(colors, axis=0).max(), np.ptp(colors, axis=1).max()) > _SEEN
    return bool(differs) or any(paint.texture is not None for paint in paints)


def _paints(materials: Sequence[Material]) -> Iterator[Paint]:
    """Paints of materials; a texture that several share is read once."""
    known: dict[bytes, npt.NDArray[np.uint8] | None] = {}
    for material in materials:
        red, green, blue, _ = material.colour
        if material.image and material.image.content not in known:
            known[material.image.content] = _texture(material.image) if len(known) < _MOST_TEXTURES else None
        yield Paint((red, green, blue), known[material.image.content] if material.image else None)


def _texture(image: Image) -> npt.NDArray[np.uint8] | None:
    try:
        with Pillow.open(io.BytesIO(image.content), formats=_FORMATS) as opened:
            if opened.width * opened.height > _MOST_PIXELS:
                return None
            opened.draft("RGB", (_LARGEST, _LARGEST))
            plain = opened.convert("RGB")
    except (OSError, ValueError, SyntaxError, ArithmeticError, LookupError, MemoryError, Pillow.DecompressionBombError):
        return None
    plain.thumbnail((_LARGEST, _LARGEST))
    return np.asarray(plain, np.uint8)


def _texels(texture: npt.NDArray[np.uint8], places: Floats) -> Floats:
    """Linear RGB [p, 3] of a texture that repeats, at coordinates [p, 2]: that of the nearest pixel."""
    height, width = texture.shape[:2]
    share = np.nan_to_num(places) % 1.0
    columns = np.minimum((share[:, 0] * width).astype(np.int64), width - 1)
    rows = np.minimum(((1 - share[:, 1]) * height).astype(np.int64), height - 1)
    return np.asarray((texture[rows, columns] / 255) ** 2.2)
