"""What a dataset will take, reported before it is made; one that memory or the disk has no room for is refused."""

from datagen.common.errors import DatasetError, RecipeError
from datagen.recipe import DatasetRecipe
from datagen.sizes import require_disk, size_of
from datagen.store import open_dataset
from datagen.store.objects import is_local, plain
from datagen.store.schema import check_extent
from workflows.pipeline.ray_cluster import on_cluster, worker_count
from workflows.pipeline.stage import say
from workflows.pipeline.tasks import ray_from


def announce_size(recipe: DatasetRecipe, url: str, *, anew: bool, yes: bool, local: bool = False) -> None:
    """Say what a dataset takes before it is made at ``url``; of a complete one that stays as it is, nothing.

    Parameters
    ----------
    anew
        It is made though a complete one is there: that one goes, or grows.
    yes
        Go on though the disk has no room for it.
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
