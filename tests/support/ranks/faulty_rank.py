"""A rank whose loss becomes NaN: FAULT_RANK and FAULT_STEP say whose and when. Started like training.engine.launch."""

import os
from typing import Any

from training.engine import launch
from training.engine.tasks.transfer import objective

_real = objective.transfer_loss
_calls = 0


def _faulty(*arguments: Any, **keywords: Any) -> Any:
    global _calls  # noqa: PLW0603
    _calls += 1
    loss, terms = _real(*arguments, **keywords)
    if os.environ["RANK"] == os.environ["FAULT_RANK"] and _calls == int(os.environ["FAULT_STEP"]):
        loss = loss * float("nan")
    return loss, terms


if __name__ == "__main__":
    objective.transfer_loss = _faulty
    launch.main()
