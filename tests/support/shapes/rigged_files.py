"""Small rigged glTF characters, written from nothing: boxes on joints whose every number a test can know."""

import base64
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
Keys = tuple[list[float], list[Any], str]
"""Times in seconds, quaternions (x, y, z, w), interpolation."""

JOINTS: dict[str, tuple[str | None, tuple[float, float, float]]] = {
    "Hips": (None, (0.0, 1.0, 0.0)),
    "Spine": ("Hips", (0.0, 1.3, 0.0)),
    "Neck": ("Spine", (0.0, 1.6, 0.0)),
    "Head": ("Neck", (0.0, 1.7, 0.1)),
    "Leg.L": ("Hips", (0.2, 0.9, 0.0)),
    "Foot.L": ("Leg.L", (0.2, 0.2, 0.0)),
    "Leg.R": ("Hips", (-0.2, 0.9, 0.0)),
    "Foot.R": ("Leg.R", (-0.2, 0.2, 0.0)),
}
"""A small person facing +Z: parent and position in metres of each joint."""

BOXES: list[tuple[tuple[float, float, float], tuple[float, float, float], str, str]] = [
    ((-0.25, 0.95, -0.1), (0.25, 1.55, 0.1), "Hips", "Spine"),
    ((-0.1, 1.55, -0.05), (0.1, 1.9, 0.25), "Neck", "Head"),
    ((0.1, 0.15, -0.05), (0.3, 0.9, 0.05), "Foot.L", "Leg.L"),
    ((0.1, 0.0, -0.05), (0.3, 0.14, 0.3), "Foot.L", "Foot.L"),
    ((-0.3, 0.15, -0.05), (-0.1, 0.9, 0.05), "Foot.R", "Leg.R"),
    ((-0.3, 0.0, -0.05), (-0.1, 0.14, 0.3), "Foot.R", "Foot.R"),
]
"""Two corners in metres, and the joints of the lower and of the upper four vertices."""

_SQUARES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


class Document:
    """A glTF document that grows by accessors."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}
        self.binary = bytearray()

    def view(self, content: bytes, **extra: Any) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        place = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        self.json["bufferViews"].append(place | extra)
        self.binary += content
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values: Any, kind: str = "float32", **extra: Any) -> int:
        array = np.asarray(values, kind)
        array = array.reshape(len(array), -1)
        described = {"componentType": COMPONENTS[kind], "count": len(array), "type": KINDS[array.shape[1]]}
        self.json["accessors"].append({"bufferView": self.view(array.tobytes())} | described | extra)
        return len(self.json["accessors"]) - 1

    def save(self, path: Path, *, buffer: str = "beside") -> Path:
        """Write a .glb, or a .gltf with its buffer ``beside`` it or ``inside``, by the ending."""
        path.parent.mkdir(parents=True, exist_ok=True)
        content = bytes(self.binary + b"\0" * (-len(self.binary) % 4))
        self.json["buffers"] = [{"byteLength": len(content)}]
        if path.suffix == ".glb":
            path.write_bytes(self._packed(content))
            return path
        inside = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
        self.json["buffers"][0]["uri"] = inside if buffer == "inside" else f"{path.stem}%20data.bin"
        if buffer == "beside":
            (path.parent / f"{path.stem} data.bin").write_bytes(content)
        path.write_text(json.dumps(self.json))
        return path

    def _packed(self, content: bytes) -> bytes:
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(content), 0x004E4942)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(content)) + chunks + content


@dataclass
class Rig:
    """A character to be written, and the ways in which files differ that mean the same."""

    joints: dict[str, tuple[str | None, tuple[float, float, float]]] = field(default_factory=lambda: dict(JOINTS))
    boxes: list[Any] = field(default_factory=lambda: list(BOXES))
    clips: dict[str, dict[str, Keys]] = field(default_factory=dict)
    mesh_axes: Floats = field(default_factory=lambda: np.eye(3))
    """How the mesh is turned before it is written; the armature node turns it back by ``armature``."""
    armature: Floats = field(default_factory=lambda: np.eye(3))
    units: float = 1.0
    """Units of the mesh in a metre; the armature node undoes it."""
    bones: str = "turned"
    shown: dict[str, Floats] = field(default_factory=dict)
    """Rotations of joints in the scene as it is shown, where it is not the bind pose."""
    weights: str = "float32"
    factor: float = 1.0
    """What all weights are multiplied by."""
    pieces: int = 1
    skins: int = 1
    inwards: bool = False

    def bind(self) -> dict[str, Floats]:
        """World matrices of the joints in the mesh's own space; their axes are turned, as an animator's are."""
        matrices = {}
        for number, (name, (_, place)) in enumerate(self.joints.items()):
            matrix = np.eye(4)
            turn = Rotation.from_euler("xyz", [0.3 * number, 0.2, -0.1 * number]).as_matrix()
            matrix[:3, :3] = self.mesh_axes @ (turn if self.bones == "turned" else np.eye(3))
            matrix[:3, 3] = self.units * self.mesh_axes @ place
            matrices[name] = matrix
        return matrices

    def surface(self) -> tuple[Floats, NDArray[np.int64], list[str]]:
        """Vertices in metres, triangles, and each vertex' joint."""
        vertices: list[list[float]] = []
        faces: list[list[int]] = []
        joints: list[str] = []
        for low, high, below, above in self.boxes:
            first = len(joints)
            for corner in range(8):
                ends = [(high if corner >> axis & 1 else low)[axis] for axis in range(3)]
                vertices.append(ends)
                joints.append(above if corner >> 1 & 1 else below)
            for a, b, c, d in _SQUARES:
                faces += [[first + a, first + b, first + c], [first + a, first + c, first + d]]
        turned = np.array(faces)
        return np.array(vertices), turned[:, ::-1] if self.inwards else turned, joints

    def save(self, path: Path, **options: Any) -> Path:
        """Write the character."""
        return self.document().save(path, **options)

    def document(self) -> Document:
        document, names = Document(), list(self.joints)
        nodes = self._nodes()
        armature = len(names)
        bind = self.bind()
        document.json |= {"nodes": nodes, "skins": [], "meshes": [], "scenes": [{"nodes": [armature]}], "scene": 0}
        columns = np.array([np.linalg.inv(bind[name]).T.ravel() for name in names])
        for skin in range(self.skins):
            matrices = document.accessor(columns)
            document.json["skins"].append({"joints": list(range(len(names))), "inverseBindMatrices": matrices})
            document.json["meshes"].append({"primitives": self._primitives(document, names, skin)})
            nodes.append({"name": f"mesh{skin}", "mesh": skin, "skin": skin})
            nodes[armature]["children"].append(len(nodes) - 1)
        if self.clips:
            document.json["animations"] = [self._animation(document, name) for name in self.clips]
        return document

    def _nodes(self) -> list[dict[str, Any]]:
        bind, names = self.bind(), list(self.joints)
        nodes: list[dict[str, Any]] = [{"name": name, "children": []} for name in names]
        scale = [1 / self.units] * 3
        top: dict[str, Any] = {
            "name": "Armature",
            "children": [],
            "scale": scale,
            "rotation": quaternion(self.armature),
        }
        for number, (name, (parent, _)) in enumerate(self.joints.items()):
            local = bind[name] if parent is None else np.linalg.inv(bind[parent]) @ bind[name]
            rotation = self.shown.get(name, np.eye(3)) @ local[:3, :3]
            nodes[number] |= {"translation": local[:3, 3].tolist(), "rotation": quaternion(rotation)}
            (top if parent is None else nodes[names.index(parent)])["children"].append(number)
        return [*nodes, top]

    def _primitives(self, document: Document, names: list[str], skin: int) -> list[dict[str, Any]]:
        vertices, faces, joints = self.surface()
        mine = np.array_split(faces, self.skins)[skin]
        found = []
        for piece in np.array_split(mine, self.pieces):
            used, corners = np.unique(piece, return_inverse=True)
            attributes = {"POSITION": document.accessor(self.units * vertices[used] @ self.mesh_axes.T)}
            attributes |= self._influences(document, [names.index(joints[vertex]) for vertex in used])
            indices = document.accessor(corners.ravel(), "uint16")
            found.append({"attributes": attributes, "indices": indices})
        return found

    def _influences(self, document: Document, joints: list[int]) -> dict[str, int]:
        """The joint in the second place; in two sets of four, all but a little of it in the second set."""
        rows = len(joints)
        numbers, weights = np.zeros((rows, 8)), np.zeros((rows, 8))
        numbers[:, 1] = numbers[:, 6] = joints
        weights[:, 1] = 1.0
        if self.weights == "two sets":
            weights[:, 1], weights[:, 6] = 0.25, 0.75
        kind = self.weights if self.weights.startswith("uint") else "float32"
        largest = np.iinfo(kind).max if kind != "float32" else self.factor
        extra = {"normalized": True} if kind != "float32" else {}
        sets = 2 if self.weights == "two sets" else 1
        found = {}
        for each in range(sets):
            some = slice(4 * each, 4 * each + 4)
            found[f"JOINTS_{each}"] = document.accessor(numbers[:, some], "uint16" if each else "uint8")
            found[f"WEIGHTS_{each}"] = document.accessor(weights[:, some] * largest, kind, **extra)
        return found

    def _animation(self, document: Document, clip: str) -> dict[str, Any]:
        channels: list[dict[str, Any]] = []
        samplers: list[dict[str, Any]] = []
        for joint, (times, values, interpolation) in self.clips[clip].items():
            target = {"node": list(self.joints).index(joint), "path": "rotation"}
            channels.append({"sampler": len(samplers), "target": target})
            keys = {"input": document.accessor(times), "output": document.accessor(np.reshape(values, (-1, 4)))}
            samplers.append(keys | {"interpolation": interpolation})
        return {"name": clip, "channels": channels, "samplers": samplers}

    def local_rotation(self, joint: str) -> Floats:
        """The rotation [3, 3] of a joint's node relative to its parent in the bind pose."""
        bind, parent = self.bind(), self.joints[joint][0]
        return bind[joint][:3, :3] if parent is None else (np.linalg.inv(bind[parent]) @ bind[joint])[:3, :3]

    def keys(self, joint: str, turns: list[Floats], times: list[float], interpolation: str = "LINEAR") -> Keys:
        """Keys that turn a joint from its bind pose by ``turns`` [3, 3], in its parent's axes."""
        return times, [quaternion(turn @ self.local_rotation(joint)) for turn in turns], interpolation


def quaternion(rotation: Floats) -> list[float]:
    """(x, y, z, w) of a matrix [3, 3]."""
    return [float(value) for value in Rotation.from_matrix(rotation).as_quat()]


def about(axis: str, degrees: float) -> Floats:
    """A rotation [3, 3] about an axis of the coordinates."""
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def nodding(path: Path, **options: Any) -> Path:
    """A small person with two animations: "Nod" of a second, "Kick" of half a second."""
    rig, still = Rig(**options), np.eye(3)
    rig.clips["Nod"] = {"Neck": rig.keys("Neck", [still, about("x", 60)], [0.0, 1.0])}
    rig.clips["Kick"] = {"Leg.L": rig.keys("Leg.L", [still, about("x", -90)], [0.0, 0.5])}
    return rig.save(path)
