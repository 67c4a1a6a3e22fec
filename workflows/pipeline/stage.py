"""A stage has a fingerprint of what it depends on; one that was finished with the same fingerprint is skipped."""

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from typing_extensions import TypedDict

from datagen.common.errors import RecipeError
from datagen.common.files import write_atomically
from datagen.common.json_files import read_json_if_whole
from datagen.common.printable import printable
from training.tracking.record import read_record


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
    mark = out / "stages" / f"{stage.name}.json"
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


def refuse_other_kind(out: Path, kind: str) -> None:
    """Refuse a folder that another kind of work has its record in: that, its recipe and its report would be replaced.

    Raises
    ------
    RecipeError
        It is one.
    """
    record = read_record(out)
    if record and record.kind != kind:
        raise RecipeError(
            f"{out} is the folder of another kind of work: {record.kind} {record.name!r}. Choose another --out"
        )


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
