"""The same ``train`` under different launchers: in this process, or as ranks of Ray Train (torchrun needs nothing).

Under torchrun: ``torchrun --nproc-per-node 2 -m training.launch RECIPE.yaml DATA.zarr RUN`` reads RANK and friends.
"""

import json
import logging
import os
import signal
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datagen.errors import DsffnetError, RecipeError
from datagen.mesh import write_atomically
from training.ranks import STOP_FILE, TrainingError, TrainingStopped
from training.recipe import TrainingRecipe
from training.trainer import train

_RESTARTS, _FAILURE, _MARK = 3, "failure.json", ".launch"


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
    from ray.train import FailureConfig, RunConfig, ScalingConfig
    from ray.train.torch import TorchConfig, TorchTrainer

    gpu = _on_gpus(recipe)
    if not gpu:
        recipe = recipe.model_copy(update={"device": "cpu"})
    _require(recipe.fewest_ranks or recipe.ranks, "GPU" if gpu else "CPU")
    run.mkdir(parents=True, exist_ok=True)
    for left_over in (_FAILURE, STOP_FILE):
        (run / left_over).unlink(missing_ok=True)
    mark = uuid.uuid4().hex
    write_atomically(run / _MARK, mark.encode())
    trainer = TorchTrainer(
        _rank,
        train_loop_config={"recipe": recipe.model_dump(mode="json"), "data": data, "run": str(run), "mark": mark},
        torch_config=TorchConfig(backend="nccl" if gpu else "gloo", timeout_s=recipe.timeout),
        scaling_config=ScalingConfig(num_workers=_workers(recipe), use_gpu=gpu),
        run_config=RunConfig(
            name="ray", storage_path=str(run.resolve()), failure_config=FailureConfig(max_failures=_RESTARTS)
        ),
    )
    try:
        with _passing_on_sigterm(run):
            trainer.fit()
    except Exception as error:
        raise _failure_of(run) or TrainingError(
            f"the training ranks died {_RESTARTS + 1} times; the last reason: {str(error).strip().splitlines()[-1]}. "
            "Run the same command again to go on from the newest checkpoint"
        ) from error
    failure = _failure_of(run)
    if failure:
        raise failure


def _workers(recipe: TrainingRecipe) -> int | tuple[int, int]:
    """So many, or (elastic) as many as there are nodes for: a lost one is gone on without, a new one is taken in."""
    return (recipe.fewest_ranks, recipe.ranks) if recipe.fewest_ranks else recipe.ranks


def _rank(config: dict[str, Any]) -> None:
    """One rank. What a person must mend is handed to the driver as a file; raising then takes the other ranks down,
    and the group that Ray starts again sees the file and ends at once.
    """
    run = Path(config["run"])
    if (run / _FAILURE).exists():
        return
    try:
        if not (run / _MARK).exists() or (run / _MARK).read_text() != config["mark"]:
            raise TrainingError(f"this rank does not see {run} as the driver does: --out must be on a disk they share")
        train(TrainingRecipe.model_validate(config["recipe"]), data=config["data"], run=run)
    except DsffnetError as error:
        if not (getattr(error, "secondary", False) and (run / _FAILURE).exists()):
            about = {"message": str(error), "status": error.exit_status, "stopped": isinstance(error, TrainingStopped)}
            write_atomically(run / _FAILURE, json.dumps(about).encode())
        raise


def _failure_of(run: Path) -> TrainingError | None:
    """What a rank left for the driver to say, with its exit status."""
    try:
        about = json.loads((run / _FAILURE).read_text())
    except FileNotFoundError:
        return None
    (run / _FAILURE).unlink()
    failure = (TrainingStopped if about["stopped"] else TrainingError)(about["message"])
    failure.exit_status = about["status"]
    return failure


@contextmanager
def _passing_on_sigterm(run: Path) -> Iterator[None]:
    """While the block runs, SIGTERM to this process asks the ranks to finish their step, checkpoint and end."""
    try:
        before = signal.signal(signal.SIGTERM, lambda *_: (run / STOP_FILE).touch())
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
        (run / STOP_FILE).unlink(missing_ok=True)


def _on_gpus(recipe: TrainingRecipe) -> bool:
    """Whether the ranks get GPUs: if asked for, or if there are enough of them and torch here can use them."""
    import torch

    if recipe.device == "cuda":
        return True
    return recipe.device == "auto" and _cluster("GPU") >= recipe.ranks and torch.cuda.is_available()


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


def _recipe_in(path: Path) -> TrainingRecipe:
    """The training section in a file; JSON needs no YAML reader.

    Raises
    ------
    RecipeError
        It cannot be read, or is no such section.
    """
    try:
        text = path.read_text()
        if path.suffix == ".json":
            return TrainingRecipe.model_validate(json.loads(text))
        import yaml

        return TrainingRecipe.model_validate(yaml.safe_load(text))
    except (OSError, ValueError) as error:  # pydantic's and JSON's are ValueErrors
        raise RecipeError(f"{path} is no readable training recipe: {str(error).splitlines()[0]}") from error


def main() -> None:
    """Entry point for torchrun, and for a machine without Ray: RECIPE.yaml|json (a training section) DATA.zarr RUN."""
    if len(sys.argv) != 4:
        print("usage: python -m training.launch RECIPE.yaml DATA.zarr RUN", file=sys.stderr)
        sys.exit(2)
    recipe_path, data, run = sys.argv[1:]
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    try:
        train(_recipe_in(Path(recipe_path)), data=data, run=Path(run))
    except DsffnetError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        # The group is not left after an error, and taking the interpreter down with its threads alive can abort (-6).
        os._exit(error.exit_status)


if __name__ == "__main__":
    main()
