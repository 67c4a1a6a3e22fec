"""A mesh with a skeleton as a GLB file: joints, weights and bind pose, as glTF 2.0 has them (3.7.3)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.mesh.files import MeshFile
from datagen.mesh.formats.glb_export import built_draft
from datagen.mesh.formats.glb_writer import Draft, GlbParts

_INFLUENCES = 4  # joints of a vertex: more take a second set, which many programs do not read


@dataclass(frozen=True)
class Skeleton:
    """Bones in the pose that a mesh is bound in: names, parents (-1 for a root) and places [bone, 3], metres."""

    names: Sequence[str]
    parents: Sequence[int]
    joints: Floats


def four_influences(weights: Floats) -> NDArray[np.float64]:
    """Weights [vertex, bone] without any but the four largest of each vertex, of sum one again."""
    found = np.array(weights, np.float64)
    if found.shape[1] > _INFLUENCES:
        small = np.argpartition(found, -_INFLUENCES, axis=1)[:, :-_INFLUENCES]
        np.put_along_axis(found, small, 0, axis=1)
    return found / found.sum(axis=1, keepdims=True)


def skinned_glb(mesh: MeshFile, skeleton: Skeleton, weights: Floats) -> tuple[bytes, list[str]]:
    """The content of a GLB file in which a mesh hangs on a skeleton, with its materials and textures.

    Bones have the axes of the world in the bind pose, so that the rotation of a node is that of its bone.

    Parameters
    ----------
    mesh
        In the bind pose.
    skeleton
        Its bones, parents before children.
    weights
        Skinning weights [vertex, bone]; the four largest of each vertex are kept.

    Returns
    -------
    bytes, list of str
        The file, and what it cannot hold, one line each.
    """
    vertices = np.asarray(mesh.mesh.vertices, np.float64)
    draft, left_out = built_draft(mesh.content.surface, len(vertices), mesh.name)
    _bind(draft, four_influences(weights))
    _hang(draft.parts, skeleton)
    return draft.static(vertices), left_out


def _bind(draft: Draft, weights: NDArray[np.float64]) -> None:
    """Give every written vertex its joints and weights."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :_INFLUENCES]
    shares = np.take_along_axis(weights, order, axis=1)
    joints = np.where(shares > 0, order, 0)  # 3.7.3.3: a joint without weight is number 0
    pad = ((0, 0), (0, _INFLUENCES - joints.shape[1]))
    joints, shares = np.pad(joints, pad), np.pad(shares, pad)
    joints = joints.astype(np.uint8 if weights.shape[1] <= 256 else np.uint16)
    for block in draft.blocks:
        rows = draft.of[block.vertices]
        added = {
            "JOINTS_0": draft.parts.attribute(joints[rows]),
            "WEIGHTS_0": draft.parts.attribute(shares[rows].astype(np.float32)),
        }
        for primitive in block.primitives:
            primitive["attributes"] |= added


def _hang(parts: GlbParts, skeleton: Skeleton) -> None:
    """Add a node for each bone, and the skin that binds the mesh' node to them."""
    places, first = np.asarray(skeleton.joints, np.float64), len(parts.json["nodes"])
    for bone, parent in enumerate(skeleton.parents):
        offset = places[bone] - (places[parent] if parent >= 0 else 0)
        node = {"name": skeleton.names[bone], "translation": offset.tolist()}
        children = [first + child for child, above in enumerate(skeleton.parents) if above == bone]
        parts.json["nodes"].append(node | ({"children": children} if children else {}))
    roots = [first + bone for bone, parent in enumerate(skeleton.parents) if parent < 0]
    inverse = np.tile(np.eye(4), (len(places), 1, 1))
    inverse[:, :3, 3] = -places
    by_column = np.ascontiguousarray(inverse.transpose(0, 2, 1), np.float32).reshape(-1, 16)
    matrices = parts.accessor(by_column, view=parts.view(by_column.tobytes()))
    joints = list(range(first, first + len(places)))
    parts.json["skins"] = [{"joints": joints, "inverseBindMatrices": matrices}]
    parts.json["nodes"][0]["skin"] = 0
    parts.json["scenes"][0]["nodes"].append(len(parts.json["nodes"]))
    parts.json["nodes"].append({"name": "skeleton", "children": roots})  # 3.7.3.2: joints have a common root
