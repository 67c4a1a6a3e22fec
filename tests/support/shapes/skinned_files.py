"""A skinned GLB file read and posed by nothing but the specification of glTF 2.0."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class SkinnedFile:
    """The first primitive of a file whose joints have translations alone."""

    def __init__(self, path: Path) -> None:
        self.path, content = path, path.read_bytes()
        size = struct.unpack_from("<I", content, 12)[0]
        self.json: dict[str, Any] = json.loads(content[20 : 20 + size])
        self._binary = content[28 + size :]
        attributes = self.json["meshes"][0]["primitives"][0]["attributes"]
        self.positions, self.joints, self.weights = (
            self.accessor(attributes[name]) for name in ("POSITION", "JOINTS_0", "WEIGHTS_0")
        )
        self.skin = self.json["skins"][self.json["nodes"][self.json["scenes"][0]["nodes"][0]]["skin"]]
        self.names = [self.json["nodes"][node]["name"] for node in self.skin["joints"]]

    def accessor(self, number: int) -> NDArray[Any]:
        """Values [count, width]."""
        accessor = self.json["accessors"][number]
        view = self.json["bufferViews"][accessor["bufferView"]]
        start, width = view["byteOffset"] + accessor.get("byteOffset", 0), _WIDTHS[accessor["type"]]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        values = np.frombuffer(self._binary, kind, accessor["count"] * width, start)
        return values.reshape(-1, width)

    def posed(self, turns: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Positions [vertex, 3] after joints are turned by rotations [3, 3] of their own (3.7.3.2)."""
        inverse = self.accessor(self.skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        world = self._world(turns)
        matrices = np.stack([world[node] @ bind for node, bind in zip(self.skin["joints"], inverse, strict=True)])
        blended = np.einsum("vi,vijk->vjk", self.weights, matrices[self.joints])
        homogeneous = np.concatenate([self.positions, np.ones((len(self.positions), 1))], axis=1)
        return np.einsum("vjk,vk->vj", blended, homogeneous)[:, :3]

    def _world(self, turns: dict[str, NDArray[np.float64]]) -> dict[int, NDArray[np.float64]]:
        found: dict[int, NDArray[np.float64]] = {}

        def visit(number: int, above: NDArray[np.float64]) -> None:
            node, local = self.json["nodes"][number], np.eye(4)
            local[:3, :3], local[:3, 3] = turns.get(node["name"], np.eye(3)), node.get("translation", (0, 0, 0))
            found[number] = above @ local
            for child in node.get("children", ()):
                visit(child, found[number])

        for root in self.json["scenes"][0]["nodes"]:
            visit(root, np.eye(4))
        return found
