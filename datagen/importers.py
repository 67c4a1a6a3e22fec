"""Importing meshes that exist already: a recipe for each layout, and published lists of evaluation triples."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.imported_layouts import Cell, FoundMeshes, Layout, find_meshes
from datagen.common.errors import BodyError, UnsafeFileError
from datagen.common.files import read_bounded
from datagen.grid import POSE_TYPES, Grid, PoseType
from datagen.recipe import DatasetRecipe, ImportedBody, MixedBody

_LIST_LIMIT = 2**26  # bytes; a million triples have some 40 MB
Counts = tuple[int, int, int, int]
"""Training and evaluation identities, seen and unseen poses."""


def found_recipe(layout: Layout, path: str | Path, **options: Any) -> DatasetRecipe:
    """A recipe that imports the set in a folder; its counts are a proposal that a person may change.

    - faust: subjects 0-7 train in poses 0-7; subjects 8 and 9 evaluate, with poses 8 and 9 as the unseen ones.
    - multigarment: every garment is an evaluation identity in the one pose it has, so there are no triples.
    - npt: the first 16 identities train (all but 2 where there are fewer), the others evaluate; the first half of the
      poses is seen. Where at least two identities lack the same poses, as in an exported dataset, they are the
      training identities, and the poses that all have are the seen ones.

    Parameters
    ----------
    layout, path
        How the files lie, and where.
    options
        Other fields of :class:`~datagen.recipe.ImportedBody`.

    Raises
    ------
    BodyError
        See :func:`datagen.bodies.imported_layouts.find_meshes`; or an identity lacks a pose that others have.
    """
    if not path or not Path(path).is_dir():
        raise BodyError(
            f"no folder of meshes at {str(path)!r}. Name it after the layout: dsffnet import {layout} FOLDER"
        )
    body = ImportedBody.model_validate({"layout": layout, "path": str(Path(path).resolve()), **options})
    meshes = find_meshes(body)
    if layout == "multigarment":
        counts = (0, len(meshes.identities), 1, 0)
    elif all((identity, pose) in meshes.files for identity in meshes.identities for pose in meshes.poses):
        counts = _counts(meshes)
    else:
        ordered, counts = _ragged(meshes)
        if (ordered.identities, ordered.poses) != (meshes.identities, meshes.poses):
            body = body.model_copy(update={"identities": ordered.identities, "poses": ordered.poses})
    training, evaluation, seen, unseen = counts
    return DatasetRecipe.model_validate(
        {
            "body": body,
            "identities": {"training": training, "evaluation": evaluation},
            "poses": {"seen": seen, "unseen": unseen, "distribution": {"name": "found"}},
        }
    )


def _counts(meshes: FoundMeshes) -> Counts:
    """The split of a set without gaps."""
    identities, poses = len(meshes.identities), len(meshes.poses)
    if identities < 4:  # a triple takes two identities, so both splits need two
        return identities, 0, poses, 0
    training = min(8 if meshes.layout == "faust" else 16, identities - 2)
    seen = min(8, poses) if meshes.layout == "faust" else (poses + 1) // 2
    return training, identities - training, seen, poses - seen


def _ragged(meshes: FoundMeshes) -> tuple[FoundMeshes, Counts]:
    """Identities with fewer poses, then those with all; the poses that all have, then the others."""
    whole = [identity for identity in meshes.identities if len(meshes.poses_of(identity)) == len(meshes.poses)]
    fewer = [identity for identity in meshes.identities if identity not in whole]
    common = list(Counter(tuple(meshes.poses_of(identity)) for identity in fewer).most_common(1)[0][0])
    odd = [identity for identity in fewer if meshes.poses_of(identity) != common]
    if len(fewer) < 2 or not whole or odd:
        lacking = (odd or fewer)[0]
        there, expected = meshes.poses_of(lacking), common if odd else meshes.poses
        missing = [pose for pose in (*expected, *meshes.poses) if pose not in there]
        meshes.path(meshes.identities.index(lacking), meshes.poses.index(missing[0]))  # raises, naming the file
    others = [pose for pose in meshes.poses if pose not in common]
    ordered = replace(meshes, identities=(*fewer, *whole), poses=(*common, *others))
    return ordered, (len(fewer), len(whole), len(common), len(others))


def require_files(recipe: DatasetRecipe) -> None:
    """Check that there is a file for every imported mesh of a recipe's grid, before the first is made.

    Raises
    ------
    RecipeError
        More identities or poses are asked for than there are.
    BodyError
        A file is missing, which the message names, or the test list cannot be used.
    """
    bodies = recipe.body.bodies if isinstance(recipe.body, MixedBody) else (recipe.body,)
    grid = Grid(recipe)
    for place, body in enumerate(bodies):
        if isinstance(body, ImportedBody):
            own = range(place, grid.identity_count, len(bodies))  # identities of a mixed body take turns
            _require_cells(find_meshes(body), [grid.poses_of(identity).tolist() for identity in own])
    if isinstance(recipe.body, ImportedBody) and recipe.body.test_list:
        evaluation_lists(grid)


def _require_cells(meshes: FoundMeshes, poses: list[list[int]]) -> None:
    meshes.require(identities=len(poses), poses=max((pose + 1 for each in poses for pose in each), default=0))
    for identity, each in enumerate(poses):
        for pose in each:
            meshes.path(identity, pose)


def listed_triples(body: ImportedBody) -> NDArray[np.int32] | None:
    """The published evaluation triples of an imported set (see :func:`read_test_list`), None where none are named."""
    return read_test_list(body.test_list, find_meshes(body)) if body.test_list else None


def evaluation_lists(grid: Grid) -> dict[PoseType, NDArray[np.int32]]:
    """The evaluation triples of each pose type [triple, 4]: the published ones of an imported set, or the grid's own.

    Raises
    ------
    BodyError
        A published triple needs a mesh that is not in the grid.
    """
    body = grid.recipe.body
    listed = listed_triples(body) if isinstance(body, ImportedBody) else None
    if listed is None:
        return {pose_type: grid.evaluation_triples(pose_type) for pose_type in POSE_TYPES}
    for triple in listed.tolist():
        _require_in_grid(grid, triple)
    seen = np.array([grid.pose_type(pose) == "seen" for pose in listed[:, 1]], bool)
    return {"seen": listed[seen], "unseen": listed[~seen]}


def _require_in_grid(grid: Grid, triple: list[int]) -> None:
    source, source_pose, target, target_pose = triple
    for identity, pose in ((source, source_pose), (target, target_pose), (target, source_pose)):
        if identity >= grid.identity_count or pose not in grid.poses_of(identity):
            raise BodyError(
                f"the test list uses identity {identity} in pose {pose}, which the dataset will not hold. Take more: "
                "--set data.identities.evaluation=... data.poses.unseen=..."
            )


def read_test_list(path: str | Path, meshes: FoundMeshes) -> NDArray[np.int32]:
    """A published test list as rows [triple, 4]: source identity, source pose, target identity, target pose.

    Lines are ``identity_mesh pose_mesh truth_mesh``, as in the lists of 3D-CoreNet: the first file is the target, the
    second the source, the third the target's identity in the source's pose. Numbers are the dataset's. Published lists
    hold some triples whose source and target are of one identity, or in one pose; they are kept.

    Raises
    ------
    BodyError
        No such file, or a line that is no such triple; the message has its number.
    """
    try:
        lines = read_bounded(Path(path), limit=_LIST_LIMIT).decode().splitlines()
    except (OSError, UnicodeDecodeError, UnsafeFileError) as error:
        raise BodyError(
            f"the test list {path} cannot be read ({error}). Name it: --set data.body.test_list=FILE"
        ) from error
    cells = {file.name: cell for cell, file in meshes.files.items()}
    rows = [_triple(line, cells, meshes, f"{path}, line {n}") for n, line in enumerate(lines, 1) if line.strip()]
    return np.array(rows, np.int32).reshape(-1, 4)


def _triple(line: str, cells: Mapping[str, Cell], meshes: FoundMeshes, where: str) -> tuple[int, int, int, int]:
    words = [word.replace("\\", "/").rsplit("/", 1)[-1] for word in line.split()]
    if len(words) != 3:
        raise BodyError(f"{where}: {len(words)} words instead of the 3 file names of target, source and truth")
    for word in words:
        if word not in cells or cells[word][0] not in meshes.identities or cells[word][1] not in meshes.poses:
            raise BodyError(f"{where}: {word} is not among the meshes of {meshes.folder} that the recipe takes")
    target, source, truth = (cells[word] for word in words)
    if truth != (target[0], source[1]):
        raise BodyError(f"{where}: the truth {words[2]} is not the identity of {words[0]} in the pose of {words[1]}")
    identity, pose = meshes.identities.index, meshes.poses.index
    return identity(source[0]), pose(source[1]), identity(target[0]), pose(target[1])
