"""What a checkpoint was trained by and goes on from, or one clear error where another version of this wrote it."""

import logging
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from datagen.common.errors import CheckpointError
from training.checkpoints.checkpoint import Checkpoint
from training.recipes.training import TrainingRecipe

log = logging.getLogger(__name__)
_EARLIER_WARM_UP = 0.1  # stood in every recipe of earlier versions, and was heeded by one_cycle alone


def recipe_of(checkpoint: Checkpoint, *, network_only: bool = False) -> TrainingRecipe:
    """The recipe that a checkpoint was trained by.

    ``network_only``: where no more than the network is wanted, what this version does not know of the rest is left out.

    Raises
    ------
    CheckpointError
        It holds no recipe, or one that this version cannot read; the message names the field.
    """
    values = _without_earlier_default(checkpoint)
    if not values:
        raise CheckpointError(
            f"{checkpoint.path} holds weights without their recipe. Name a run, or weights exported from one"
        )
    try:
        return TrainingRecipe.model_validate(values)
    except ValidationError as error:
        if network_only and all(fault["loc"][:1] != ("network",) for fault in error.errors()):
            log.warning("%s was trained by a recipe that this version cannot read whole", checkpoint.path)
            return _recipe_of_network(checkpoint, values)
        raise _unreadable(checkpoint, error) from error


def state_of(checkpoint: Checkpoint, *, averaged: bool) -> dict[str, Any]:
    """The state that training goes on from, with all its parts; ``averaged``: that of the weights' average too.

    Raises
    ------
    CheckpointError
        It is an earlier version's, or weights only.
    """
    state = checkpoint.state()
    parts = {"optimiser", "schedule", "random", "verdict"} | ({"averaged"} if averaged else set())
    schedule = state.get("schedule")
    if not (parts <= state.keys() and isinstance(schedule, Mapping) and "step" in schedule):
        raise CheckpointError(
            f"{checkpoint.path} was written by an earlier version, which this one cannot go on from; "
            f"begin from its weights: --set training.start_from={checkpoint.path}, in another --out"
        )
    return state


def _recipe_of_network(checkpoint: Checkpoint, values: Mapping[str, Any]) -> TrainingRecipe:
    try:
        return TrainingRecipe.model_validate({"network": values.get("network", {})})
    except ValidationError as error:
        raise _unreadable(checkpoint, error) from error


def _unreadable(checkpoint: Checkpoint, error: ValidationError) -> CheckpointError:
    fault = error.errors()[0]
    place = ".".join(("training", *(str(part) for part in fault["loc"])))
    return CheckpointError(
        f"{checkpoint.path} was trained by a recipe that this version cannot read ({place}: {fault['msg']}); "
        "it was written by another version. Train anew in another --out, or use the version that wrote it"
    )


def _without_earlier_default(checkpoint: Checkpoint) -> dict[str, Any]:
    values = dict(checkpoint.recipe)
    schedule = values.get("schedule")
    if not (checkpoint.earlier and isinstance(schedule, Mapping)):
        return values
    if schedule.get("name") != "one_cycle" and schedule.get("warm_up") == _EARLIER_WARM_UP:
        values["schedule"] = {name: value for name, value in schedule.items() if name != "warm_up"}
    return values
