"""Where tasks run: few of them in this process, many on Ray, which starts when the first of them need it."""

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

from datagen.generate import Runner, Task, ensure_shards, inline, ray_runner
from datagen.generate.plan import draw_rotations
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset
from training.recipes.training import EvaluationRecipe, TrainingRecipe
from workflows.pipeline.ray_cluster import on_cluster, ray_cluster

RAY_FROM_MESHES = 5_000
"""From so many meshes on, Ray is worth its start: that takes some 12 s on two cores, 5,000 meshes here 1 to 5 s."""
_RAY_FROM_SECONDS = 60
RAY_FROM_VERTICES = 100_000
"""The same for triples that are measured, by the vertices of their targets: here some 10 s."""

RAY_FROM_FRAMES = 200
"""The same for frames of a person's scans, whose points are drawn."""


def ray_from(recipe: DatasetRecipe) -> int:
    """From so many meshes of a recipe on Ray is worth its start: fewer where each takes long, as dressed people."""
    seconds = recipe.body.seconds_a_mesh
    return min(RAY_FROM_MESHES, math.ceil(_RAY_FROM_SECONDS / seconds)) if seconds else RAY_FROM_MESHES


class TaskRunner:
    """Runs tasks in this process or on Ray, by their amount; a Ray that was started here ends with the block.

    On a cluster all tasks go there: Ray is up, and the driver's machine may be too small for them.

    Parameters
    ----------
    local
        Everything in this process, however much it is.
    """

    def __init__(self, *, local: bool = False) -> None:
        self._local, self._around = local, ExitStack()

    def __enter__(self) -> "TaskRunner":
        return self

    def __exit__(self, *raised: Any) -> bool | None:
        return self._around.__exit__(*raised)

    def connect(self) -> None:
        """Start Ray, or join the cluster, unless that was done."""
        self._around.enter_context(ray_cluster())

    def make_shards(self, task: Task, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        """Run the tasks of :func:`datagen.generate.generate`."""
        if not arguments:
            return iter(())
        if task is ensure_shards:
            meshes = sum(shard.rows for _, _, some in arguments for shard, _ in some)
            here = self._decide("generate", meshes, "meshes", ray_from(arguments[0][1]))
        else:  # what comes before the shards; a number is as much work as a mesh or so
            numbers = sum(len(numbers) for _, _, *given in arguments for numbers in given)
            unit = "poses" if task is draw_rotations else "identities"
            many = numbers >= RAY_FROM_MESHES
            here = self._decide("generate", numbers, unit, RAY_FROM_MESHES) if many else not on_cluster()
        return self._run(task, arguments, here=here)

    def measure(self, dataset: Dataset, recipe: EvaluationRecipe) -> Runner:
        """The runner for :func:`training.evaluation.evaluate.evaluate`."""
        from training.evaluation.evaluate import POSE_TYPES, evaluation_list  # torch, which making data does without

        listed = [evaluation_list(dataset, recipe, pose_type) for pose_type in POSE_TYPES]
        vertices = sum(dataset.vertex_count(int(triple[2])) for triples in listed for triple in triples)
        here = self._decide("evaluate", vertices, "vertices", RAY_FROM_VERTICES)
        return lambda task, arguments: self._run(task, arguments, here=here)

    def frames(self, task: Callable[..., Any], arguments: list[tuple[Any, ...]], *, what: str) -> Iterator[Any]:
        """Run a task for each of some frames, a second or so each; what they return comes in any order."""
        return self._run(task, arguments, here=self._decide(what, len(arguments), "frames", RAY_FROM_FRAMES))

    def training(self, recipe: TrainingRecipe) -> TrainingRecipe:
        """The recipe with its launcher chosen, and Ray started where that is Ray's."""
        if self._local:
            return recipe.model_copy(update={"launcher": "inline", "ranks": 1, "fewest_ranks": None})
        alone = recipe.launcher == "inline" or (recipe.launcher == "auto" and recipe.ranks == 1 and not on_cluster())
        if not alone:
            self.connect()
        return recipe.model_copy(update={"launcher": "inline" if alone else "ray"})

    def _decide(self, what: str, amount: int, unit: str, least: int) -> bool:
        """Whether work is done here, reported in one line."""
        here = self._local or (amount < least and not on_cluster())
        where = "in this process" if here else "on Ray"
        why = "--local" if self._local else "a cluster" if on_cluster() else f"Ray from {least:,}"
        print(f"{what}: {amount:,} {unit}, {where} ({why})", file=sys.stderr, flush=True)
        return here

    def _run(self, task: Task, arguments: list[tuple[Any, ...]], *, here: bool) -> Iterator[Any]:
        if here:
            return inline(task, arguments)
        self.connect()
        return ray_runner(task, arguments)
