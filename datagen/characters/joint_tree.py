"""The tree of joints that a character is posed by, from the tree of nodes that its animator worked with.

Rigs hold more than a body: control bones that move nothing, and feet that hang off the armature because inverse
kinematics drives them. Posed by rotations alone, such feet would stay behind; here they hang on their legs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.characters.joint_names import part_in
from datagen.common.errors import BodyError
from datagen.mesh.formats.gltf import Gltf


@dataclass(frozen=True)
class Tree:
    """Names and parents of joints, parents before their children; the root's parent is -1."""

    names: tuple[str, ...]
    parents: tuple[int, ...]

    def restricted(self, names: set[str]) -> "Tree":
        """Return the tree of the joints called ``names`` alone; each hangs on its nearest ancestor among them."""
        kept = [joint for joint, name in enumerate(self.names) if name in names]
        parents = nearest_above(self.parents, kept)
        return Tree(tuple(self.names[joint] for joint in kept), tuple(parents))


def nearest_above(parents: Sequence[int], kept: Sequence[int]) -> list[int]:
    """For each kept joint the place within ``kept`` of its nearest kept ancestor; -1 where it has none."""
    place, found = {joint: number for number, joint in enumerate(kept)}, []
    for joint in kept:
        above = parents[joint]
        while above >= 0 and above not in place:
            above = parents[above]
        found.append(place.get(above, -1))
    return found


def joint_tree(
    file: Gltf, nodes: Sequence[int], weights: NDArray[np.float64], places: NDArray[np.floating]
) -> tuple[Tree, list[int]]:
    """Return the tree of a skin's joints that move something, and their numbers within the skin.

    Parameters
    ----------
    file
        Where the nodes are.
    nodes
        Node of each joint.
    weights
        [vertex, joint]; what joints have in common decides where a stray one hangs.
    places
        Positions [joint, 3]; they decide where nothing is in common.

    Raises
    ------
    BodyError
        Two joints have one name.
    """
    names = [file.nodes[node].get("name") or f"joint{joint}" for joint, node in enumerate(nodes)]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BodyError(f"{file.path} has two joints called {twice[0]!r}. Rename one of them, export it again")
    parents = _ears_on_head(names, nearest_above(file.parents, nodes))
    roots = [joint for joint, parent in enumerate(parents) if parent < 0]
    subtrees = {root: _subtree(parents, root) for root in roots}
    moved = {root: weights[:, subtrees[root]].sum() for root in roots}
    main = max(roots, key=lambda root: moved[root])
    for stray in [root for root in roots if root != main and moved[root] > 0]:
        body = subtrees[main]
        shared = weights[:, subtrees[stray]].sum(axis=1) @ weights[:, body]
        nearest = np.linalg.norm(places[body] - places[stray], axis=1).argmin()
        parents[stray] = body[int(shared.argmax() if shared.any() else nearest)]
    return _pruned(names, parents, _subtree(parents, main), weights.sum(axis=0) > 0)


def _pruned(names: list[str], parents: list[int], order: list[int], moves: NDArray[np.bool_]) -> tuple[Tree, list[int]]:
    """Without joints that move nothing and carry none that do."""
    needed = moves.copy()
    for joint in reversed(order):
        if needed[joint] and parents[joint] >= 0:
            needed[parents[joint]] = True
    kept = [joint for joint in order if needed[joint]]
    return Tree(tuple(names[joint] for joint in kept), tuple(nearest_above(parents, kept))), kept


def _subtree(parents: Sequence[int], root: int) -> list[int]:
    """Joints from ``root`` downwards, parents first."""
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(parents):
        children.setdefault(parent, []).append(joint)
    found = [root]
    for joint in found:  # grows while it is read
        found += children.get(joint, ())
    return found


def _ears_on_head(names: list[str], parents: list[int]) -> list[int]:
    """Hang ears that are siblings of the head on it: where a pose turns the head and knows no ears, they go along."""
    part = [part_in(name) for name in names]
    heads = {parents[joint]: joint for joint, name in enumerate(part) if name == "head"}
    return [
        heads.get(parent, parent) if part[joint] == "ears" and part[parent] not in ("ears", "head") else parent
        for joint, parent in enumerate(parents)
    ]
