"""The golden mesh files, and a GLB scene that tests change before it is written."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np

from datagen.mesh.formats.gltf import Gltf
from tests.support.shapes.rigged_files import Document

GOLDEN = Path(__file__).parents[2] / "golden" / "meshes"
PNG = (GOLDEN / "skin of me.png").read_bytes()
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def scene(**primitive: Any) -> Document:
    """A textured tetrahedron with normals, in two primitives that share vertices, below a node that moves it."""
    document = Document()
    shared = {
        "POSITION": document.accessor(POINTS),
        "NORMAL": document.accessor(POINTS / np.maximum(np.linalg.norm(POINTS, axis=1, keepdims=True), 1)),
        "TEXCOORD_0": document.accessor(POINTS[:, :2] / 4),
        "_MARK": document.accessor(np.arange(4), "uint16"),
    }
    pieces = [
        {"attributes": dict(shared), "indices": document.accessor(part.ravel(), "uint16"), "material": number}
        for number, part in enumerate((FACES[:2], FACES[2:]))
    ]
    image = document.view(PNG)
    document.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "root", "children": [1], "translation": [10, 0, 0], "rotation": [0, 0, 0.5**0.5, 0.5**0.5]},
            {"name": "body", "mesh": 0, "scale": [2, 2, -2]},
        ],
        "meshes": [{"primitives": [piece | primitive for piece in pieces]}],
        "materials": [
            {"name": "skin", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "emissiveFactor": [0.1, 0, 0]},
            {"name": "cloth", "pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}},
        ],
        "textures": [{"source": 0}],
        "images": [{"bufferView": image, "mimeType": "image/png"}],
    }
    return document


def golden(name: str, folder: Path) -> Path:
    """A copy of a golden mesh, with the material library and the texture that it may name."""
    folder.mkdir(parents=True, exist_ok=True)
    for each in (name, "look.mtl", "skin of me.png"):
        shutil.copy(GOLDEN / each, folder)
    return folder / name


def sound(path: Path) -> dict[str, Any]:
    """The JSON of a file whose chunks and buffer views lie as they should."""
    content = path.read_bytes()
    magic, version, length, json_length = struct.unpack_from("<4sIII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content)) and json_length % 4 == 0
    described = json.loads(content[20 : 20 + json_length])
    binary = struct.unpack_from("<I", content, 20 + json_length)[0]
    assert binary == len(content) - 28 - json_length == described["buffers"][0]["byteLength"]
    assert all(
        v["byteOffset"] % 4 == 0 and v["byteOffset"] + v["byteLength"] <= binary for v in described["bufferViews"]
    )
    for accessor in range(len(described["accessors"])):
        Gltf(path).accessor(accessor)
    return described
