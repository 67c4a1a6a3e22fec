"""The recipe that a checkpoint was trained by, or one clear error where another version of this wrote it."""

import logging

from pydantic import ValidationError

from datagen.common.errors import CheckpointError
from training.checkpoints.checkpoint import Checkpoint
from training.recipes.training import TrainingRecipe

log = logging.getLogger(__name__)


def recipe_of(checkpoint: Checkpoint, *, network_only: bool = False) -> TrainingRecipe:
    """Return the recipe that a checkpoint was trained by.

    ``network_only``: where no more than the network is wanted, what this version does not know of the rest is left out.

    Raises
    ------
    CheckpointError
        It holds no recipe, or one that this version cannot read; the message names the field.
    """
    values = checkpoint.recipe
    if not values:
        raise CheckpointError(
            f"{checkpoint.path} holds weights without their recipe. Name a run, or weights exported from one"
        )
    try:
        return TrainingRecipe.model_validate(values)
    except ValidationError as error:
        if network_only and all(fault["loc"][:1] != ("network",) for fault in error.errors()):
            log.warning("%s was trained by a recipe that this version cannot read whole", checkpoint.path)
            return TrainingRecipe.model_validate({"network": values.get("network", {})})
        fault = error.errors()[0]
        place = ".".join(("training", *(str(part) for part in fault["loc"])))
        raise CheckpointError(
            f"{checkpoint.path} was trained by a recipe that this version cannot read ({place}: {fault['msg']}); "
            "it was written by another version. Train anew in another --out, or use the version that wrote it"
        ) from error
