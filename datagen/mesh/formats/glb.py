"""GLB files as a person has them: one mesh of the scene, in world space, with the file's own materials and textures.

What is posed is what a viewer shows at rest: node transforms, the skin in its rest pose and the morph targets' default
weights are applied. Written again, the mesh has no skin and no morph targets, and the file no animations; the tree of
nodes and their names, materials, textures and texture coordinates are kept. Tangents are left to the viewer to derive
again, as the glTF specification has it (3.7.2.1).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import MeshError
from datagen.mesh.formats.glb_export import built_glb
from datagen.mesh.formats.glb_writer import Block, Draft, GlbParts, Json
from datagen.mesh.formats.gltf import SOLID, Gltf, triangles
from datagen.mesh.formats.gltf_materials import base_texture, image_bytes, read_material
from datagen.mesh.formats.surface import Alone, Encoded, Format, Image, Surface, numbered, srgb
from datagen.mesh.limits import require_counts


def read_glb(path: Path, geometry: str | None) -> "GlbContent":
    """Read one mesh of a scene: the one called ``geometry``, or the only one.

    Raises
    ------
    MeshError
        There are no faces, no such geometry, or several to choose from.
    """
    with path.open("rb") as beginning:
        if beginning.read(4) != b"glTF":
            raise ValueError("it does not begin with 'glTF' (a text, or a .gltf by another name?)")
    scene = Gltf(path)
    nodes = solid_nodes(scene)
    names = ", ".join(map(repr, nodes))
    if not nodes:
        raise MeshError(f"{path} has no faces (a point cloud, lines, or an empty scene?); pose transfer needs a mesh")
    if geometry is not None and geometry not in nodes:
        raise MeshError(f"{path} has no geometry {geometry!r}; it has {names}")
    if geometry is None and len(nodes) > 1:
        how = "--source-geometry NAME or --target-geometry NAME"
        raise MeshError(f"{path} holds {len(nodes)} geometries: {names}. Choose one with {how}")
    name = geometry or next(iter(nodes))
    return GlbContent(scene, name, nodes[name])


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


_KEPT_ON_PRIMITIVES = ("KHR_materials_variants",)
_DERIVED = ("POSITION", "NORMAL", "TANGENT", "JOINTS_", "WEIGHTS_")


@dataclass(frozen=True)
class Piece:
    """A primitive of triangles: its place in the list of primitives, and where its vertices begin in the mesh."""

    number: int
    json: Json
    start: int
    corners: NDArray[np.int64]


class GlbContent(Alone):
    """One mesh of a GLB file; textures that lie beside it are written into the new one."""

    def __init__(self, file: Gltf, name: str, node: int) -> None:
        self.name: str | None = name
        self._file, self._node_number, self._node = file, node, file.nodes[node]
        self._mesh = file.json["meshes"][self._node["mesh"]]
        self._world = file.world[node]
        if abs(np.linalg.det(self._world[:3, :3])) < 1e-30:
            raise ValueError(f"node {name!r} is scaled to nothing: apply its scale and export it again")
        self._starts = self._accessor_starts()
        self._pieces = list(self._read_pieces())
        self.vertices = np.concatenate([self._positions(piece) for piece in self._firsts])
        self.draft()  # what cannot be read is to be known now, not when all is computed

    def _accessor_starts(self) -> dict[int, int]:
        """Where the vertices of each accessor of positions begin in the mesh; primitives may share one."""
        starts, total = dict[int, int](), 0
        for primitive in self._mesh["primitives"]:
            accessor = primitive.get("attributes", {}).get("POSITION")
            if primitive.get("mode", 4) in SOLID and accessor not in starts and accessor is not None:
                starts[accessor] = total
                total += self._file.json["accessors"][accessor]["count"]
        require_counts(vertices=total)
        return starts

    def _read_pieces(self) -> Iterator[Piece]:
        total = 0
        for number, primitive in enumerate(self._mesh["primitives"]):
            mode, accessor = primitive.get("mode", 4), primitive.get("attributes", {}).get("POSITION")
            if mode in SOLID and accessor is not None:
                size = self._file.json["accessors"][accessor]["count"]
                corners = np.arange(size)
                if "indices" in primitive:
                    corners = self._file.accessor(primitive["indices"]).ravel().astype(np.int64)
                if corners.size and corners.max() >= size:
                    raise ValueError(f"a face names vertex {corners.max()}, but there are {size} (from 0)")
                total += len(corners)
                require_counts(corners=total)
                self._require_alike(primitive["attributes"], size)
                yield Piece(number, primitive, self._starts[accessor], triangles(corners, mode).ravel())

    def _require_alike(self, attributes: Json, size: int) -> None:
        """Refuse attributes of another count than the positions (3.7.2.1): they would be copied as they are."""
        for name, number in attributes.items():
            there = self._file.json["accessors"][number]["count"]
            if there != size:
                raise ValueError(f"{name} has {there} elements for {size} vertices")

    @property
    def _firsts(self) -> list[Piece]:
        """The first piece of each accessor of positions."""
        return list({piece.start: piece for piece in reversed(self._pieces)}[start] for start in self._starts.values())

    def _positions(self, piece: Piece) -> NDArray[np.float64]:
        """World positions [vertex, 3] of the accessor that a piece uses."""
        attributes = piece.json["attributes"]
        local = self._file.accessor(attributes["POSITION"]).astype(np.float64)
        weights = self._node.get("weights", self._mesh.get("weights", ()))
        for weight, target in zip(weights, piece.json.get("targets", ()), strict=False):
            if weight and "POSITION" in target:
                local = local + weight * self._file.accessor(target["POSITION"])
        if "skin" not in self._node or "JOINTS_0" not in attributes:
            return _moved(local, self._world)
        return self._skinned(local, attributes)

    def _skinned(self, local: NDArray[np.float64], attributes: Json) -> NDArray[np.float64]:
        """Positions as the skin shows them at rest; the node's own transform does not matter then (3.7.3.3)."""
        skin = self._file.json["skins"][self._node["skin"]]
        joints = self._file.world[skin["joints"]] @ self._file.inverse_bind(skin)
        numbers, weights = self._file.influences(attributes)
        weights = weights / np.maximum(weights.astype(np.float64).sum(axis=1, keepdims=True), 1e-12)
        total = np.zeros_like(local)
        for number, weight in zip(numbers.astype(np.int64).T, weights.T, strict=True):
            matrices = joints[number]
            total += weight[:, None] * (np.einsum("vij,vj->vi", matrices[:, :3, :3], local) + matrices[:, :3, 3])
        return total

    @cached_property
    def surface(self) -> Surface:
        """Triangles of all primitives, one after another, with their materials."""
        numbers = [piece.json.get("material", -1) for piece in self._pieces]
        used = list(dict.fromkeys(number for number in numbers if number >= 0))
        corners = np.concatenate([piece.start + piece.corners for piece in self._pieces])
        of_piece = np.array([used.index(number) if number >= 0 else -1 for number in numbers], np.int64)
        lengths = [len(piece.corners) // 3 for piece in self._pieces]
        return Surface(
            corners,
            np.full(len(corners) // 3, 3, np.int64),
            uvs=self._uvs(),
            shading=self._group[corners] if self._group is not None else None,
            colours=self._colours(),
            material_of=np.repeat(of_piece, lengths) if used else None,
            materials=tuple(read_material(self._file, number) for number in used),
        )

    @cached_property
    def _group(self) -> NDArray[np.int64] | None:
        """Vertices [vertex] that share a normal: those at one place with one normal, as along a seam."""
        if not all("NORMAL" in piece.json["attributes"] for piece in self._pieces):
            return None
        normals = [self._file.accessor(piece.json["attributes"]["NORMAL"]) for piece in self._firsts]
        return numbered(np.concatenate([self.vertices, np.concatenate(normals).astype(np.float64)], axis=1))

    def _uvs(self) -> NDArray[np.float64] | None:
        """Texture coordinates [corner, 2] with their origin moved from the upper to the lower left."""
        if not any("TEXCOORD_0" in piece.json["attributes"] for piece in self._pieces):
            return None
        found = []
        for piece in self._pieces:
            name = f"TEXCOORD_{base_texture(self._file, piece.json.get('material', -1)).get('texCoord', 0)}"
            there = piece.json["attributes"].get(name)
            rows = self._file.accessor(there)[piece.corners] if there is not None else np.zeros((len(piece.corners), 2))
            found.append(rows.astype(np.float64))
        return np.concatenate(found) * (1, -1) + (0, 1)

    def _colours(self) -> NDArray[np.uint8] | None:
        if not all("COLOR_0" in piece.json["attributes"] for piece in self._pieces):
            return None
        found = [self._file.accessor(piece.json["attributes"]["COLOR_0"]) for piece in self._firsts]
        opaque = [np.concatenate([each, np.ones((len(each), 4 - each.shape[1]))], axis=1) for each in found]
        return srgb(np.concatenate(opaque))

    @property
    def only_here(self) -> list[str]:
        """What is lost in every format, and properties of materials beyond a base colour."""
        known = {"name", "pbrMetallicRoughness", "doubleSided", "alphaMode", "alphaCutoff"}
        plain = {"baseColorFactor", "baseColorTexture", "metallicFactor", "roughnessFactor"}
        materials = [
            self._file.json["materials"][n] for n in {p.json.get("material", -1) for p in self._pieces} if n >= 0
        ]
        rich = any(set(m) - known or set(m.get("pbrMetallicRoughness", {})) - plain for m in materials)
        return [*self._lost, *(["material properties beyond base colour and its texture"] if rich else [])]

    @property
    def _lost(self) -> list[str]:
        others = [name for name, number in solid_nodes(self._file).items() if number != self._node_number]
        parts = {
            f"other geometries: {', '.join(others)}": others,
            "skins": self._file.json.get("skins"),
            "animations": self._file.json.get("animations"),
            "morph targets": any("targets" in piece.json for piece in self._pieces),
            "lines and points": len(self._pieces) < len(self._mesh["primitives"]),
        }
        return [name for name, there in parts.items() if there]

    def rewritten(self, vertices: NDArray[np.float64]) -> Encoded:
        """Return the file with other positions and normals, without what moved it before."""
        return Encoded(self.draft().static(vertices), {}, self._lost)

    def draft(self) -> Draft:
        """Return the file without this mesh's positions and normals, to be filled in."""
        parts = GlbParts({k: v for k, v in self._file.json.items() if k not in _REBUILT})
        copied: dict[int, int] = {}
        primitives = [self._primitive(piece, parts, copied) for piece in self._pieces]
        parts.json["meshes"] = [{k: v for k, v in self._mesh.items() if k not in ("weights", "extras")}]
        parts.json["meshes"][0]["primitives"] = primitives
        parts.json["nodes"] = [self._stripped(number, node) for number, node in enumerate(self._file.nodes)]
        if "images" in self._file.json:
            parts.json["images"] = [self._copied_image(image, parts) for image in self._file.json["images"]]
        blocks = []
        for piece in self._firsts:
            sharing = [p for each, p in zip(self._pieces, primitives, strict=True) if each.start == piece.start]
            size = self._file.json["accessors"][piece.json["attributes"]["POSITION"]]["count"]
            blocks.append(Block(np.arange(piece.start, piece.start + size), sharing))
        every = np.arange(len(self.vertices))
        return Draft(parts, blocks, self.surface, every, self._group, np.linalg.inv(self._world))

    def _primitive(self, piece: Piece, parts: GlbParts, copied: dict[int, int]) -> Json:
        kept = {k: v for k, v in piece.json.items() if k not in ("attributes", "targets", "extensions", "indices")}
        extensions = {k: v for k, v in piece.json.get("extensions", {}).items() if k in _KEPT_ON_PRIMITIVES}
        if extensions:
            kept["extensions"] = extensions
        kept["attributes"] = {}
        for name, number in piece.json["attributes"].items():
            if not name.startswith(_DERIVED):
                if number not in copied:
                    copied[number] = parts.attribute(self._file.accessor(number))
                kept["attributes"][name] = copied[number]
        if "indices" in piece.json:
            kept["indices"] = parts.indices(self._file.accessor(piece.json["indices"]).ravel())
        return kept

    def _stripped(self, number: int, node: Json) -> Json:
        mesh = {"mesh": 0} if number == self._node_number else {}
        kept = {k: v for k, v in node.items() if k not in ("mesh", "skin", "weights", "extensions")}
        extensions = {k: v for k, v in node.get("extensions", {}).items() if k != "EXT_mesh_gpu_instancing"}
        return kept | mesh | ({"extensions": extensions} if extensions else {})

    def _copied_image(self, image: Json, parts: GlbParts) -> Json:
        content = image_bytes(self._file, image)
        if content is None:
            return dict(image)
        kept = {k: v for k, v in image.items() if k not in ("uri", "bufferView")}
        mime = Image("", content).mime or image.get("mimeType") or "image/png"
        return kept | {"bufferView": parts.view(content), "mimeType": mime}


_REBUILT = ("accessors", "bufferViews", "buffers", "skins", "animations", "meshes", "nodes", "images")


def _moved(positions: NDArray[np.float64], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return positions @ matrix[:3, :3].T + matrix[:3, 3]


FORMATS = {".glb": Format(read_glb, built_glb)}
