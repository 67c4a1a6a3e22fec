"""What a training begins from: the newest checkpoint of its run, the weights of another, or nothing.

Rank 0 chooses, so that all ranks begin from the same one; before anything large is opened.
"""

from pathlib import Path

import torch

from datagen.common.errors import CheckpointError, reason_of
from datagen.common.files import warn_once
from training.checkpoints.checkpoint import Checkpoint, load_checkpoint, read_checkpoint, recipe_of, require_checkpoint
from training.checkpoints.folder import newest_first
from training.checkpoints.state_file import unusable_state
from training.engine.distributed import Ranks, agreed, decided_by_first, restore_random_state
from training.engine.state import Job, State, Verdict
from training.engine.tasks.protocol import Named
from training.engine.train_step import Learner
from training.recipes.training import TrainingRecipe


def begin(job: Job, device: torch.device, newest: Checkpoint | None) -> State:
    """Return the state of the newest checkpoint; without one, that of a training which begins.

    Raises
    ------
    CheckpointError
        On every rank, if one cannot use the checkpoint, or the weights that ``recipe.start_from`` names.
    """
    start = None if newest else weights_to_begin_from(job.recipe, job.ranks)
    spanned = {"steps_per_epoch": job.order.steps_per_epoch, "steps": job.last_step}
    learner = Learner(job.recipe, job.ranks, device, start=start, task=job.task, **spanned)
    state = State(learner, Verdict(triples=job.recipe.evaluate_triples))
    if newest:
        agreed(job.ranks, lambda: _resume(state, newest, job), what="resume from the newest checkpoint")
    return state


def _resume(state: State, newest: Checkpoint, job: Job) -> None:
    saved = newest.state()
    try:
        state.learner.load(newest, saved)
        restore_random_state(saved["random"], job.ranks.rank)
        state.verdict = Verdict.resumed(saved["verdict"], triples=job.recipe.evaluate_triples)
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise unusable_state(newest.path, f"{type(error).__name__}: {reason_of(error)}") from error
    state.step = newest.step


def checkpoint_to_resume(job: Job) -> Checkpoint | None:
    """Return the newest sound checkpoint of a job's run, of its recipe and data; None where the run has none.

    Raises
    ------
    CheckpointError, RecipeError
        The run was trained on another dataset or by another recipe.
    """

    def newest() -> str | None:
        checkpoint = newest_of(job.run)
        return str(checkpoint.path) if checkpoint else None

    path = decided_by_first(job.ranks, newest)
    if path is None:
        return None

    def read() -> Checkpoint:
        checkpoint = read_checkpoint(Path(path))
        require_same_training(job.recipe, job.task, job.run, checkpoint)
        return checkpoint

    return agreed(job.ranks, read, what="resume from the newest checkpoint")


def newest_of(run: Path) -> Checkpoint | None:
    """Return the newest sound checkpoint of a run; None, with a warning where others are left, where it has none."""
    found = load_checkpoint(run)
    if found is None and any(newest_first(run)):
        warn_once(f"no sound checkpoint is left in {run}: training starts again from step 0")
    return found


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
    path = Path(decided_by_first(ranks, lambda: str(require_checkpoint(Path(given), "result", weights_only=True).path)))
    return agreed(
        ranks, lambda: require_checkpoint(path, weights_only=True), what="read the weights of training.start_from"
    )


def require_same_training(
    recipe: TrainingRecipe, data: Named, run: Path, checkpoint: Checkpoint, *, section: str = "training"
) -> None:
    """Raise if a run's checkpoint was trained by another recipe or on other data.

    ``section``: where the recipe stands in its workflow's, for the message.

    Raises
    ------
    CheckpointError, RecipeError
        It was; the message says what differs.
    """
    if checkpoint.dataset != data.uuid:
        raise CheckpointError(
            f"{run} was trained on dataset {checkpoint.dataset}, not on {data.url} ({data.uuid}). Choose another "
            f"--out (begin there from these weights with --set {section}.start_from={run}), or add --fresh to start "
            "over"
        )
    recipe.require_same_learning(recipe_of(checkpoint), where=str(run), section=section)
