"""A rank that trains every (recipe, data, run) of a JSON file in turn: ``python -m tests.support.ranks JOBS.json``."""

import json
import os
import sys
from pathlib import Path

import torch.distributed

from training.engine.trainer import train
from training.recipes.training import TrainingRecipe

if __name__ == "__main__":
    torch.distributed.init_process_group("gloo")
    for values, data, run in json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")):
        train(TrainingRecipe.model_validate(values), data=data, run=Path(run))
    torch.distributed.barrier()
    os._exit(0)
