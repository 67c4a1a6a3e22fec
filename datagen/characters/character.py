"""Rigged characters: a glTF file's surface, joints and weights, brought into one frame and one tree of joints.

Frame: metres, Y up, facing +Z, +X to the body's left, in the pose that the character was bound in.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import permutations, product
from pathlib import Path

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from datagen.characters.animation import Clip, read_clips, world_frames
from datagen.characters.cc0_animals import LICENCE, SHA256, animal_files
from datagen.characters.joint_names import pairs
from datagen.characters.joint_tree import Tree, joint_tree
from datagen.characters.simplify import simplify
from datagen.characters.skin import Skin, one_skin
from datagen.characters.weld import volume, weld
from datagen.common.assets import Asset, file_asset
from datagen.common.errors import BodyError, RecipeError
from datagen.mesh.formats.gltf import SUFFIXES, Gltf, reading
from datagen.mesh.geometry import Mesh, check_mesh

ANIMALS = "animals"
"""The ``path`` that means the twelve CC0 animals."""


@dataclass(frozen=True, eq=False)
class Character:
    """A rigged character as it was bound.

    ``vertices`` [vertex, 3] and ``joints`` [joint, 3] in metres, ``faces`` [face, 3], ``weights`` [vertex, joint];
    ``names`` and ``parents`` of the joints, parents first; their ``nodes`` in the file; ``unbind`` [joint, 3, 3] takes
    directions at rest to the joints' own axes, ``turn`` [3, 3] the file's scene to this frame.
    """

    path: Path
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    weights: scipy.sparse.csr_array
    joints: NDArray[np.float64]
    unbind: NDArray[np.float64]
    names: tuple[str, ...]
    parents: tuple[int, ...]
    nodes: tuple[int, ...]
    turn: NDArray[np.float64]
    file: Gltf

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem

    @property
    def assets(self) -> tuple[Asset, ...]:
        """The files that the character was read from."""
        return tuple(_asset(file) for file in self.file.files)

    @cached_property
    def clips(self) -> dict[str, Clip]:
        """The file's clips by name."""
        return read_clips(self.file)

    def pose(self, clip: str, time: float) -> NDArray[np.float64]:
        """Rotations [joint, 3, 3] of the joints at a moment of a clip, relative to the bind pose, in world axes."""
        frames = world_frames(self.file, self.clips[clip], time, self.nodes)
        return _rotations(self.turn @ frames @ self.unbind)


def load_characters(path: str, chosen: Sequence[str] = (), *, vertices: int | None = None) -> list[Character]:
    """The characters of a folder, or the CC0 animals, in alphabetical order; ``chosen`` are names, in their own order.

    ``vertices``: simplified to about so many (:func:`datagen.characters.simplify.simplify`).

    Raises
    ------
    BodyError
        The folder holds no characters, or one cannot be used.
    RecipeError
        A chosen one is not there.
    """
    files = _files(path)
    unknown = [name for name in chosen if name not in files]
    if unknown:
        raise RecipeError(f"no character {unknown[0]!r} among {path}; there are {', '.join(files)}")
    found = [load_character(files[name]) for name in chosen or files]
    return [_simplified(each, vertices) for each in found] if vertices else found


def shared_joints(characters: Sequence[Character]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return the names and parents of the joints that all characters have, in the order and the tree of the first one.

    Raises
    ------
    BodyError
        Two of them have no joint in common.
    """
    first = characters[0]
    for other in characters[1:]:
        if not set(first.names) & set(other.names):
            raise BodyError(
                f"{first.path} and {other.path} have no joint in common: the first has {_some(first.names)}, the "
                f"second {_some(other.names)}. Choose characters of one skeleton, or rename the joints"
            )
    common = set.intersection(*(set(character.names) for character in characters))
    if not common:
        raise BodyError(f"no joint is common to all of {', '.join(each.name for each in characters)}. Choose fewer")
    tree = Tree(first.names, first.parents).restricted(common)
    return tree.names, tree.parents


@lru_cache(maxsize=64)
def load_character(path: Path) -> Character:
    """Return the character in a file, read once a process.

    Raises
    ------
    BodyError
        The file is damaged, has no skin, more than one skeleton, or a surface that cannot be used.
    """
    with reading(path):
        return _character(Gltf(path))


@lru_cache(maxsize=64)
def _simplified(character: Character, count: int) -> Character:
    surface = character.vertices, character.faces, character.weights
    vertices, faces, weights = simplify(*surface, count, name=str(character.path))
    check_mesh(Mesh(vertices, faces), name=f"{character.path}, simplified to {count:,} vertices")
    return replace(character, vertices=vertices, faces=faces, weights=weights)


def _character(file: Gltf) -> Character:
    skin = one_skin(file)
    surface = weld(skin, name=str(file.path))
    places = np.linalg.inv(skin.inverse_bind)[:, :3, 3]
    tree, kept = joint_tree(file, skin.joints, surface.weights, places)
    axes, scale = _placement(file, skin, kept)
    turn = _facing(tree.names, places[kept] @ axes.T)
    ours = turn @ axes
    vertices, joints = (scale * points @ ours.T for points in (surface.vertices, places[kept]))
    check_mesh(Mesh(vertices, surface.faces), name=str(file.path))
    if volume(vertices, surface.faces) <= 0:
        raise BodyError(f"{file.path}: its faces look inwards. Turn the normals outwards, export it again")
    return Character(
        path=file.path,
        vertices=vertices,
        faces=surface.faces,
        weights=scipy.sparse.csr_array(surface.weights[:, kept]),
        joints=joints,
        unbind=skin.inverse_bind[kept, :3, :3] @ ours.T,
        names=tree.names,
        parents=tree.parents,
        nodes=tuple(skin.joints[joint] for joint in kept),
        turn=turn,
        file=file,
    )


def _placement(file: Gltf, skin: Skin, kept: list[int]) -> tuple[NDArray[np.float64], float]:
    """How the file's scene places the mesh: the rotation [3, 3], one of the 24 along the axes, and the scale.

    The scene may show the character in another pose than the one it was bound in, so that no single joint tells; all
    of them together do.
    """
    placed = (file.world[[skin.joints[joint] for joint in kept]] @ skin.inverse_bind[kept])[:, :3, :3]
    size = float(np.cbrt(np.median(np.linalg.det(placed))))
    if not size > 0:
        raise BodyError(f"{file.path} is mirrored or flattened by its scale. Apply the transforms, export it again")
    mean = placed.mean(axis=0)
    return max(_AXIS_ROTATIONS, key=lambda turn: float((turn * mean).sum())), size


def _facing(names: Sequence[str], joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """The quarter turn [3, 3] about Y that brings the left side to +X; none where names do not tell the sides."""
    found = pairs(names)
    if not found:
        return np.eye(3)
    left = sum((joints[left] - joints[right] for left, right in found), np.zeros(3))
    upright = [turn for turn in _AXIS_ROTATIONS if turn[1, 1] == 1]
    return max(upright, key=lambda turn: float((turn @ left)[0]))


def _rotations(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotations [joint, 3, 3] nearest to matrices [joint, 3, 3]."""
    left, _, right = np.linalg.svd(matrices)
    left[..., 2] *= np.linalg.det(left @ right)[:, None]
    return left @ right


def _axis_rotations() -> list[NDArray[np.float64]]:
    """The 24 rotations that map axes to axes; the one that changes nothing comes first."""
    found = []
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), axes] = signs
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return found


_AXIS_ROTATIONS = _axis_rotations()


def _asset(file: Path) -> Asset:
    """A file, known by its bytes alone: the animals are CC0 wherever they lie, and nothing else is for lying there."""
    asset = file_asset(file, licence="the file's own")
    known = asset.version.removeprefix("sha256:") in SHA256.values()
    return replace(asset, licence=LICENCE) if known else asset


def _files(path: str) -> dict[str, Path]:
    """The characters' files by name."""
    if path == ANIMALS:
        return {file.stem: file.absolute() for file in animal_files()}
    folder = Path(path)
    among = [folder] if folder.is_file() else sorted(folder.glob("*"))
    files = [each.absolute() for each in among if each.suffix.lower() in SUFFIXES]
    if not files:
        raise BodyError(f"no {' or '.join(SUFFIXES)} files in {folder}. Give their folder as path, or: {ANIMALS}")
    named = {file.stem: file for file in files}
    twice = [file for file in files if file not in named.values()]
    if twice:
        raise BodyError(f"{twice[0]} and {named[twice[0].stem]} have one name. Keep one of them in the folder")
    return named


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
