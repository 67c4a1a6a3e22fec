"""A stage of a workflow: skipped where it was finished with the same fingerprint, and recorded for MLflow otherwise."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter
from typing_extensions import TypedDict

from datagen.common.errors import TrainingStopped
from datagen.common.files import read_json_if_whole, refuse_links_out, write_atomically
from datagen.common.printable import printable
from training.tracking.record import begin_record, end_record, flatten, update_record
from workflows.pipeline.run_folder import WorkflowFolder
from workflows.recipe.loader import save_recipe


@dataclass(frozen=True)
class Stage:
    """One step of a workflow.

    ``depends_on`` is everything that its result depends on; ``intact`` says whether its outputs are still there.
    """

    name: str
    depends_on: Any
    intact: Callable[[], bool]
    work: Callable[[], object]

    @property
    def fingerprint(self) -> str:
        return hashlib.sha256(json.dumps(self.depends_on, sort_keys=True).encode()).hexdigest()


def run_stage(stage: Stage, *, out: Path, before: Callable[[], None]) -> bool:
    """Do a stage, after ``before``, unless it is done; returns whether it was done now."""
    mark = mark_of(out, stage.name)
    if _done(mark, stage) and stage.intact():
        say(f"{stage.name}: skipped, finished before")
        return False
    before()
    say(f"{stage.name}: begins")
    began = time.monotonic()
    stage.work()
    seconds = time.monotonic() - began
    write_atomically(mark, json.dumps({"fingerprint": stage.fingerprint, "seconds": seconds}).encode())
    say(f"{stage.name}: finished in {seconds:.0f} s")
    return True


def mark_of(out: Path, stage: str) -> Path:
    """The file that says that a stage was finished, and with what fingerprint."""
    return out / "stages" / f"{stage}.json"


@contextmanager
def recorded(folder: Path, *, kind: str, name: str, parent: Path | None, parameters: dict[str, Any]) -> Iterator[None]:
    """Keep a record in ``folder`` while the block runs, and end it as FINISHED, FAILED or KILLED.

    Raises
    ------
    UnsafeFileError
        A link in the folder leads out of it: what is written there would go elsewhere.
    """
    refuse_links_out(folder, but=() if parent else ("dataset.zarr",))  # its owner's dataset may be on another disk
    begin_record(folder, name=name, kind=kind, parent=parent, parameters=flatten(parameters))
    try:
        yield
    except (KeyboardInterrupt, SystemExit, TrainingStopped):
        end_record(folder, "KILLED")
        raise
    except BaseException:
        end_record(folder, "FAILED")
        raise
    end_record(folder, "FINISHED")


def begin_workflow(
    around: ExitStack, recipe: BaseModel, folder: WorkflowFolder, tasks: AbstractContextManager[Any]
) -> None:
    """What the first stage with work to do needs: the resolved recipe on disk, a parent record, a place for tasks."""
    out, parameters = folder.path, recipe.model_dump(mode="json")
    save_recipe(recipe, folder.recipe)
    around.enter_context(recorded(out, kind=folder.kind, name=out.name, parent=None, parameters=parameters))
    update_record(out, artifacts=["recipe.yaml"])
    around.enter_context(tasks)


def once(work: Callable[[], None]) -> Callable[[], None]:
    """The same work, which does nothing from the second call on."""
    waiting = [work]
    return lambda: waiting.pop()() if waiting else None


def say(text: str) -> None:
    """One line for people, with the time of day, at once."""
    print(f"[{time.strftime('%H:%M:%S')}] {printable(text)}", flush=True)


class _Mark(TypedDict):
    fingerprint: str


_MARK = TypeAdapter(_Mark)


def _done(mark: Path, stage: Stage) -> bool:
    found = read_json_if_whole(mark.parent, mark.name, _MARK)
    return found is not None and found["fingerprint"] == stage.fingerprint
