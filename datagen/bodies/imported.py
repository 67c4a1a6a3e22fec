"""Meshes that exist already as files, behind the protocol of body models: the "model" reads them.

So an import is a generation like any other: shards, workers, repair and remote stores are the same, and as long as the
folder is there and unchanged, so are the bytes. Identity i is the i-th of the files' identities. Poses come from the
source ``found``, whose one pseudo-joint carries the pose's number (:data:`datagen.poses.pose_files.NUMBER`).
"""

import hashlib
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.imported_layouts import FoundMeshes, find_meshes
from datagen.common.assets import Asset, file_asset
from datagen.common.errors import BodyError, MeshError
from datagen.common.files import sha256_of
from datagen.mesh.files import load_mesh
from datagen.mesh.geometry import Mesh
from datagen.mesh.limits import BYTE_LIMIT
from datagen.mesh.rig import Rig
from datagen.poses import Poses
from datagen.poses.pose_files import NUMBER
from datagen.recipe import Axis, ImportedBody

_LICENCE = "as the files' owner states"
_CHOOSE = "--set 'data.body.identities=[...]' or --set 'data.body.poses=[...]'"
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


class ImportedModel:
    """See :class:`datagen.bodies.BodyModel`; frame: metres, Y up, facing +Z, as far as the recipe tells the files'."""

    parameter_names = ("number",)
    joints = (NUMBER,)

    def __init__(self, recipe: ImportedBody) -> None:
        self._recipe = recipe
        self._meshes = find_meshes(recipe)
        self._first = lru_cache(maxsize=2)(self._read_first)  # one identity's at a time; a shard is of one identity

    @cached_property
    def assets(self) -> tuple[Asset, ...]:
        """The set as one asset, known by the names and bytes of all its files; read when first asked for."""
        name = f"{self._recipe.layout} meshes ({len(list(self._meshes.cells()))} files)"
        assets = [Asset(name, _LICENCE, f"sha256:{_digest(self._meshes)}")]
        if self._recipe.test_list:
            assets.append(file_asset(Path(self._recipe.test_list), licence=_LICENCE, name="evaluation list"))
        return tuple(assets)

    def draw_identity(self, random: np.random.Generator, identity: int) -> NDArray[np.float64]:
        """The number [1] of the identity among the files' identities; nothing is random.

        Raises
        ------
        RecipeError
            There are not so many.
        """
        self._meshes.require(identities=identity + 1)
        return np.array([float(identity)])

    def faces(self, parameters: NDArray[np.float64]) -> NDArray[np.int32]:
        """Triangles [face, 3] of the identity's first file."""
        return np.asarray(self._first(int(parameters[0])).faces, np.int32)

    def vertices(self, parameters: NDArray[np.float64], poses: Poses) -> NDArray[np.float32]:
        """Vertices [pose, vertex, 3] float32 of the identity's files, in the files' order of vertices.

        Raises
        ------
        MeshError
            A file cannot be read.
        BodyError
            A file is missing, or has other vertices or faces than the identity's first.
        """
        if poses.joints != self.joints:
            raise BodyError("imported meshes come in found poses only: --set data.poses.distribution.name=found")
        identity = int(parameters[0])
        first = self._first(identity)
        vertices = np.empty((len(poses), len(first.vertices), 3), np.float32)
        for row, number in enumerate(poses.rotations[:, 0, 0]):
            vertices[row] = self._in_our_frame(self._read(self._meshes.path(identity, int(number)), first))
        return vertices

    def rig(self, parameters: NDArray[np.float64], joints: tuple[str, ...]) -> Rig | None:
        """None: files of posed meshes have no skeleton."""
        return None

    def _read_first(self, identity: int) -> Mesh:
        path = self._meshes.first_path(identity)
        mesh = _load(path)
        loose = len(mesh.vertices) - 1 - int(mesh.faces.max())
        if loose:
            raise BodyError(
                f"{path}: its last {loose} vertices are in no face, and a dataset counts vertices by its faces. "
                f"Save the identity's meshes without them, or choose others: {_CHOOSE}"
            )
        return mesh

    def _read(self, path: Path, first: Mesh) -> Mesh:
        mesh = _load(path)
        if len(mesh.vertices) != len(first.vertices):
            raise BodyError(
                f"{path} has {len(mesh.vertices)} vertices, the identity's first file {len(first.vertices)}. "
                "All poses of an identity share vertices and faces: repair the file, or leave out its pose or "
                f"identity: {_CHOOSE}"
            )
        if not np.array_equal(mesh.faces, first.faces):
            raise BodyError(
                f"{path} has other faces than the identity's first file. All poses of an identity share vertices and "
                f"faces: repair the file, or leave out its pose or identity: {_CHOOSE}"
            )
        return mesh

    def _in_our_frame(self, mesh: Mesh) -> NDArray[np.float64]:
        columns, signs = frame(self._recipe.up, self._recipe.forward)
        return mesh.vertices[:, columns] * (signs * self._recipe.unit)


def _load(path: Path) -> Mesh:
    try:
        return load_mesh(path)
    except MeshError as error:
        raise MeshError(f"{error}. Repair the file, or leave out its pose or identity: {_CHOOSE}") from error


def frame(up: Axis, forward: Axis) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Which column [3] of a file's coordinates, times which sign [3], is our X (left), Y (up) and Z (forward).

    Columns and signs rather than a matrix product, so that float32 coordinates come through bit for bit. Left is
    up x forward, so nothing is ever mirrored.
    """
    above, ahead = (np.array(_AXES[axis[-1]]) * (-1 if axis[0] == "-" else 1) for axis in (up, forward))
    rows = np.stack([np.cross(above, ahead), above, ahead])
    return np.abs(rows).argmax(axis=1), rows.sum(axis=1).astype(np.float64)


def _digest(meshes: FoundMeshes) -> str:
    """Hash over (identity, pose, hash of the file's bytes) of all meshes in their order, wherever the files lie."""
    digest = hashlib.sha256()
    for cell in meshes.cells():
        path = meshes.files[cell]
        try:
            content = sha256_of(path, limit=BYTE_LIMIT)
        except OSError as error:
            raise BodyError(
                f"{path} cannot be read ({error.strerror}). Correct its permissions or take it away"
            ) from error
        digest.update(f"{cell[0]}\0{cell[1]}\0{content}\n".encode())
    return digest.hexdigest()
