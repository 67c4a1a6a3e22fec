"""Generation: a driver that can always be run again around ``make_shard``, a pure function of (recipe, shard).

The driver asks for every shard of the grid that is not known to be there; now and then it notes which are. A task makes
and writes some shards, unless they are there and sound; so a run after any interruption does only what is missing, and
the bytes come out the same.
"""

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress

import numpy as np
from pydantic import ValidationError

from datagen.bodies import load_body
from datagen.common.errors import BodyError, DatasetError, DsffnetError, RecipeError, StorageError
from datagen.generate.plan import assets_of, prepare
from datagen.generate.runners import Progress, Runner, Task, closable, inline, ray_runner, unseen
from datagen.generate.shards import Wanted, batches, ensure_shards, make_shard
from datagen.grid import Grid, GridArrays
from datagen.recipe import DatasetRecipe, Growth
from datagen.recipe.text import faults_text
from datagen.sizes import require_memory
from datagen.store.attributes import check_same_assets
from datagen.store.location import remove, require_ours, writing_alone
from datagen.store.manifest import ManifestRow, SoFar
from datagen.store.objects import is_local
from datagen.store.reader import Dataset, open_dataset
from datagen.store.schema import check_extent, open_group, stored_recipe
from datagen.store.verify import Fault, find_faults
from datagen.store.writer import finish, known_shards, save

__all__ = [
    "Progress",
    "Runner",
    "Task",
    "append",
    "ensure_shards",
    "generate",
    "grown_recipe",
    "inline",
    "make_shard",
    "prepare",
    "ray_runner",
    "repair",
]

log = logging.getLogger(__name__)
_SAVE_SECONDS, _SAVE_SHARE = 10.0, 50
"""Between two notes of the shards so far, at least, and as many times as long as one takes."""
_OTHERS = 3
"""How often a dataset that was made may be found unfinished, as somebody else makes it, on a store without a lock."""


def generate(
    recipe: DatasetRecipe,
    url: str,
    *,
    run: Runner = inline,
    progress: Progress = unseen,
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
        Shows what is made, see :data:`datagen.generate.runners.Progress`.
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
    require_ours(url, fresh=fresh)
    with writing_alone(url):
        if fresh:
            remove(url)
        met = 0
        while True:
            _make_missing(recipe, url, run, progress)
            try:
                return open_dataset(url)
            except DatasetError as error:
                met += 1
                if is_local(url) or met > _OTHERS:
                    raise
                log.warning("%s. Somebody else makes it, too; looking again for what is missing", error)


def append(
    url: str,
    *,
    training: int | None = None,
    evaluation: int | None = None,
    seen: int | None = None,
    unseen: int | None = None,
    recipe: DatasetRecipe | None = None,
    run: Runner = inline,
    progress: Progress = unseen,
) -> Dataset:
    """Give an existing dataset more identities or poses, up to these totals; no shard that is there is touched.

    The totals make it repeatable: the same call again resumes after an interruption, and does nothing when done.
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
            before = open_dataset(url)  # an unfinished one must be finished first, and says how
            _make_missing(grown, url, run, progress, before=before)
            if is_local(url):  # nobody else wrote: of its shards the old were looked at then, the new were now
                return Dataset(url, open_group(url))
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
    before: Dataset | None = None,
    faults: Sequence[Fault] = (),
) -> None:
    """Make what is missing of a dataset, which grows from ``before``, or of which ``faults`` were found."""
    found = before.committed if before else None
    known = SoFar(found.table) if found else known_shards(url, {fault.path for fault in faults})
    lost = [fault.path for fault in faults if not fault.shard]
    arrays = prepare(url, recipe, run=run, progress=progress, before=before, lost=lost, so_far=known)
    if faults:  # before anything is made: a run after this one must know what is faulty
        save(url, recipe, known)
    known, missing = _divided(arrays, known)
    tasks = [(url, recipe, some) for some in batches(recipe, missing)]
    done, shards = int(known.sound["rows"].sum(dtype=int)), _Shards(url, recipe, known)
    with closing(closable(run(ensure_shards, tasks))) as ran, shards.saved():
        results = ((sum(row.rows for row in made), made) for made in ran)
        for made in progress(results, unit="mesh", total=Grid(recipe).mesh_count, done=done):
            shards.add(made)
    table = shards.so_far().sound
    finish(url, recipe, table, written=table[len(known.sound) :] if before else None)


def _divided(arrays: GridArrays, known: SoFar) -> tuple[SoFar, list[Wanted]]:
    """Divide these arrays' shards: what was written before, of which no other is sound; and what is to be made."""
    written, (places, rows) = known.written, arrays.places()
    numbers = {tuple(place): number for number, place in enumerate(written["place"].tolist())}
    number = np.array([numbers.get(tuple(place), -1) for place in places.tolist()], int)
    there = (number < len(known.sound)) & (np.append(written["rows"], -1)[number] == rows)
    hashes = [written["blake3"][at].tobytes().hex() if at >= 0 else None for at in number[~there].tolist()]
    missing = list(zip(arrays.shards(~there), hashes, strict=True))
    return SoFar(written[number[there]], np.delete(written, number[there])), missing


class _Shards:
    """The shards of a dataset that is being made, saved now and then."""

    def __init__(self, url: str, recipe: DatasetRecipe, known: SoFar) -> None:
        self._url, self._recipe = url, recipe
        self._so_far, self._made = known, list[ManifestRow]()
        self._due = time.monotonic() + _SAVE_SECONDS

    def add(self, made: list[ManifestRow]) -> None:
        """Take the rows of some that were made."""
        self._made += made
        if (began := time.monotonic()) >= self._due:
            self._save()
            now = time.monotonic()
            self._due = now + max(_SAVE_SECONDS, _SAVE_SHARE * (now - began))

    def so_far(self) -> SoFar:
        """All of them by now."""
        self._so_far, self._made = self._so_far.with_made(self._made), []
        return self._so_far

    def _save(self) -> None:
        save(self._url, self._recipe, self.so_far())

    @contextmanager
    def saved(self) -> Iterator[None]:
        """Save them where the block is left early."""
        try:
            yield
        except StorageError:  # nothing can be written
            raise
        except BaseException:
            with suppress(DsffnetError, OSError):  # the first error is the one to report
                self._save()
            raise


def repair(
    url: str,
    recipe: DatasetRecipe,
    faults: list[Fault],
    *,
    run: Runner = inline,
    progress: Progress = unseen,
) -> Dataset:
    """Make the faulty shards and other objects again and check that the dataset is whole; the rest is not touched."""
    with writing_alone(url):
        _make_missing(recipe, url, run, progress, faults=faults)
    left = list(find_faults(url))
    if left:
        raise DatasetError(f"{url}: {left[0].path} is still faulty after repair ({left[0].reason})")
    return open_dataset(url)
