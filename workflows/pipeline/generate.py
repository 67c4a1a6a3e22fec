"""The stage that makes the dataset."""

import json
from collections.abc import Iterable, Iterator
from typing import TypeVar

from datagen.common.errors import DsffnetError
from datagen.common.files import write_atomically
from datagen.generate import generate
from datagen.recipe import DatasetRecipe
from datagen.store import open_dataset
from datagen.store.verify import describe
from training.tracking.record import about_dataset, has_record, update_record
from workflows.pipeline.progress import bar, sampling
from workflows.pipeline.run_folder import WorkflowFolder
from workflows.pipeline.stage import Stage, recorded
from workflows.pipeline.tasks import TaskRunner

Result = TypeVar("Result")


def generate_stage(recipe: DatasetRecipe, folder: WorkflowFolder, tasks: TaskRunner) -> Stage:
    """The stage that makes a workflow's dataset."""
    return Stage(
        "generate",
        depends_on=recipe.model_dump(mode="json"),
        intact=lambda: is_complete(folder.data) and has_record(folder.generate),
        work=lambda: generate_dataset(recipe, folder, tasks),
    )


def generate_dataset(recipe: DatasetRecipe, folder: WorkflowFolder, tasks: TaskRunner) -> None:
    """Make the dataset, its description and a contact sheet of it, and record it."""
    from training.reports.contact_sheet import draw_contact_sheet  # matplotlib

    out, parameters = folder.generate, recipe.model_dump(mode="json")
    with recorded(out, kind="generate", name="generate", parent=folder.path, parameters=parameters):
        with sampling(out / "system.jsonl"):
            dataset = generate(recipe, folder.data, run=tasks.make_shards, progress=generation_bar)
        write_atomically(out / "dataset.json", json.dumps(describe(folder.data), indent=1).encode())
        draw_contact_sheet(dataset, out / "contact-sheet.png")
        statistics = dataset.attributes["statistics"]
        update_record(
            out,
            dataset=about_dataset(dataset),
            artifacts=["dataset.json", "contact-sheet.png"],
            metrics={"meshes": float(statistics["meshes"]), "megabytes": statistics["bytes"] / 1e6},
        )


def generation_bar(results: Iterable[tuple[int, Result]], *, unit: str, total: int, done: int) -> Iterator[Result]:
    """A bar that counts what is made, which is shown from the first second; see :data:`datagen.generate.Progress`."""
    with bar(total=total, initial=done, what="generate", unit=unit) as shown:
        for amount, result in results:
            shown.update(amount)
            yield result


def is_complete(data: str) -> bool:
    """Whether a complete dataset is there, none of its shards missing."""
    try:
        open_dataset(data)
    except DsffnetError:
        return False
    return True
