"""What a dataset and its trainings will take, said before; data that memory or the disk has no room for are refused."""

from collections.abc import Mapping

from datagen.common.errors import DatasetError, RecipeError
from datagen.common.resources import free_memory
from datagen.recipe import DatasetRecipe
from datagen.sizes import require_disk, size_of
from datagen.store import open_dataset
from datagen.store.objects import is_local, plain
from datagen.store.schema import check_extent
from training.recipes.training import TrainingRecipe
from training.tracking.progress import duration
from workflows.pipeline.ray_cluster import on_cluster, worker_count
from workflows.pipeline.stage import say
from workflows.pipeline.tasks import ray_from

_SOON = 1e6
"""Vertices in the triples of all steps of a training that is over before a forecast would be worth a word."""

_BUSY = 1.5
"""Times as long as alone that trainings would take beside what else the machine does, where that is worth a word."""


def announce_size(recipe: DatasetRecipe, url: str, *, anew: bool, yes: bool, local: bool = False) -> None:
    """Say what a dataset takes before it is made at ``url``; of a complete one that stays as it is, nothing.

    Parameters
    ----------
    anew
        It is made though a complete one is there: that one goes, or grows.
    yes
        Continue though the disk has no room for it.
    local
        It is made in this process, by one task at a time.

    Raises
    ------
    RecipeError
        Memory has no room for it.
    DatasetError
        It has more poses, shards or triples than the format holds.
    StorageError
        The disk has not; object stores have no such limit.
    """
    if not anew and _is_whole(url):
        return
    if recipe.body.expected_vertices is None:
        say(f"generate: loading the body ({recipe.body.family}) to count its vertices")
    one_task = local or on_cluster()  # of a cluster, this machine's memory says nothing of the others'
    size = size_of(recipe, workers=1)
    if not one_task and size.meshes >= ray_from(recipe):
        try:
            size = size_of(recipe, workers=worker_count())
        except RecipeError as error:  # one worker has room
            raise RecipeError(f"{error}, or work in one process: --local, where the command has it") from error
    check_extent(url, recipe)
    say(f"generate: {size}")
    if is_local(url) and not yes:
        require_disk(size, plain(url))


def _is_whole(url: str) -> bool:
    """Whether a complete dataset is there; a store that cannot be reached is an error here as it is later."""
    try:
        open_dataset(url)
    except DatasetError:
        return False
    return True


def announce_times(recipe: DatasetRecipe, trainings: Mapping[str, TrainingRecipe]) -> None:
    """Say of each training how long it will take on this machine, by trying a few steps; see
    :func:`training.engine.step_time.seconds_a_step`.

    Nothing is said of what others or GPUs do, of a body whose vertices only its files tell, of what takes seconds, and
    of what memory has no room for, which the training itself refuses.
    """
    from training.engine.step_time import seconds_a_step  # torch
    from training.engine.tasks.transfer.step_memory import least_step_bytes

    if recipe.body.expected_vertices is None or on_cluster():
        return
    alone, now = 0.0, 0.0
    vertices, grid = round(recipe.body.expected_vertices), recipe.identities.training * recipe.poses.seen
    for name, training in trainings.items():
        steps, shown = training.last_step(grid // training.batch), training.augmentation.subset or vertices
        if steps * training.batch * shown < _SOON or _on_gpu(training):
            continue
        if least_step_bytes(training, shown, meshes=1, processes=training.ranks) > free_memory():
            continue
        say(f"{name}: trying a few steps, to tell how long {steps:,} will take here")
        seconds = seconds_a_step(training, vertices=vertices)
        budget = f", in commands of {training.budget} each" if training.budget else ""
        say(f"{name}: {_about(steps * seconds.alone)}, {seconds.alone:.2g} s a step{budget}")
        alone, now = alone + steps * seconds.alone, now + steps * seconds.now
    if alone:
        is_busy = now > _BUSY * alone
        beside = f" if this machine does nothing else, {_about(now)} while it is as busy as now" if is_busy else ""
        say(f"trainings: {_about(alone)} in all{beside}; data, evaluation and report take a few minutes more")


def _about(seconds: float) -> str:
    return f"about {duration(60 * max(1, round(seconds / 60)))}"


def _on_gpu(recipe: TrainingRecipe) -> bool:
    import torch

    return recipe.device != "cpu" and torch.cuda.is_available()
