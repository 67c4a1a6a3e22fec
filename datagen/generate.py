"""Generation: ``make_shard`` is a pure function of (recipe, shard); around it a driver that can always be run again.

The driver asks for every shard of the grid. A task returns the manifest row of a shard that is there and sound, or
makes and writes it; so a run after any interruption does only what is missing, and the bytes come out the same.
"""

import contextlib
import logging
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from datagen.bodies import load_body
from datagen.errors import BodyError, ClusterError, DatasetError
from datagen.grid import Grid, Shard
from datagen.poses import draw_poses
from datagen.recipe import DatasetRecipe
from datagen.store.reader import Dataset, open_dataset, read_manifest
from datagen.store.schema import ManifestRow, open_group
from datagen.store.verify import Fault, find_faults
from datagen.store.writer import begin, existing_shard, finish, identity_parameters, write_shard

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
    extent = vertices.max(axis=1) - vertices.min(axis=1)
    if not np.isfinite(vertices).all() or (extent.max(axis=1) <= 0).any():
        raise BodyError(
            f"identity {shard.identity} (parameters {parameters.tolist()}) has a degenerate or non-finite mesh in "
            f"poses {poses[0]} to {poses[-1]}. Narrow the identity ranges of the recipe"
        )
    return vertices


def ensure_shard(url: str, recipe: DatasetRecipe, shard: Shard) -> ManifestRow:
    """The manifest row of a shard, which is made and written first unless it is there and sound."""
    return existing_shard(url, shard) or write_shard(url, recipe, shard, make_shard(recipe, shard))


def prepare(url: str, recipe: DatasetRecipe, _: None = None) -> None:
    """Load the body model and create the dataset's metadata."""
    begin(url, recipe, load_body(recipe.body))


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
    """
    if not fresh and _complete(url, recipe):
        return open_dataset(url)
    if is_local(url):
        require_ours(url)
    with writing_alone(url):
        if fresh:
            remove(url)
        _make_missing(recipe, url, run, progress)
    return open_dataset(url)


def _complete(url: str, recipe: DatasetRecipe) -> bool:
    try:
        return open_dataset(url).recipe == recipe
    except DatasetError:
        return False


def _make_missing(recipe: DatasetRecipe, url: str, run: Runner, progress: Progress) -> None:
    grid = Grid(recipe)
    list(run(prepare, [(url, recipe, None)]))
    finish(url, list(progress(run(ensure_shard, [(url, recipe, shard) for shard in grid.shards()]), grid)))


def repair(
    url: str,
    recipe: DatasetRecipe,
    faults: list[Fault],
    *,
    run: Runner = inline,
    progress: Progress = lambda rows, grid: rows,
) -> Dataset:
    """Make the faulty shards again and check that the dataset is whole; the others are not touched."""
    with writing_alone(url):
        list(run(prepare, [(url, recipe, None)]))
        before = {row.path: row.sha256 for row in read_manifest(open_group(url))}
        for row in run(_remake, [(url, recipe, fault.shard) for fault in faults if fault.shard]):
            if before.get(row.path, row.sha256) != row.sha256:
                raise DatasetError(
                    f"{url}: shard {row.path} was made again, but not the same: other package versions made it "
                    f"(dsffnet inspect {url} names them). Install those, or make the dataset anew with --fresh"
                )
        _make_missing(recipe, url, run, progress)
    left = list(find_faults(url))
    if left:
        raise DatasetError(f"{url}: {left[0].path} is still faulty after repair ({left[0].reason})")
    return open_dataset(url)


def _remake(url: str, recipe: DatasetRecipe, shard: Shard) -> ManifestRow:
    return write_shard(url, recipe, shard, make_shard(recipe, shard))


def is_local(url: str) -> bool:
    """Whether a store URL is a folder of a file system."""
    return "://" not in url


def remove(url: str) -> None:
    """Remove a dataset; nothing happens where there is none.

    Raises
    ------
    DatasetError
        The place holds something that is not a dataset, or a remote store, which is for its owner to remove.
    """
    if not is_local(url):
        raise DatasetError(f"--fresh removes local datasets only; remove {url} with your storage's own tools")
    require_ours(url)
    shutil.rmtree(url, ignore_errors=not Path(url).exists())


def require_ours(url: str) -> None:
    """Refuse a local place that holds anything but a dataset of ours.

    Raises
    ------
    DatasetError
        It is a file, or a folder with other things in it.
    """
    path = Path(url)
    if path.is_file():
        raise DatasetError(f"{url} is a file, not a dataset. Choose another --out")
    strangers = {entry.name for entry in path.iterdir() if not entry.name.startswith(".")} if path.exists() else set()
    if strangers - _MEMBERS:
        raise DatasetError(
            f"{url} holds what is not a dataset ({sorted(strangers - _MEMBERS)[0]}). Choose another --out"
        )


_MEMBERS = {"zarr.json", "topology", "identity", "pose", "evaluation", "manifest"}


@contextlib.contextmanager
def writing_alone(url: str) -> Iterator[None]:
    """Hold the right to write to a local dataset; the operating system gives it back if this process dies."""
    if not is_local(url):
        yield
        return
    lock = FileLock(f"{os.path.abspath(url)}.lock")
    try:
        Path(lock.lock_file).parent.mkdir(parents=True, exist_ok=True)
        with lock.acquire(timeout=0):
            yield
    except Timeout as error:
        raise DatasetError(f"another process is writing to {url}. Wait for it, or stop it, then run again") from error
