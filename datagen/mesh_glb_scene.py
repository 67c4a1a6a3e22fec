"""A GLB file's scene: which of its nodes have a mesh, and what their materials look like."""

import base64
from urllib.parse import unquote

import numpy as np

from datagen.errors import UnsafeFileError
from datagen.files import read_bounded, resolve_within
from datagen.gltf import LARGEST, Gltf
from datagen.mesh_glb_written import Json
from datagen.mesh_surface import Image, Material

SOLID = (4, 5, 6)
"""Modes of primitives with faces: triangles, strips, fans."""


class GlbFile(Gltf):
    """A glTF file whose buffer views can be had as bytes."""

    def view(self, number: int) -> bytes:
        """The bytes of a buffer view."""
        return self._elements(
            number, 0, np.dtype(np.uint8), self.json["bufferViews"][number]["byteLength"], 1
        ).tobytes()


def solid_nodes(file: Gltf) -> dict[str, int]:
    """Nodes with a mesh of triangles, by name; names that come again get a number."""
    found: dict[str, int] = {}
    for number, node in enumerate(file.nodes):
        if "mesh" in node:
            mesh = file.json["meshes"][node["mesh"]]
            if any(each.get("mode", 4) in SOLID for each in mesh["primitives"]):
                name = str(node.get("name") or mesh.get("name") or f"mesh {node['mesh']}")
                found[f"{name} #{number}" if name in found else name] = number
    return found


def base_texture(file: GlbFile, number: int) -> Json:
    """How a material names the texture of its base colour; nothing for no material."""
    materials = file.json.get("materials", [])
    if not 0 <= number < len(materials):
        return {}
    return materials[number].get("pbrMetallicRoughness", {}).get("baseColorTexture", {})


def read_material(file: GlbFile, number: int) -> Material:
    """Name, base colour and its texture."""
    material = file.json["materials"][number]
    look = material.get("pbrMetallicRoughness", {})
    red, green, blue, alpha = map(float, look.get("baseColorFactor", (1, 1, 1, 1)))
    texture = base_texture(file, number).get("index")
    image = None
    if texture is not None and "source" in file.json["textures"][texture]:
        image = _image(file, file.json["textures"][texture]["source"])
    return Material(str(material.get("name") or f"material_{number}"), (red, green, blue, alpha), image)


def _image(file: GlbFile, number: int) -> Image | None:
    image = file.json["images"][number]
    content = image_bytes(file, image)
    return Image(str(image.get("name") or f"image_{number}"), content) if content is not None else None


def image_bytes(file: GlbFile, image: Json) -> bytes | None:
    """The bytes of an image inside the file, or in a file beside it; None where they are nowhere."""
    content = _image_content(file, image)
    file.require_room(("image", id(image)), len(content or b""))
    return content


def _image_content(file: GlbFile, image: Json) -> bytes | None:
    if "bufferView" in image:
        return file.view(image["bufferView"])
    uri = str(image.get("uri", ""))
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    try:  # another's files are not to be carried off
        return read_bounded(resolve_within(file.path.parent, unquote(uri)), limit=LARGEST)
    except (UnsafeFileError, OSError, ValueError):
        return None
