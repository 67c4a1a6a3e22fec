"""What a training is, and how far it has come."""

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from datagen.common.files import fault_in
from training.data.order import BatchOrder
from training.engine.distributed import Ranks
from training.engine.tasks.protocol import Task
from training.engine.train_step import Learner
from training.recipes.training import TrainingRecipe

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Job:
    """What is trained, on what, where, and by whom."""

    recipe: TrainingRecipe
    task: Task
    run: Path
    ranks: Ranks

    @property
    def order(self) -> BatchOrder:
        """Of its examples."""
        return self.task.order

    @property
    def last_step(self) -> int:
        """The step at which it ends, unless early stopping ends it before."""
        return self.recipe.last_step(self.order.steps_per_epoch)


@dataclass(frozen=True)
class Verdict:
    """What an evaluation means for the run: the least measure so far, evaluations since then, whether this was it.

    ``triples``: of how many triples of each pose type it is a mean, in trainings of transfer.
    """

    best: float = float("inf")
    since: int = 0
    improved: bool = False
    triples: int | None = None

    def after(self, measure: float) -> "Verdict":
        """The verdict after one more evaluation."""
        if measure < self.best:
            return replace(self, best=measure, since=0, improved=True)
        return replace(self, since=self.since + 1, improved=False)

    @classmethod
    def resumed(cls, state: Mapping[str, Any], *, triples: int) -> "Verdict":
        """The verdict of a checkpoint; a best over other triples is no measure of these, and is forgotten.

        Raises
        ------
        ValueError
            It is none.
        """
        try:
            found = TypeAdapter(cls).validate_python(dict(state))
        except ValidationError as error:
            raise ValueError(f"no verdict: {fault_in(error)}") from error
        if found.triples in (None, triples):
            return replace(found, triples=triples)
        log.info("evaluate_triples was %s and is %s: the best measure so far is forgotten", found.triples, triples)
        return cls(triples=triples)

    def gives_up(self, patience: int | None) -> bool:
        """Whether the best is so old that training ends (early stopping)."""
        return patience is not None and self.since >= patience

    def state(self) -> dict[str, Any]:
        return asdict(self)


@dataclass
class State:
    """What a training resumes from, all of it in a checkpoint."""

    learner: Learner
    verdict: Verdict
    step: int = 0
