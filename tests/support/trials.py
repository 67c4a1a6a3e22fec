"""Trials without Ray."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch

from workflows.studies.sweep.plan import Trial
from workflows.studies.sweep.ray_trials import Outcome, Place, train_trial


def here(
    trials: Sequence[Trial], place: Place, *, tags: Callable[[Trial], dict[str, str]], **_: Any
) -> Iterator[Outcome | None]:
    """Run trials in this process, one after the other."""
    for trial in trials:
        yield train_trial(trial, place, tags=tags(trial), threads=torch.get_num_threads())
        yield None
