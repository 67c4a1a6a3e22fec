"""A training of a template or of an avatar: its run, its end, its network."""

from pathlib import Path
from typing import Any

from datagen.common.errors import CheckpointError
from training.checkpoints.checkpoint import is_finished, load_checkpoint, require_checkpoint
from training.checkpoints.weights import fill_network
from training.engine.resume import require_same_training
from training.engine.tasks.registry import task_of
from training.recipes.training import TrainingRecipe
from training.tracking.provenance import write_run_head
from training.tracking.record import update_record
from workflows.pipeline.progress import following
from workflows.pipeline.run_folder import RunFolder
from workflows.pipeline.stage import recorded
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import HEAD, train_to_end


def learn(recipe: TrainingRecipe, data: Path, run: RunFolder, *, parent: Path, tasks: TaskRunner, name: str) -> None:
    """Train to the recipe's last step, from the newest checkpoint if there is one, and record it.

    Raises
    ------
    TrainingError
        It ended before the last step.
    """
    task, parameters = task_of(recipe, str(data)), recipe.model_dump(mode="json")
    steps = recipe.last_step(task.order.steps_per_epoch)
    with run.alone(), recorded(run.path, kind="train", name=name, parent=parent, parameters=parameters):
        update_record(run.path, artifacts=HEAD)
        write_run_head(run.path, parameters, dataset={"name": data.name, "uuid": task.uuid})
        placed = tasks.training(recipe)
        with following(run.journal, steps=steps, steps_per_epoch=task.order.steps_per_epoch):
            train_to_end(placed, str(data), run.path, steps)
        update_record(run.path, artifacts=[*HEAD, "metrics.jsonl"])


def is_learned(recipe: TrainingRecipe, data: Path, run: RunFolder) -> bool:
    """Whether a run holds a sound checkpoint of the end of this recipe's training on these data."""
    try:
        task, found = task_of(recipe, str(data)), load_checkpoint(run.path)
    except CheckpointError:
        return False
    last = recipe.last_step(task.order.steps_per_epoch)
    return found is not None and found.dataset == task.uuid and is_finished(found, last)


def trained(recipe: TrainingRecipe, data: Path, run: RunFolder, *, section: str) -> Any:
    """The network of a training with the weights that it ended with, or the best where it stopped early.

    Raises
    ------
    CheckpointError
        It was not trained, or on other data than are there now.
    """
    task, found = task_of(recipe, str(data)), require_checkpoint(run.path, "result")
    require_same_training(recipe, task, run.path, found, section=section)
    network = task.network()
    fill_network(network, found.weights(average=found.has_average), where=str(found.path))
    return network.eval()
