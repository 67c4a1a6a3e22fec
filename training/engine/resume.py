"""What a training begins from: the newest checkpoint of its run, or the weights of another, or nothing.

Rank 0 chooses, so that all ranks begin from the same one; before anything large is opened.
"""

from pathlib import Path

from datagen.common.errors import CheckpointError
from datagen.store import Dataset
from training.checkpoints.checkpoint import Checkpoint, load_checkpoint, read_checkpoint, require_checkpoint
from training.checkpoints.compat import recipe_of
from training.engine.distributed import Ranks, agreed, decided_by_first
from training.recipes.training import TrainingRecipe


def checkpoint_to_go_on_from(recipe: TrainingRecipe, dataset: Dataset, run: Path, ranks: Ranks) -> Checkpoint | None:
    """The newest sound checkpoint of a run, of this recipe and dataset; None where the run has none.

    Raises
    ------
    CheckpointError, RecipeError
        The run learned on another dataset or by another recipe.
    """

    def newest() -> str | None:
        found = load_checkpoint(run)
        return str(found.path) if found else None

    path = decided_by_first(ranks, newest)
    if path is None:
        return None

    def read() -> Checkpoint:
        found = read_checkpoint(Path(path))
        _require_same(recipe, dataset, run, found)
        return found

    return agreed(ranks, read, what="go on from the newest checkpoint")


def weights_to_begin_from(recipe: TrainingRecipe, ranks: Ranks) -> Checkpoint | None:
    """The checkpoint that ``recipe.start_from`` names, on every rank; None where it names none.

    Raises
    ------
    CheckpointError
        There is none, or it is damaged.
    """
    given = recipe.start_from
    if given is None:
        return None
    path = Path(decided_by_first(ranks, lambda: str(require_checkpoint(Path(given), "result").path)))
    return agreed(ranks, lambda: require_checkpoint(path), what="read the weights of training.start_from")


def _require_same(recipe: TrainingRecipe, dataset: Dataset, run: Path, found: Checkpoint) -> None:
    if found.dataset != dataset.uuid:
        raise CheckpointError(
            f"{run} was trained on dataset {found.dataset}, not on {dataset.url} ({dataset.uuid}). Choose another "
            f"--out (begin there from these weights with --set training.start_from={run}), or add --fresh to start over"
        )
    recipe.require_same_learning(recipe_of(found), where=str(run))
