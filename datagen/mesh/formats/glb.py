"""GLB files as a person has them: meshes of the scene, in world space, with the file's own materials and textures.

What is posed is what a viewer shows at rest: node transforms, the skin in its rest pose and the morph targets' default
weights are applied. Several geometries (body, hair, hat) are one mesh. Written again, each has a mesh of its own below
its node, no skin and no morph targets, and the file no animations; the tree of nodes and their names, materials,
textures and texture coordinates are kept. Tangents are left to the viewer to derive again, as the glTF specification
has it (3.7.2.1).
"""

from collections.abc import Iterator, Mapping, Sequence
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
from datagen.mesh.formats.surface import Alone, Encoded, Format, Image, Surface, numbered, srgb, unit
from datagen.mesh.geometries import require_few, require_known_names, require_one_body
from datagen.mesh.geometry import NEEDS_FACES
from datagen.mesh.limits import require_counts


def read_glb(path: Path, geometries: Sequence[str]) -> "GlbContent":
    """Read geometries of a scene as one mesh: those of these names, or all that it shows.

    Raises
    ------
    MeshError
        There are no faces, no such geometry, or several that do not make one body.
    """
    scene = _opened(path)
    nodes = solid_nodes(scene)
    if not nodes:
        raise MeshError(f"{path} has no faces (a point cloud, lines, or an empty scene?); {NEEDS_FACES}")
    require_known_names(geometries, nodes, path, what="geometry")
    shown = {name: node for name, node in nodes.items() if node in scene.shown and not _is_nothing(scene, node)}
    taken = {name: node for name, node in nodes.items() if name in geometries} or shown or nodes
    if not geometries:
        require_few(list(taken), path)
    content = GlbContent(scene, taken)
    if not geometries:
        require_one_body(content.extents, path)
    return content


def _opened(path: Path) -> Gltf:
    with path.open("rb") as beginning:
        if beginning.read(4) != b"glTF":
            raise ValueError("it does not begin with 'glTF' (a text, or a .gltf by another name?)")
    return Gltf(path)


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


def _is_nothing(file: Gltf, node: int) -> bool:
    """Whether a node is scaled to nothing, by which some programs hide what is there."""
    return bool(abs(np.linalg.det(file.world[node][:3, :3])) < 1e-30)


_KEPT_ON_PRIMITIVES = ("KHR_materials_variants",)
_DERIVED = ("POSITION", "NORMAL", "TANGENT", "JOINTS_", "WEIGHTS_")


@dataclass(frozen=True)
class Piece:
    """A primitive of triangles: its node and JSON, where its vertices begin in the mesh, its corners from there."""

    node: int
    json: Json
    start: int
    corners: NDArray[np.int64]

    @property
    def accessor(self) -> tuple[int, int]:
        """Its node and accessor of positions, which primitives of a mesh may share; nodes with one mesh do not."""
        return self.node, self.json["attributes"]["POSITION"]


class GlbContent(Alone):
    """Geometries of a GLB file as one mesh; textures that lie beside it are written into the new one."""

    def __init__(self, file: Gltf, nodes: Mapping[str, int]) -> None:
        self.geometries = tuple(nodes)
        self.name: str | None = self.geometries[0] if len(nodes) == 1 else None
        self._file, self._nodes = file, {node: place for place, node in enumerate(nodes.values())}
        for name, node in nodes.items():
            if _is_nothing(file, node):
                raise ValueError(f"node {name!r} is scaled to nothing: apply its scale and export it again")
        self._pieces = list(self._read_pieces())
        firsts: dict[tuple[int, int], Piece] = {}
        for piece in self._pieces:
            firsts.setdefault(piece.accessor, piece)
        self._firsts = list(firsts.values())
        self.vertices = self.moved(file.world, {})
        self.draft()  # what cannot be read is to be known now, not when all is computed

    @property
    def gltf(self) -> Gltf:
        """The file with all that moves it."""
        return self._file

    def moved(self, world: NDArray[np.float64], weights: Mapping[int, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return vertices [n, 3] where the nodes stand so: ``world`` [node, 4, 4].

        ``weights`` [target] of morph targets by node; those that are not there are the file's own.
        """
        positions = [self._positions(piece, world, weights) for piece in self._firsts]
        return np.concatenate([np.empty((0, 3)), *positions])

    @property
    def extents(self) -> dict[str, NDArray[np.float64]]:
        """Least and greatest coordinates [2, 3] of each geometry that has vertices."""
        own: dict[str, list[NDArray[np.float64]]] = {}
        for piece in self._firsts:
            own.setdefault(self.geometries[self._nodes[piece.node]], []).append(self.vertices[self._rows(piece)])
        joined = {name: np.concatenate(parts) for name, parts in own.items()}
        return {name: np.stack([each.min(axis=0), each.max(axis=0)]) for name, each in joined.items()}

    def _rows(self, piece: Piece) -> slice:
        return slice(piece.start, piece.start + self._file.json["accessors"][piece.accessor[1]]["count"])

    def _read_pieces(self) -> Iterator[Piece]:
        starts, vertices, corners = dict[tuple[int, int], int](), 0, 0
        for node in self._nodes:
            is_mirrored = "skin" not in self._file.nodes[node] and np.linalg.det(self._file.world[node][:3, :3]) < 0
            for primitive in self._primitives(node):
                mode, accessor = primitive.get("mode", 4), primitive.get("attributes", {}).get("POSITION")
                if mode not in SOLID or accessor is None:
                    continue
                size = self._file.json["accessors"][accessor]["count"]
                if (node, accessor) not in starts:
                    starts[node, accessor], vertices = vertices, vertices + size
                    require_counts(vertices=vertices)
                self._require_alike(primitive["attributes"], size)
                found = self._corners(primitive, size)
                corners += len(found)
                require_counts(corners=corners)
                faces = triangles(found, mode)
                turned = faces[:, ::-1] if is_mirrored else faces  # 3.7.4: a mirror turns what is in front
                yield Piece(node, primitive, starts[node, accessor], turned.ravel())

    def _primitives(self, node: int) -> list[Json]:
        found: list[Json] = self._file.json["meshes"][self._file.nodes[node]["mesh"]]["primitives"]
        return found

    def _corners(self, primitive: Json, size: int) -> NDArray[np.int64]:
        """Vertices of the accessor at the corners [corner] of a primitive, in its own order."""
        if "indices" not in primitive:
            return np.arange(size)
        corners = self._file.accessor(primitive["indices"]).ravel().astype(np.int64)
        if corners.size and corners.max() >= size:
            raise ValueError(f"a face names vertex {corners.max()}, but there are {size} (from 0)")
        return corners

    def _require_alike(self, attributes: Json, size: int) -> None:
        """Refuse attributes of another count than the positions (3.7.2.1): they would be copied as they are."""
        for name, number in attributes.items():
            there = self._file.json["accessors"][number]["count"]
            if there != size:
                raise ValueError(f"{name} has {there} elements for {size} vertices")

    def _positions(
        self, piece: Piece, world: NDArray[np.float64], animated: Mapping[int, NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """World positions [vertex, 3] of the accessor that a piece uses."""
        attributes, node = piece.json["attributes"], self._file.nodes[piece.node]
        local = self._file.accessor(attributes["POSITION"]).astype(np.float64)
        own = node.get("weights", self._file.json["meshes"][node["mesh"]].get("weights", ()))
        weights = animated.get(piece.node, own)
        for weight, target in zip(weights, piece.json.get("targets", ()), strict=False):
            if weight and "POSITION" in target:
                local = local + weight * self._file.accessor(target["POSITION"])
        if "skin" not in node or "JOINTS_0" not in attributes:
            return _moved(local, world[piece.node])
        return self._skinned(local, attributes, self._file.json["skins"][node["skin"]], world)

    def _skinned(
        self, local: NDArray[np.float64], attributes: Json, skin: Json, world: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Positions as the skin shows them; the node's own transform does not matter then (3.7.3.3)."""
        joints = world[skin["joints"]] @ self._file.inverse_bind(skin)
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
        used = {number: place for place, number in enumerate(dict.fromkeys(n for n in numbers if n >= 0))}
        corners = np.concatenate([piece.start + piece.corners for piece in self._pieces])
        of_piece = np.array([used.get(number, -1) for number in numbers], np.int64)
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
        if not any("NORMAL" in piece.json["attributes"] for piece in self._pieces):
            return None
        normals = [self._normals(piece) for piece in self._firsts]
        return numbered(np.concatenate([self.vertices, np.concatenate(normals)], axis=1))

    def _normals(self, piece: Piece) -> NDArray[np.float64]:
        """The file's normals [vertex, 3] in world space, but for the skin; zeros where there are none."""
        if "NORMAL" not in piece.json["attributes"]:
            return np.zeros((self._file.json["accessors"][piece.accessor[1]]["count"], 3))
        local = self._file.accessor(piece.json["attributes"]["NORMAL"]).astype(np.float64)
        if "skin" in self._file.nodes[piece.node]:
            return local
        return unit(local @ np.linalg.inv(self._file.world[piece.node][:3, :3]))

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
        """Colours [vertex, 4] of those pieces that have any; the others are white, which changes nothing (3.9.2)."""
        if not any("COLOR_0" in piece.json["attributes"] for piece in self._pieces):
            return None
        return srgb(np.concatenate([self._colours_of(piece) for piece in self._firsts]))

    def _colours_of(self, piece: Piece) -> NDArray[np.float64]:
        rows = self._rows(piece)
        found = np.ones((rows.stop - rows.start, 4))
        if "COLOR_0" in piece.json["attributes"]:
            colours = self._file.accessor(piece.json["attributes"]["COLOR_0"])
            found[:, : colours.shape[1]] = colours
        return found

    @property
    def only_here(self) -> list[str]:
        """What is lost in every format, and properties of materials beyond a base colour."""
        known = {"name", "pbrMetallicRoughness", "doubleSided", "alphaMode", "alphaCutoff"}
        plain = {"baseColorFactor", "baseColorTexture", "metallicFactor", "roughnessFactor"}
        materials = [
            self._file.json["materials"][n] for n in {p.json.get("material", -1) for p in self._pieces} if n >= 0
        ]
        rich = any(set(m) - known or set(m.get("pbrMetallicRoughness", {})) - plain for m in materials)
        names = ["names of its geometries"] if len(self.geometries) > 1 else []
        return [*self.lost, *names, *(["material properties beyond base colour and its texture"] if rich else [])]

    @property
    def lost(self) -> list[str]:
        """What of the file is in none that is written of it."""
        others = {name: node for name, node in solid_nodes(self._file).items() if node not in self._nodes}
        hidden = set(others.values())
        parts = {
            f"other geometries: {', '.join(others)}": others,
            "skins": self._file.json.get("skins"),
            "animations": self._file.json.get("animations"),
            "morph targets": any("targets" in piece.json for piece in self._pieces),
            "lines and points": any(
                primitive.get("mode", 4) not in SOLID
                for number, node in enumerate(self._file.nodes)
                if "mesh" in node and number not in hidden
                for primitive in self._primitives(number)
            ),
        }
        return [name for name, there in parts.items() if there]

    def rewritten(self, vertices: NDArray[np.float64]) -> Encoded:
        """Return the file with other positions and normals, without what moved it before."""
        return Encoded(self.draft().static(vertices), {}, self.lost)

    def draft(self) -> Draft:
        """Return the file without positions and normals of the mesh, to be filled in."""
        parts = GlbParts({k: v for k, v in self._file.json.items() if k not in _REBUILT})
        copied: dict[int, int] = {}
        primitives = [self._primitive(piece, parts, copied) for piece in self._pieces]
        own: dict[int, list[Json]] = {node: [] for node in self._nodes}
        for piece, primitive in zip(self._pieces, primitives, strict=True):
            own[piece.node].append(primitive)
        parts.json["meshes"] = [self._own_mesh(node, block) for node, block in own.items()]
        parts.json["nodes"] = [self._stripped(number, node) for number, node in enumerate(self._file.nodes)]
        if "images" in self._file.json:
            parts.json["images"] = [self._copied_image(image, parts) for image in self._file.json["images"]]
        sharing: dict[tuple[int, int], list[Json]] = {}
        for piece, primitive in zip(self._pieces, primitives, strict=True):
            sharing.setdefault(piece.accessor, []).append(primitive)
        blocks = [self._block(piece, sharing[piece.accessor]) for piece in self._firsts]
        return Draft(parts, blocks, self.surface, np.arange(len(self.vertices)), self._group)

    def _own_mesh(self, node: int, primitives: list[Json]) -> Json:
        """The mesh of a node, with primitives of its own: one that several nodes share is posed for each."""
        mesh = self._file.json["meshes"][self._file.nodes[node]["mesh"]]
        return {k: v for k, v in mesh.items() if k not in ("weights", "extras")} | {"primitives": primitives}

    def _block(self, piece: Piece, primitives: list[Json]) -> Block:
        rows = self._rows(piece)
        vertices, world = np.arange(rows.start, rows.stop), self._file.world[piece.node]
        return Block(vertices, primitives, world, has_normals="NORMAL" in piece.json["attributes"])

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
        mesh = {"mesh": self._nodes[number]} if number in self._nodes else {}
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


def _names(path: Path) -> tuple[str, ...]:
    return tuple(solid_nodes(_opened(path)))


FORMATS = {".glb": Format(read_glb, built_glb, _names)}
