"""Materials and textures of glTF files: names, base colours, and images inside the file or beside it."""

import base64
from urllib.parse import unquote

from datagen.common.errors import UnsafeFileError
from datagen.common.files import read_bounded, resolve_within
from datagen.mesh.formats.gltf import LARGEST, Gltf, Json
from datagen.mesh.formats.surface import Image, Material


def base_texture(file: Gltf, number: int) -> Json:
    """Return how a material names the texture of its base colour; nothing for no material."""
    materials = file.json.get("materials", [])
    if not 0 <= number < len(materials):
        return {}
    return materials[number].get("pbrMetallicRoughness", {}).get("baseColorTexture", {})


def read_material(file: Gltf, number: int) -> Material:
    """Name, base colour and its texture."""
    material = file.json["materials"][number]
    look = material.get("pbrMetallicRoughness", {})
    red, green, blue, alpha = map(float, look.get("baseColorFactor", (1, 1, 1, 1)))
    texture = base_texture(file, number).get("index")
    image = None
    if texture is not None and "source" in file.json["textures"][texture]:
        image = _image(file, file.json["textures"][texture]["source"])
    return Material(str(material.get("name") or f"material_{number}"), (red, green, blue, alpha), image)


def _image(file: Gltf, number: int) -> Image | None:
    image = file.json["images"][number]
    content = image_bytes(file, image)
    return Image(str(image.get("name") or f"image_{number}"), content) if content is not None else None


def image_bytes(file: Gltf, image: Json) -> bytes | None:
    """Return the bytes of an image inside the file, or in a file beside it; None where they are nowhere."""
    content = _image_content(file, image)
    file.require_room(("image", id(image)), len(content or b""))
    return content


def _image_content(file: Gltf, image: Json) -> bytes | None:
    if "bufferView" in image:
        return file.view(image["bufferView"])
    uri = str(image.get("uri", ""))
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    try:  # another's files are not to be carried off
        return read_bounded(resolve_within(file.path.parent, unquote(uri)), limit=LARGEST)
    except (UnsafeFileError, OSError, ValueError):
        return None
