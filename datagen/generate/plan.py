"""What a recipe and its assets make of a dataset before its meshes: attributes, small arrays, and where meshes go."""

import importlib.metadata
import uuid
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import BodyModel, load_body, part_labels, require_joints
from datagen.common.assets import git
from datagen.common.seeding import Stream, generator
from datagen.generate.rigs import RigCollection
from datagen.grid import POSE_TYPES, SPLITS, Grid, GridArrays
from datagen.importers import evaluation_lists, require_files
from datagen.poses import PoseSource, draw_poses, load_poses
from datagen.recipe import DatasetRecipe
from datagen.store.writer import Plan

READS_FOLDERS = ("imported", "mixed")
"""Families whose assets are whole folders: they are hashed once, when a dataset is begun, and not in every worker."""
_NAMESPACE = uuid.UUID("6f5a4b1e-52f7-5f0b-9a35-2f2a3a7d6c11")
_CONTENT = 2
"""The version of what a recipe means, part of the uuid: formats 2 and 3 hold the same meshes."""
_PACKAGES = ("anny", "smplx", "numpy", "scipy", "warp-lang", "zarr", "numcodecs")


def identity_parameters(recipe: DatasetRecipe, body: BodyModel, identity: int) -> NDArray[np.float64]:
    """Parameters [parameter] of identity number ``identity``, a function of (seed, identity) alone."""
    return body.draw_identity(generator(recipe.identities.seed, Stream.IDENTITY, identity), identity)


def plan_of(recipe: DatasetRecipe) -> Plan:
    """Return the plan of a recipe's dataset; nothing is written.

    Raises
    ------
    BodyError
        The body model or the poses cannot be loaded, or do not fit each other; there are too few poses or files.
    """
    body, source, grid = load_body(recipe.body), load_poses(recipe.poses), Grid(recipe)
    require_joints(body, source, family=recipe.body.family)
    require_files(recipe)
    poses = draw_poses(recipe.poses, range(grid.pose_count)).rotations
    parameters = [identity_parameters(recipe, body, identity) for identity in range(grid.identity_count)]
    topologies = _Topologies(recipe, body)
    table, numbers, rig_numbers = RigCollection(), [], []
    for identity, parameter in enumerate(parameters):  # all of a person at once, who may be dear to make
        numbers.append(topologies.number_of(identity, parameter))
        rig_numbers.append(table.add(body.rig(parameter, source.joints)))
    labelled = {"labelled": list(topologies.labels)} if topologies.labels else {}
    return Plan(
        attributes={**_attributes(recipe, body, source), "rigs": table.parts, **labelled},
        provenance={
            "packages": {name: importlib.metadata.version(name) for name in _PACKAGES},
            "git_commit": git("rev-parse", "HEAD") or "unknown",
        },
        arrays=GridArrays(grid, numbers, topologies.vertices),
        parameters=np.stack(parameters),
        faces=topologies.faces,
        labels=topologies.labels,
        poses=poses,
        triples=evaluation_lists(grid),
        rigs=table.rigs,
        rig_numbers=np.array(rig_numbers, np.int32),
    )


class _Topologies:
    """The topologies of a body's identities, numbered as they appear, each with its triangles and count of vertices.

    Vertices are counted by their labels, or in a mesh of the first identity that has them: some may be in no face.
    """

    def __init__(self, recipe: DatasetRecipe, body: BodyModel) -> None:
        self.faces: list[NDArray[np.int32]] = []
        self.vertices: list[int] = []
        self.labels: dict[int, NDArray[np.int32]] = {}
        self._recipe, self._body, self._grid = recipe, body, Grid(recipe)
        self._numbers: dict[bytes, int] = {}

    def number_of(self, identity: int, parameters: NDArray[np.float64]) -> int:
        """The number of an identity's topology."""
        faces = self._body.faces(parameters)
        number = self._numbers.setdefault(faces.tobytes(), len(self.faces))
        if number == len(self.faces):
            self.faces.append(faces)
            if (labels := part_labels(self._body, parameters)) is not None:
                self.labels[number] = labels
            self.vertices.append(self._count(identity, parameters) if labels is None else len(labels))
        return number

    def _count(self, identity: int, parameters: NDArray[np.float64]) -> int:
        one_pose = draw_poses(self._recipe.poses, self._grid.poses_of(identity)[:1])
        return self._body.vertices(parameters, one_pose).shape[1]


def _attributes(recipe: DatasetRecipe, body: BodyModel, source: PoseSource) -> dict[str, Any]:
    """What follows from a recipe and its assets alone; an existing dataset must say the same."""
    grid, digest, assets = Grid(recipe), recipe.sha256(), assets_of(recipe, body)
    identities = sorted((asset["name"], asset["version"]) for asset in assets)
    return {
        "uuid": str(uuid.uuid5(_NAMESPACE, f"{_CONTENT} {digest} {identities}")),
        "recipe": recipe.model_dump(mode="json"),
        "recipe_sha256": digest,
        "body": {"family": recipe.body.family, "assets": assets, "parameters": list(body.parameter_names)},
        "units": "metres",
        "frame": "Y up, facing +Z, +X to the body's left",
        "joints": list(source.joints),
        "joint_parents": list(source.parents),
        "splits": {
            "identities": {split: _ranges(np.array(grid.identities(split), np.int64)) for split in SPLITS},
            "poses": {pose_type: _ranges(grid.poses(pose_type)) for pose_type in POSE_TYPES},
        },
    }


def assets_of(recipe: DatasetRecipe, body: BodyModel) -> list[dict[str, str]]:
    """What the bytes depend on beside the recipe: the body's files and packages, and the poses'."""
    return [vars(asset) for asset in dict.fromkeys([*body.assets, *load_poses(recipe.poses).assets])]


def _ranges(numbers: NDArray[np.int64]) -> list[list[int]]:
    """Numbers as a few ranges [first, end)."""
    breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
    return [[int(run[0]), int(run[-1]) + 1] for run in np.split(numbers, breaks) if len(run)]
