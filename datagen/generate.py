"""Generation: ``make_shard`` is a pure function of (recipe, shard); around it a driver that can always be run again.

The driver asks for every shard of the grid. A task returns the manifest row of a shard that is there and sound, or
makes and writes it; so a run after any interruption does only what is missing, and the bytes come out the same.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from datagen.bodies import load_body, require_joints
from datagen.common.errors import BodyError, ClusterError, DatasetError, RecipeError
from datagen.grid import Grid, Shard
from datagen.importers import require_files
from datagen.mesh.geometry import bounds
from datagen.poses import draw_poses, load_poses
from datagen.recipe import DatasetRecipe, Growth
from datagen.recipe.text import faults_text
from datagen.sizes import require_memory
from datagen.store.attributes import assets_of, check_same_assets
from datagen.store.location import remove, require_ours, writing_alone
from datagen.store.reader import Dataset, open_dataset
from datagen.store.schema import ManifestRow, check_extent, open_group, shard_path, stored_recipe
from datagen.store.verify import Fault, find_faults
from datagen.store.writer import (
    begin,
    committed_hashes,
    existing_shard,
    finish,
    grow,
    identity_parameters,
    require_driven,
    restate,
    write_shard,
)

log = logging.getLogger(__name__)
_SILENCE = 120.0  # seconds without a finished task before a person is told

Task = Callable[[str, DatasetRecipe, Any], Any]
Runner = Callable[[Task, list[tuple[Any, ...]]], Iterator[Any]]
"""Runs a function over argument tuples, yields results as they come: :func:`inline` or :func:`ray_runner`."""
Progress = Callable[[Iterator[ManifestRow], Grid], Iterable[ManifestRow]]


def make_shard(recipe: DatasetRecipe, shard: Shard) -> NDArray[np.float32]:
    """Vertices [rows, vertex, 3] of one shard in metres, Y up: a pure function of its arguments.

    Raises
    ------
    BodyError
        The body model gave coordinates that are not finite, or a mesh without extent.
    """
    body = load_body(recipe.body)
    poses = Grid(recipe).rows_of(shard.identity)[shard.start : shard.stop]
    parameters = identity_parameters(recipe, body, shard.identity)
    vertices = body.vertices(parameters, draw_poses(recipe.poses, poses))
    low, high = bounds(vertices)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and ((high - low).max(axis=1) > 0).all()):
        raise BodyError(
            f"identity {shard.identity} (parameters {parameters.tolist()}) has a degenerate or non-finite mesh in "
            f"poses {poses[0]} to {poses[-1]}. Narrow the identity ranges of the recipe"
        )
    return vertices


def ensure_shard(url: str, recipe: DatasetRecipe, shard: Shard, committed: str | None = None) -> ManifestRow:
    """The manifest row of a shard, which is made and written first unless it is there and sound.

    ``committed`` is its sha256 where the dataset has a manifest already: other bytes are neither kept nor written.

    Raises
    ------
    DatasetError
        The dataset is being made by another recipe now, or from other assets than this machine has.
    """
    group = require_driven(url, recipe)
    _require_same_assets(url, recipe.model_dump_json())
    row = existing_shard(group, Grid(recipe), shard)
    if row is not None and committed in (None, row.sha256):
        return row
    return write_shard(url, recipe, shard, make_shard(recipe, shard), committed=committed)


@lru_cache(maxsize=64)
def _require_same_assets(url: str, recipe: str) -> None:
    """Once a process: this machine has the assets that the dataset was begun with."""
    parsed = DatasetRecipe.model_validate_json(recipe)
    if parsed.body.family not in _READS_FILES:
        check_same_assets(url, open_group(url), assets_of(parsed, load_body(parsed.body)))


_READS_FILES = ("imported", "mixed")
"""Families whose assets are whole folders: they are hashed once, when a dataset is begun, and not in every worker."""


def prepare(url: str, recipe: DatasetRecipe, growing: bool = False) -> None:
    """Load the body model and the poses, check that they fit, and create the dataset's metadata."""
    body, poses = load_body(recipe.body), load_poses(recipe.poses)
    require_joints(body, poses, family=recipe.body.family)
    require_files(recipe)
    draw_poses(recipe.poses, range(Grid(recipe).pose_count))  # too few poses are an error before anything is written
    if growing:
        grow(url, recipe, body)
    begin(url, recipe, body)


def inline(task: Task, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
    """Run tasks one after another in this process."""
    return (task(*each) for each in arguments)


def ray_runner(task: Task, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
    """Run tasks on the connected Ray cluster, a few for each CPU in flight, and yield results as they come.

    A worker or node that dies is Ray's to retry; repeating a task is harmless because a shard is written whole.
    """
    import ray

    remote = ray.remote(num_cpus=1, max_retries=5)(task)
    waiting = list(reversed(arguments))
    running: set[Any] = set()
    window = max(4, 3 * int(ray.cluster_resources().get("CPU", 1)))
    try:
        while waiting or running:
            while waiting and len(running) < window:
                running.add(remote.remote(*waiting.pop()))
            done, running = map(set, ray.wait(list(running), num_returns=1, timeout=_SILENCE))
            if done:
                yield ray.get(done.pop())
            else:
                log.warning("no task has finished for %.0f s; are all CPUs of the Ray cluster in use?", _SILENCE)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise ClusterError(
            f"Ray gave up on a task ({type(error).__name__}: {str(error).splitlines()[0]}). "
            "Run the same command again to go on from here"
        ) from error
    finally:
        for reference in running:
            ray.cancel(reference)
        if running:  # whoever writes next must be alone
            ray.wait(list(running), num_returns=len(running), timeout=_SILENCE)


def generate(
    recipe: DatasetRecipe,
    url: str,
    *,
    run: Runner = inline,
    progress: Progress = lambda rows, grid: rows,
    fresh: bool = False,
) -> Dataset:
    """Make the dataset at ``url``, or what is missing of it; a complete one is returned as it is.

    Parameters
    ----------
    recipe
        What to make.
    url
        A folder or any store URL that zarr opens; use an absolute path when tasks run on other machines.
    run
        Where the tasks run.
    progress
        Wraps the stream of finished shards, for a progress bar.
    fresh
        Remove what is there first.

    Raises
    ------
    DatasetError
        A dataset of another recipe is there, or somebody else is writing to it.
    RecipeError
        Memory has no room to make it.
    """
    if not fresh and _complete(url, recipe):
        return open_dataset(url)
    require_memory(recipe)
    check_extent(url, recipe)
    require_ours(url)
    with writing_alone(url):
        if fresh:
            remove(url)
        _make_missing(recipe, url, run, progress)
    return open_dataset(url)


def append(
    url: str,
    *,
    training: int | None = None,
    evaluation: int | None = None,
    seen: int | None = None,
    unseen: int | None = None,
    recipe: DatasetRecipe | None = None,
    run: Runner = inline,
    progress: Progress = lambda rows, grid: rows,
) -> Dataset:
    """Give an existing dataset more identities or poses, up to these totals; no shard that is there is touched.

    The totals make it repeatable: the same call again goes on after an interruption, and does nothing when done.
    The result is, byte for byte, what the grown recipe makes from nothing. ``recipe`` is the dataset's own, with other
    paths where asset files have moved. A store without a lock (S3) is to be appended to from one place at a time.

    Raises
    ------
    DatasetError
        There is no dataset, it is unfinished, or it has more than a total already.
    RecipeError
        Memory has no room to make it.
    """
    totals = {"training": training, "evaluation": evaluation, "seen": seen, "unseen": unseen}
    with writing_alone(url):
        stored = recipe or stored_recipe(url, open_group(url))
        grown = grown_recipe(url, stored, totals)
        require_memory(grown)
        check_extent(url, grown)
        if grown != stored:
            open_dataset(url)  # an unfinished one must be finished first, and says how
            _make_missing(grown, url, run, progress, growing=True)
        elif not _complete(url, stored):
            _make_missing(stored, url, run, progress)
    return open_dataset(url)


def grown_recipe(url: str, recipe: DatasetRecipe, totals: Mapping[str, int | None]) -> DatasetRecipe:
    """Return the recipe of the dataset at ``url`` after appending up to these totals (of ``append``'s arguments).

    Raises
    ------
    DatasetError
        It has more than a total already, or cannot take more seen poses.
    RecipeError
        A total is no number to count with.
    """
    steps = Grid(recipe).steps
    present = {name: sum(getattr(step, name) for step in steps) for name in totals}
    more = {name: total - present[name] for name, total in totals.items() if total is not None}
    for name, count in more.items():
        if count < 0:
            raise DatasetError(
                f"{url} has {present[name]} {name}, more than {totals[name]}; appending does not take away. "
                "Name a larger total, or make a new dataset with dsffnet generate"
            )
    if not any(more.values()):
        return recipe
    if more.get("seen") and getattr(recipe.poses.distribution, "held_out", None):
        raise DatasetError(
            f"{url} holds out some of its motions for unseen poses, and a pose that is appended as seen could not be "
            "told from them. Append unseen poses only, or make a new dataset with dsffnet generate"
        )
    try:
        added = Growth(**more)
    except ValidationError as error:
        raise RecipeError(f"{url} cannot be appended to: {faults_text(error)}") from error
    return recipe.model_copy(update={"growth": (*recipe.growth, added)})


def _complete(url: str, recipe: DatasetRecipe) -> bool:
    """Whether a dataset of this recipe and of the assets that it names now is there and whole."""
    try:
        dataset = open_dataset(url)
    except DatasetError:
        return False
    if dataset.recipe.sha256() != recipe.sha256():
        return False
    try:
        check_same_assets(url, dataset.group, assets_of(recipe, load_body(recipe.body)))
    except BodyError as error:
        log.warning("%s is complete; whether its assets are those of the recipe cannot be checked: %s", url, error)
    return True


def _make_missing(
    recipe: DatasetRecipe,
    url: str,
    run: Runner,
    progress: Progress,
    *,
    growing: bool = False,
) -> None:
    grid = Grid(recipe)
    list(run(prepare, [(url, recipe, growing)]))
    committed = committed_hashes(url)
    shards = [(url, recipe, shard, committed.get(shard_path(shard))) for shard in grid.shards()]
    finish(url, recipe, list(progress(run(ensure_shard, shards), grid)))


def repair(
    url: str,
    recipe: DatasetRecipe,
    faults: list[Fault],
    *,
    run: Runner = inline,
    progress: Progress = lambda rows, grid: rows,
) -> Dataset:
    """Make the faulty shards and other objects again and check that the dataset is whole; the rest is not touched."""
    with writing_alone(url):
        list(run(_restate, [(url, recipe, [fault.path for fault in faults if not fault.shard])]))
        _make_missing(recipe, url, run, progress)
    left = list(find_faults(url))
    if left:
        raise DatasetError(f"{url}: {left[0].path} is still faulty after repair ({left[0].reason})")
    return open_dataset(url)


def _restate(url: str, recipe: DatasetRecipe, objects: list[str]) -> None:
    if objects:
        restate(url, recipe, load_body(recipe.body), [path for path in objects if path != "zarr.json"])
