"""GLB files made from the content of another format."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.formats.glb_writer import Block, Draft, GlbParts, Json
from datagen.mesh.formats.surface import Encoded, Material, Surface, linear, numbered


def built_glb(surface: Surface, vertices: NDArray[np.float64], name: str, stem: str | None) -> Encoded:
    """A GLB file of one node. Without normals in the original its shading is smooth: viewers show facets else."""
    draft, left_out = built_draft(surface, len(vertices), name)
    return Encoded(draft.static(vertices), {}, left_out)


def parts_draft(faces: NDArray[np.int64], part: NDArray[np.integer], materials: Sequence[Material]) -> Draft:
    """A file that lacks only positions and normals: a node and a mesh a part, called after its material.

    ``faces`` [face, 3] have the corners of one part each; ``part`` [vertex] are places in ``materials``, of which all
    are worn. Vertices that are ordered by part come out in their order.
    """
    parts = GlbParts({"asset": {"version": "2.0", "generator": "dsffnet"}, "scene": 0})
    of = np.argsort(part, kind="stable")
    local = np.empty(len(part), np.int64)
    blocks = []
    for number in range(len(materials)):
        vertices = of[part[of] == number]
        local[vertices] = np.arange(len(vertices))
        corners = local[faces[part[faces[:, 0]] == number]].ravel()
        blocks.append(Block(vertices, [{"attributes": {}, "indices": parts.indices(corners), "material": number}]))
    parts.json |= {
        "materials": _materials(tuple(materials), parts)[0],
        "meshes": [{"name": material.name, "primitives": block.primitives}
                   for material, block in zip(materials, blocks, strict=True)],
        "nodes": [{"name": material.name, "mesh": number} for number, material in enumerate(materials)],
        "scenes": [{"nodes": list(range(len(materials)))}],
    }  # fmt: skip
    surface = Surface(faces.ravel(), np.full(len(faces), 3), shading=faces.ravel())
    return Draft(parts, blocks, surface, np.arange(len(part)), np.arange(len(part)))


def built_draft(surface: Surface, count: int, name: str) -> tuple[Draft, list[str]]:
    """Return a file that lacks only positions and normals, and what it cannot hold.

    A glTF vertex has one texture coordinate and one normal. So the mesh's vertices come first, in their order, and
    those that a seam or a sharp edge passes through follow once more for each further side.
    """
    shading = surface.shading if surface.shading is not None else surface.corners
    shaded = Surface(surface.corners, surface.sizes, surface.uvs, shading, surface.colours)
    written, of, first = _split(shaded, count)
    parts = GlbParts({"asset": {"version": "2.0", "generator": "dsffnet"}, "scene": 0})
    attributes = _attributes(shaded, of, first, parts)
    materials, left_out = _materials(surface.materials, parts)
    primitives = [
        {"attributes": dict(attributes), "indices": parts.indices(corners)}
        | ({"material": number} if number >= 0 else {})
        for number, corners in _by_material(surface, written)
    ]
    parts.json |= {"meshes": [{"name": name, "primitives": primitives}]} | (
        {"materials": materials} if materials else {}
    )
    parts.json |= {"nodes": [{"name": name, "mesh": 0}], "scenes": [{"nodes": [0]}]}
    left_out += ["quads: written as triangles"] if surface.has_polygons else []
    left_out += [f"seams: {len(of) - count:,} vertices are written again after the others"] if len(of) > count else []
    group = np.where(first >= 0, shading[first], shading.max(initial=-1) + 1)
    return Draft(parts, [Block(np.arange(len(of)), primitives)], shaded, of, group), left_out


def _split(surface: Surface, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The written vertex [corner] of each corner; the mesh's vertex and the first corner (-1: none) of each written."""
    assert surface.shading is not None
    sides = [surface.corners, surface.shading]
    if surface.uvs is not None:
        sides.append(numbered(surface.uvs.astype(np.float32)))
    number = numbered(np.stack(sides, axis=1))  # in order of appearance
    _, corner = np.unique(number, return_index=True)
    vertex = surface.corners[corner]
    _, leading = np.unique(vertex, return_index=True)
    place = np.full(len(vertex), -1, np.int64)
    place[leading] = vertex[leading]
    further = place < 0
    place[further] = count + np.arange(further.sum())
    of = np.concatenate([np.arange(count), vertex[further]])
    first = np.full(len(of), -1, np.int64)
    first[place] = corner
    return place[number], of, first


def _attributes(surface: Surface, of: NDArray[np.int64], first: NDArray[np.int64], parts: GlbParts) -> dict[str, int]:
    found = {}
    if surface.uvs is not None:
        uvs = np.where(first[:, None] >= 0, surface.uvs[first] * (1, -1) + (0, 1), 0)
        found["TEXCOORD_0"] = parts.attribute(uvs)
    if surface.colours is not None:
        found["COLOR_0"] = parts.attribute(linear(surface.colours)[of], normalized=True)
    return found


def _by_material(surface: Surface, written: NDArray[np.int64]) -> list[tuple[int, NDArray[np.int64]]]:
    """Corners of the triangles of each material, in the order of its first face; -1 is no material."""
    triangles = written[surface.triangle_corners]
    if surface.material_of is None:
        return [(-1, triangles.ravel())]
    numbers = surface.material_of[surface.polygon_of_face]
    return [(number, triangles[numbers == number].ravel()) for number in dict.fromkeys(numbers.tolist())]


def _materials(materials: tuple[Material, ...], parts: GlbParts) -> tuple[list[Json], list[str]]:
    """Materials as glTF has them, matt; textures go into the file."""
    found, left_out = [], []
    for material in materials:
        look: Json = {"baseColorFactor": list(material.colour), "metallicFactor": 0.0, "roughnessFactor": 0.9}
        if material.image and material.image.mime:
            look["baseColorTexture"] = {"index": _texture(material, parts)}
        elif material.image:
            left_out.append(f"texture {material.image.name}: GLB holds PNG and JPEG only")
        blend = {"alphaMode": "BLEND"} if material.colour[3] < 1 else {}
        found.append({"name": material.name, "pbrMetallicRoughness": look, "doubleSided": True} | blend)
    return found, list(dict.fromkeys(left_out))


def _texture(material: Material, parts: GlbParts) -> int:
    """The number of a texture; materials that share a picture share it."""
    assert material.image
    textures, images = parts.json.setdefault("textures", []), parts.json.setdefault("images", [])
    known = next((number for number, each in enumerate(images) if each["name"] == material.image.name), None)
    if known is None:
        view = parts.view(material.image.content)
        images.append({"name": material.image.name, "mimeType": material.image.mime, "bufferView": view})
        textures.append({"source": len(images) - 1})
    return len(images) - 1 if known is None else known
