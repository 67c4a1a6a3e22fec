"""Which task a recipe's network learns."""

from pathlib import Path

from datagen.store import open_dataset
from training.engine.tasks.protocol import Task
from training.engine.tasks.transfer.transfer_task import TransferTask
from training.recipes.networks import AvatarRecipe, TemplateRecipe
from training.recipes.training import TrainingRecipe


def task_of(recipe: TrainingRecipe, data: str) -> Task:
    """The task of a recipe on its data: a dataset's URL; of the template the folder of an outfit, of the avatar that of
    all outfits.

    Raises
    ------
    DatasetError, StorageError, CheckpointError
        They cannot be opened, or are of another kind.
    """
    if not isinstance(recipe.network, TemplateRecipe | AvatarRecipe):
        return TransferTask(recipe, open_dataset(data))
    # with them comes warp, which a machine that poses transfers learn on need not have
    from training.avatar.outfit import Outfit, outfits_in
    from training.engine.tasks.avatar.avatar_task import AvatarTask
    from training.engine.tasks.avatar.template_task import TemplateTask

    if isinstance(recipe.network, TemplateRecipe):
        return TemplateTask(recipe, Outfit(Path(data)))
    return AvatarTask(recipe, outfits_in(Path(data)), data)
