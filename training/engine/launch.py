"""The same ``train`` under different launchers: in this process, or as ranks of Ray Train (torchrun needs nothing).

Under torchrun: ``torchrun --nproc-per-node 2 -m training.engine RECIPE.yaml DATA.zarr RUN [key=value ...]`` reads RANK
and friends.
"""

import json
import logging
import os
import re
import sys
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field, TypeAdapter
from typing_extensions import TypedDict

from datagen.common.errors import DsffnetError, TrainingError, TrainingStopped, reason_of
from datagen.common.files import read_json_if_whole, read_within, set_aside, write_atomically
from datagen.common.printable import printable
from training.engine.distributed import STOP_FILE, Ranks, device_of, is_of_the_group, on_sigterm
from training.engine.trainer import train
from training.recipes.files import recipe_in
from training.recipes.training import TrainingRecipe

log = logging.getLogger(__name__)
_RESTARTS, _FAILURE, _MARK = 3, "failure.json", ".launch"
_ROOM, _ROOM_BYTES = ".room", 2**16  # given up for what a rank leaves of its failure, if the disk is full
_LOST = (
    "another rank has ended, or its host cannot be reached ({}). Run the same command again on every host: it resumes "
    "from the newest checkpoint"
)
_WHERE_THEY_MEET = ("EADDRINUSE", "Unable to find address")  # the same command fails the same way
_JOIN_SECONDS = 120.0  # for machines that a cluster lost: one that was cut off comes back after a minute or so
_ASK_SECONDS = 60.0  # that a cluster has to say whether its torch uses its GPUs


def launch(recipe: TrainingRecipe, *, data: str, run: Path) -> None:
    """Train to the recipe's last step, or raise what stopped it.

    The launcher ``auto`` is ``inline`` for one rank, else ``ray``. With ``ray``, a rank that dies takes the others down
    and the group starts again from the newest checkpoint: as often as it takes while there are new checkpoints, a few
    times where there are none. The recipe's time budget counts from this call, restarts included.

    Raises
    ------
    TrainingError
        Too few CPUs or GPUs for the ranks, or the group kept dying.
    DsffnetError
        Whatever :func:`training.engine.trainer.train` raises.
    """
    if recipe.launcher == "inline" or (recipe.launcher == "auto" and recipe.ranks == 1):
        _say("1 rank in this process", str(device_of(recipe, Ranks.from_environment())))
        train(recipe, data=data, run=run)
        torch.cuda.empty_cache()  # what follows may run in other processes, and on the same GPU
    else:
        _with_ray(recipe, data, run)


def _with_ray(recipe: TrainingRecipe, data: str, run: Path) -> None:
    began, gpu = time.time(), on_gpus(recipe)
    if not gpu:
        recipe = recipe.model_copy(update={"device": "cpu"})
    resource = "GPU" if gpu else "CPU"
    require_enough(recipe, lambda: _count(resource), resource, patience=_join_seconds())
    fewest = f"{recipe.fewest_ranks} to " if recipe.fewest_ranks else ""
    _say(f"{fewest}{recipe.ranks} ranks by Ray", "one GPU each (NCCL)" if gpu else "CPUs (Gloo)")
    run.mkdir(parents=True, exist_ok=True)
    for left_over in (_FAILURE, STOP_FILE):
        (run / left_over).unlink(missing_ok=True)
    mark = uuid.uuid4().hex
    write_atomically(run / _MARK, mark.encode())
    write_atomically(run / _ROOM, os.urandom(_ROOM_BYTES))  # zeros take no room on some disks
    told = {"recipe": recipe.model_dump(mode="json"), "data": data, "run": str(run), "mark": mark, "began": began}
    try:
        with on_sigterm((run / STOP_FILE).touch):  # the ranks finish their step, write a checkpoint and end
            fit_while_progressing(_group(recipe, told, gpu=gpu).fit, run)
    except DsffnetError:
        raise
    except Exception as error:
        raise failure_of(run) or TrainingError(
            f"the training ranks died {_RESTARTS + 1} times without a new checkpoint; the last reason: "
            f"{_last_line(error)}. "
            "Run the same command again to resume from the newest checkpoint"
        ) from error
    finally:
        for over in (STOP_FILE, _ROOM):
            (run / over).unlink(missing_ok=True)
    failure = failure_of(run)
    if failure:
        raise failure


def _group(recipe: TrainingRecipe, told: dict[str, Any], *, gpu: bool) -> Any:
    """Ray's trainer of a group of ranks that are each told the same."""
    from ray.train import FailureConfig, RunConfig, ScalingConfig
    from ray.train.torch import TorchConfig, TorchTrainer

    class Trainer(TorchTrainer):  # type: ignore[misc]
        def _register_sigint_handler(self, controller: Any) -> None:
            """Leave Ctrl-C as it is: Ray's handler outlives the training and exits with the status of a success."""

    storage = str(Path(told["run"]).resolve())
    return Trainer(
        train_rank,
        train_loop_config=told,
        torch_config=TorchConfig(backend="nccl" if gpu else "gloo", timeout_s=recipe.timeout),
        scaling_config=ScalingConfig(num_workers=_workers(recipe), use_gpu=gpu),
        run_config=RunConfig(name="ray", storage_path=storage, failure_config=FailureConfig(max_failures=_RESTARTS)),
    )


def fit_while_progressing(fit: Callable[[], object], run: Path) -> None:
    """Have Ray train, anew whenever its restarts are used up and a checkpoint came of them.

    A training of days may lose more nodes than one that gets nowhere should be restarted.
    """
    while True:
        before = _newest(run)
        try:
            fit()
            return
        except Exception as error:
            if (run / _FAILURE).exists() or (run / STOP_FILE).exists() or _newest(run) == before:
                raise
            words = "the training ranks died %d times, at last of: %s; resuming, as there is progress"
            log.warning(words, _RESTARTS + 1, _last_line(error))


def _last_line(error: Exception) -> str:
    """What Ray's account of dead ranks, with the stacks of all, ends in."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1]


def _newest(run: Path) -> str:
    """The name of the newest checkpoint's folder, "" where there is none."""
    return max((path.name for path in (run / "checkpoints").glob("step-*")), default="")


def _say(who: str, where: str) -> None:
    """For the person who waits; Ray's ranks have no log that reaches the driver."""
    print(f"train: {who}, on {where}", file=sys.stderr, flush=True)


def _workers(recipe: TrainingRecipe) -> int | tuple[int, int]:
    """So many, or (elastic) as many as there are nodes for: a lost one is done without, a new one is taken in."""
    return (recipe.fewest_ranks, recipe.ranks) if recipe.fewest_ranks else recipe.ranks


def train_rank(config: dict[str, Any]) -> None:
    """Train as one rank of Ray's.

    What a person must repair is handed to the driver as a file; raising then takes the other ranks down, and the group
    that Ray starts again sees the file and ends at once.
    """
    run = Path(config["run"])
    if (run / _FAILURE).exists():
        return
    try:
        if not (run / _MARK).exists() or read_within(run, _MARK) != config["mark"].encode():
            raise TrainingError(f"this rank does not see {run} as the driver does: --out must be on a disk they share")
        recipe = TrainingRecipe.model_validate(config["recipe"])
        train(recipe, data=config["data"], run=run, began=config["began"])
    except DsffnetError as error:
        if not (getattr(error, "secondary", False) and (run / _FAILURE).exists()):
            about = {"message": str(error), "status": error.exit_status, "stopped": isinstance(error, TrainingStopped)}
            with suppress(OSError):
                (run / _ROOM).unlink()
            write_atomically(run / _FAILURE, json.dumps(about).encode())
        raise


def failure_of(run: Path) -> TrainingError | None:
    """What a rank left for the driver to say, with its exit status; None where it left nothing that can be read."""
    about = read_json_if_whole(run, _FAILURE, _LEFT)
    if about is None:
        set_aside(run / _FAILURE)
        return None
    (run / _FAILURE).unlink()
    failure = (TrainingStopped if about["stopped"] else TrainingError)(about["message"])
    failure.exit_status = about["status"]
    return failure


class _Left(TypedDict):
    message: str
    status: Annotated[int, Field(gt=0, lt=256)]
    stopped: bool


_LEFT = TypeAdapter(_Left)


def on_gpus(
    recipe: TrainingRecipe, gpus: Callable[[], int] | None = None, usable: Callable[[], bool] | None = None
) -> bool:
    """Return whether the ranks get GPUs: if asked for, or if the cluster has enough that its torch can use.

    ``gpus`` and ``usable`` tell of a cluster; by default of the one that Ray is connected to.
    """
    if recipe.device != "auto":
        return recipe.device == "cuda"
    count = gpus() if gpus else _count("GPU")
    return count >= (recipe.fewest_ranks or recipe.ranks) and (usable or _torch_there_uses_gpus)()


def _torch_there_uses_gpus() -> bool:
    """What torch says where a GPU is; the driver's machine may have none, or another torch."""
    import ray

    asked = ray.remote(num_gpus=1, num_cpus=0)(_sees_cuda).remote()
    try:
        return bool(ray.get(asked, timeout=_ASK_SECONDS))
    except ray.exceptions.GetTimeoutError:  # all GPUs are at work; Ray Train waits for them too
        ray.cancel(asked)
        return True


def _sees_cuda() -> bool:
    return torch.cuda.is_available()


def _count(resource: str) -> int:
    import ray

    return int(ray.cluster_resources().get(resource, 0))


def _join_seconds() -> float:
    """Seconds to wait for machines that may be cut off and come back: none in a cluster that never had two."""
    import ray

    return _JOIN_SECONDS if len(ray.nodes()) > 1 else 0.0


def require_enough(
    recipe: TrainingRecipe, available: Callable[[], int], resource: str, *, patience: float = 0.0
) -> None:
    """Raise if a cluster has fewer CPUs or GPUs than the recipe has ranks, and does not get enough meanwhile.

    Parameters
    ----------
    available
        How many the cluster has now.
    resource
        CPU or GPU; it names them in messages.
    patience
        Seconds to wait for more.

    Raises
    ------
    TrainingError
        It has; the message names the key to change.
    """
    key = "fewest_ranks" if recipe.fewest_ranks else "ranks"
    wanted, until, waits = getattr(recipe, key), time.monotonic() + patience, False
    while (count := available()) < wanted:
        short = f"training.{key} is {wanted}, but the cluster has {count} {resource}s"
        if time.monotonic() >= until:
            raise TrainingError(f"{short}. Use --set training.{key}={max(1, count)}, or add machines")
        if not waits:
            print(f"train: {short}; waiting up to {patience:g} s for machines", file=sys.stderr, flush=True)
        waits = True
        time.sleep(1.0)


def main() -> None:
    """Entry point for torchrun, and for a machine without Ray; see :func:`training.recipes.files.recipe_in`."""
    if len(sys.argv) < 4:
        print("usage: python -m training.engine RECIPE.yaml|json DATA.zarr RUN [key=value ...]", file=sys.stderr)
        sys.exit(2)
    recipe_path, data, run, *words = sys.argv[1:]
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    status = 0
    try:
        train(recipe_in(Path(recipe_path), words), data=data, run=Path(run))
    except (DsffnetError, OSError) as error:
        print(f"error: {printable(error)}", file=sys.stderr)
        status = getattr(error, "exit_status", 1)
    except RuntimeError as error:
        if not is_of_the_group(error):
            raise
        reason = re.sub(r"^\[[^]]*\] ", "", reason_of(error))  # the line of Gloo's source
        is_misnamed = any(words in reason for words in _WHERE_THEY_MEET)
        print(f"error: {printable(reason) if is_misnamed else _LOST.format(printable(reason))}", file=sys.stderr)
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    # All is on the disk. Taking the interpreter down can abort (-6), after a clean end too: what is left of a process
    # group ends its threads in an order of its own.
    os._exit(status)
