"""The same ``train`` under different launchers: in this process, or as ranks of Ray Train (torchrun needs nothing).

Under torchrun: ``torchrun --nproc-per-node 2 -m training.launch RECIPE.yaml DATA.zarr RUN`` reads RANK and friends.
"""

import json
import sys
from pathlib import Path
from typing import Any

from datagen.errors import DsffnetError
from datagen.mesh import write_atomically
from training.ranks import TrainingError
from training.recipe import TrainingRecipe
from training.trainer import train

_RESTARTS, _FAILURE = 3, "failure.json"


def launch(recipe: TrainingRecipe, *, data: str, run: Path) -> None:
    """Train to the recipe's last step, or raise what stopped it.

    With the launcher ``ray``, a rank that dies takes the others down and the group starts again from the newest
    checkpoint, a few times.

    Raises
    ------
    TrainingError
        Too few CPUs or GPUs for the ranks, or the group kept dying.
    DsffnetError
        Whatever :func:`training.trainer.train` raises.
    """
    if recipe.launcher == "inline":
        train(recipe, data=data, run=run)
    else:
        _with_ray(recipe, data, run)


def _with_ray(recipe: TrainingRecipe, data: str, run: Path) -> None:
    import torch
    from ray.train import FailureConfig, RunConfig, ScalingConfig
    from ray.train.torch import TorchTrainer

    gpu = recipe.device != "cpu" and _cluster("GPU") > 0
    if recipe.device == "cuda" and not (gpu or torch.cuda.is_available()):
        raise TrainingError("training.device is 'cuda', but the cluster has no GPU. Use --set training.device=cpu")
    _require(recipe.ranks, "GPU" if gpu else "CPU")
    failure = run / _FAILURE
    failure.unlink(missing_ok=True)
    trainer = TorchTrainer(
        _rank,
        train_loop_config={"recipe": recipe.model_dump(mode="json"), "data": data, "run": str(run)},
        scaling_config=ScalingConfig(num_workers=recipe.ranks, use_gpu=gpu),
        run_config=RunConfig(
            name="ray", storage_path=str(run.resolve()), failure_config=FailureConfig(max_failures=_RESTARTS)
        ),
    )
    try:
        trainer.fit()
    except Exception as error:
        raise TrainingError(
            f"the training ranks died {_RESTARTS + 1} times; the last reason: {str(error).splitlines()[-1]}. "
            "Run the same command again to go on from the newest checkpoint"
        ) from error
    if failure.exists():
        reason = json.loads(failure.read_text())
        failure.unlink()
        raise TrainingError(reason["message"])


def _rank(config: dict[str, Any]) -> None:
    """One rank. What a person must mend is handed to the driver as a file; raising then takes the other ranks down,
    and the group that Ray starts again sees the file and ends at once.
    """
    run = Path(config["run"])
    if (run / _FAILURE).exists():
        return
    try:
        train(TrainingRecipe.model_validate(config["recipe"]), data=config["data"], run=run)
    except DsffnetError as error:
        write_atomically(run / _FAILURE, json.dumps({"message": str(error)}).encode())
        raise


def _cluster(resource: str) -> int:
    import ray

    return int(ray.cluster_resources().get(resource, 0))


def _require(ranks: int, resource: str) -> None:
    available = _cluster(resource)
    if available < ranks:
        raise TrainingError(
            f"training.ranks is {ranks}, but the cluster has {available} {resource}s. "
            f"Use --set training.ranks={max(1, available)}, or add machines"
        )


def main() -> None:
    """Entry point for torchrun: RECIPE.yaml (a training section) DATA.zarr RUN."""
    from omegaconf import OmegaConf

    recipe_path, data, run = sys.argv[1:4]
    recipe = TrainingRecipe.model_validate(OmegaConf.to_container(OmegaConf.load(recipe_path)))
    train(recipe, data=data, run=Path(run))


if __name__ == "__main__":
    main()
