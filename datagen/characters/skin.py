"""The skins of a glTF file: joints, inverse bind matrices, and the triangles that they deform (3.7.2, 3.7.3)."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import BodyError
from datagen.mesh.formats.gltf import SOLID, TRIANGLES, Gltf, triangles


@dataclass(frozen=True)
class Primitive:
    """A piece of a skinned mesh: ``positions`` [vertex, 3] as in the file, ``faces`` [face, 3], and its influences.

    ``joints`` [vertex, influence] are numbers within the skin; ``weights`` [vertex, influence] are as in the file.
    """

    positions: NDArray[np.float64]
    faces: NDArray[np.int64]
    joints: NDArray[np.int64]
    weights: NDArray[np.float64]


@dataclass(frozen=True)
class Skin:
    """The nodes of a skin's ``joints``, their ``inverse_bind`` matrices [joint, 4, 4], and what they deform."""

    joints: tuple[int, ...]
    inverse_bind: NDArray[np.float64]
    primitives: tuple[Primitive, ...]


def one_skin(file: Gltf) -> Skin:
    """All skins of a file as one, in the first one's space: exporters write one for each mesh of a character.

    A joint that two skins share tells how their spaces lie to each other.

    Raises
    ------
    BodyError
        There is no skin, or more than one skeleton, or skins bound in different poses, or damage.
    """
    skins = _read_skins(file)
    if not skins:
        raise BodyError(f"{file.path} has no skin: nothing binds a mesh to joints. Export it with its armature")
    merged = skins[0]
    for other in skins[1:]:
        merged = _joined(file, merged, other)
    return merged


def _joined(file: Gltf, first: Skin, other: Skin) -> Skin:
    common = [node for node in other.joints if node in first.joints]
    if not common:
        raise BodyError(f"{file.path} holds {len(_read_skins(file))} skeletons. Export every character to its own file")
    here, there = (skin.inverse_bind[[skin.joints.index(node) for node in common]] for skin in (first, other))
    moves = np.linalg.inv(here) @ there  # the other's space -> the first's, as each common joint has it
    if np.abs(moves - moves[0]).max() > 1e-3 * max(1.0, np.abs(moves).max()):
        raise BodyError(f"{file.path}: its meshes were bound to the same joints in different poses. Bind them in one")
    new = [number for number, node in enumerate(other.joints) if node not in first.joints]
    joints = first.joints + tuple(other.joints[number] for number in new)
    inverse = np.concatenate([first.inverse_bind, other.inverse_bind[new] @ np.linalg.inv(moves[0])])
    number_of = np.array([joints.index(node) for node in other.joints])
    moved = tuple(
        replace(piece, positions=piece.positions @ moves[0, :3, :3].T + moves[0, :3, 3], joints=number_of[piece.joints])
        for piece in other.primitives
    )
    return Skin(joints, inverse, first.primitives + moved)


def _read_skins(file: Gltf) -> list[Skin]:
    """The skins that deform triangles."""
    skins = (_skin(file, number) for number in range(len(file.json.get("skins", ()))))
    return [skin for skin in skins if skin.primitives]


def _skin(file: Gltf, number: int) -> Skin:
    skin = file.json["skins"][number]
    joints = tuple(skin["joints"])
    meshes = [node["mesh"] for node in file.nodes if node.get("skin") == number and "mesh" in node]
    pieces = [piece for mesh in meshes for piece in file.json["meshes"][mesh]["primitives"]]
    solid = [piece for piece in pieces if piece.get("mode", TRIANGLES) in SOLID]
    return Skin(joints, file.inverse_bind(skin), tuple(_primitive(file, piece, len(joints)) for piece in solid))


def _primitive(file: Gltf, primitive: dict[str, Any], joint_count: int) -> Primitive:
    attributes = primitive["attributes"]
    positions = file.accessor(attributes["POSITION"]).astype(np.float64)
    corners = file.accessor(primitive["indices"]).ravel() if "indices" in primitive else np.arange(len(positions))
    joints, weights = file.influences(attributes)
    _require_below(corners, len(positions), f"{file.path}: a face names vertex")
    _require_below(joints[weights != 0], joint_count, f"{file.path}: a vertex names joint")
    return Primitive(
        positions,
        triangles(corners.astype(np.int64), primitive.get("mode", TRIANGLES)),
        np.where(weights != 0, joints, 0).astype(np.int64),
        weights.astype(np.float64),
    )


def _require_below(numbers: NDArray[Any], limit: int, what: str) -> None:
    if numbers.size and numbers.max() >= limit:
        raise BodyError(f"{what} {numbers.max()}, but there are {limit}. The file is damaged; export it again")
