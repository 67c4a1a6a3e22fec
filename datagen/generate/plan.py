"""What a recipe and its assets make of a dataset before its meshes: attributes, small arrays, and where meshes go."""

import contextlib
import importlib.metadata
import logging
import uuid
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import BodyModel, load_body, require_joints
from datagen.common.assets import git
from datagen.generate.identities import describe_identities, joined, stored_identities
from datagen.generate.runners import Progress, Runner, Task, closable, inline, unseen
from datagen.grid import POSE_TYPES, SPLITS, Grid, GridArrays
from datagen.importers import evaluation_lists, require_files
from datagen.poses import PoseSource, draw_poses, load_poses
from datagen.recipe import DatasetRecipe, ImportedBody
from datagen.sizes import SECONDS_IDENTITY, SECONDS_POSE
from datagen.store import Dataset
from datagen.store.manifest import SoFar
from datagen.store.writer import Plan, begin, begun

log = logging.getLogger(__name__)
READS_FOLDERS = ("imported", "mixed")
"""Families whose assets are whole folders: they are hashed once, when a dataset is begun, and not in every worker."""
_NAMESPACE = uuid.UUID("6f5a4b1e-52f7-5f0b-9a35-2f2a3a7d6c11")
_CONTENT = 2
"""The version of what a recipe means, part of the uuid: formats 2 to 4 hold the same meshes."""
_PACKAGES = ("anny", "smplx", "numpy", "scipy", "warp-lang", "zarr", "numcodecs")
_BLOCK_SECONDS, _MOST_IN_BLOCK = 0.5, 1000
"""Of work in a task that describes identities or draws poses, and how many at most."""


@dataclass(frozen=True)
class Head:
    """What a recipe and its assets say of a dataset before anything is drawn: attributes and provenance."""

    attributes: dict[str, Any]
    provenance: dict[str, Any]


def head_of(url: str, recipe: DatasetRecipe) -> Head:
    """Return the head of a recipe's dataset; a task.

    Raises
    ------
    BodyError
        The body model or the poses cannot be loaded, or do not fit each other; there are too few files.
    """
    body, source = load_body(recipe.body), load_poses(recipe.poses)
    require_joints(body, source, family=recipe.body.family)
    require_files(recipe)
    return Head(
        attributes=_attributes(recipe, body, source),
        provenance={
            "packages": _versions(),
            "git_commit": git("rev-parse", "HEAD") or "unknown",
        },
    )


def _versions() -> dict[str, str]:
    """Of the packages that meshes may come from, those that are installed: some machines have no body models."""
    found = dict[str, str]()
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def plan_of(
    recipe: DatasetRecipe,
    *,
    head: Head | None = None,
    before: Dataset | None = None,
    run: Runner = inline,
    progress: Progress = unseen,
) -> Plan:
    """Return the plan of a recipe's dataset; nothing is written.

    Parameters
    ----------
    before
        A dataset that the recipe's grows from: what it says of its identities and poses is kept.
    run, progress
        Where tasks run that describe identities and draw poses, and what shows them.

    Raises
    ------
    BodyError
        See :func:`head_of`; or there are too few poses.
    """
    grid, head = Grid(recipe), head or head_of("", recipe)
    _warn_of_few_triples(grid)
    there = (before.grid.identity_count, before.grid.pose_count) if before else (0, 0)
    work = _Work(recipe, run, progress)
    seconds = SECONDS_IDENTITY + recipe.body.seconds_a_mesh
    numbers = range(there[0], grid.identity_count), range(there[1], grid.pose_count)
    with closing(work.blocks(describe_identities, numbers[0], seconds, unit="identity")) as described:
        people = joined([stored_identities(before), *described] if before else described)
    with closing(work.blocks(draw_rotations, numbers[1], SECONDS_POSE, unit="pose")) as drawn:
        rotations = [each.rotations for each in sorted(drawn, key=attrgetter("first"))]
    labelled = {"labelled": list(people.labels)} if people.labels else {}
    return Plan(
        attributes={**head.attributes, "rigs": people.parts, **labelled},
        provenance=head.provenance,
        arrays=people.arrays(grid),
        parameters=people.parameters,
        faces=[topology.faces for topology in people.topologies],
        labels=people.labels,
        poses=np.concatenate([before.rotations(), *rotations] if before else rotations),
        triples=evaluation_lists(grid),
        rigs=people.rigs,
        rig_numbers=people.rig_numbers,
    )


def _warn_of_few_triples(grid: Grid) -> None:
    """Say where a list of evaluation triples, of poses that there are, will be empty or repeat itself."""
    wanted, body = grid.recipe.triples.count, grid.recipe.body
    possible = {kind: grid.possible_triples(kind) for kind in POSE_TYPES if len(grid.poses(kind))}
    few = {kind: count for kind, count in possible.items() if count < wanted}
    identities = len(grid.identities("evaluation"))
    if few and identities and not (isinstance(body, ImportedBody) and body.test_list):
        log.warning(
            "data.triples.count asks for %s evaluation triples, but there are only %s: a triple takes two of the "
            "evaluation identities (there are %s) and two poses (%s). Set data.identities.evaluation, or a smaller "
            "data.triples.count", f"{wanted:,}", " and ".join(f"{n:,} of {kind} poses" for kind, n in few.items()),
            identities, grid.pose_count,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class DrawnPoses:
    """Rotations [pose, joint, 3] of a run of poses, and the number of the first."""

    first: int
    rotations: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.rotations)


def draw_rotations(url: str, recipe: DatasetRecipe, numbers: range) -> DrawnPoses:
    """Draw a run of poses; a task."""
    return DrawnPoses(numbers[0], draw_poses(recipe.poses, numbers).rotations)


@dataclass(frozen=True)
class _Work:
    recipe: DatasetRecipe
    run: Runner
    progress: Progress

    def blocks(self, task: Task, numbers: range, seconds: float, *, unit: str) -> Generator[Any]:
        """Results of a task over blocks of numbers, each of which takes some seconds; one block is not shown.

        Closing them ends the tasks that still run.
        """
        size = min(_MOST_IN_BLOCK, max(1, int(_BLOCK_SECONDS / seconds)))
        blocks = [numbers[start : start + size] for start in range(0, len(numbers), size)]
        with closing(closable(self.run(task, [("", self.recipe, block) for block in blocks]))) as results:
            if len(blocks) < 2:
                yield from results
            else:
                sized = ((len(result), result) for result in results)
                yield from self.progress(sized, unit=unit, total=len(numbers), done=0)


def prepare(
    url: str,
    recipe: DatasetRecipe,
    *,
    run: Runner = inline,
    progress: Progress = unseen,
    before: Dataset | None = None,
    lost: Sequence[str] = (),
    so_far: SoFar | None = None,
) -> GridArrays:
    """Create all of a dataset but its shards, unless that is there; return where its meshes go.

    See :func:`plan_of` and :func:`datagen.store.writer.begin`.
    """
    (head,) = run(head_of, [(url, recipe)])
    if before is None and not lost and (arrays := begun(url, recipe, head.attributes)) is not None:
        return arrays
    plan = plan_of(recipe, head=head, before=before, run=run, progress=progress)
    begin(url, plan, growing=before is not None, lost=lost, so_far=so_far)
    return plan.arrays


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
