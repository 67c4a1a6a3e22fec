"""What a comparison trains: methods under one budget on one dataset, as the tables of the paper list them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from datagen.common.errors import RecipeError
from datagen.common.printable import printable
from datagen.recipe import Frozen
from datagen.recipe.text import faults_text, read_values
from workflows.recipe.loader import WorkflowRecipe
from workflows.recipe.names import file_of, known_files
from workflows.studies.sweep.plan import Sweep, Trial, TrialEntry, resolve

ComparisonKind = Literal["comparison", "ablation"]


class MethodEntry(Frozen):
    """One method of a comparison."""

    name: str = Field(min_length=1, max_length=60, description="what tables and figures call it")
    description: str = Field("", description="one line for people")
    set: tuple[str, ...] = Field((), description="words training.key=value, beyond what all methods share")


class ComparisonFile(Frozen):
    """A comparison as YAML: what all methods share, and the methods in the order of the tables."""

    description: str = Field("", description="one line for people")
    recipe: str = Field("dsffnet-small", description="name or file of the recipe that all start from")
    set: tuple[str, ...] = Field((), description="words section.key=value that all methods share")
    methods: tuple[MethodEntry, ...] = Field(min_length=1, description="what is trained")


@dataclass(frozen=True)
class ComparisonPlan:
    """Methods by the name that tables give them, each a trial of a sweep; ``name`` is the recipe's."""

    kind: ComparisonKind
    name: str
    description: str
    sweep: Sweep
    methods: dict[str, Trial]

    @property
    def recipe(self) -> WorkflowRecipe:
        """What all methods share."""
        return self.sweep.recipe

    @property
    def title(self) -> str:
        """A heading for people."""
        return f"{'Comparison of methods' if self.kind == 'comparison' else 'Ablations of DSFFNet'}: {self.name}"


def known_comparisons(kind: ComparisonKind) -> dict[str, Path]:
    """Comparisons of a kind that come with the project, by name."""
    return known_files(f"{kind}s")


def plan_comparison(name_or_file: str, shared: Sequence[str] = (), *, kind: ComparisonKind) -> ComparisonPlan:
    """Resolve every method of a comparison, before anything is run.

    Parameters
    ----------
    name_or_file
        Name or file of a comparison, see :class:`ComparisonFile`.
    shared
        Words ``section.key=value`` for all methods; they come after the file's own, and before a method's.
    kind
        Among which comparisons a name is looked up.

    Raises
    ------
    RecipeError
        No such comparison, not YAML, a key that is not there, a value that cannot be, two methods of one name.
    """
    path = file_of(name_or_file, known_comparisons(kind), what=kind)
    file, words = _read(path), tuple(shared)
    entries = [TrialEntry(name=_folder(m.name), description=m.description, set=m.set) for m in file.methods]
    sweep = resolve(entries, recipe=file.recipe, words=(*file.set, *words))
    names = [printable(method.name) for method in file.methods]
    return ComparisonPlan(kind, path.stem, file.description, sweep, dict(zip(names, sweep.trials, strict=True)))


def _folder(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9.=+]+", "-", name).strip("-.=+") or "method"


def _read(path: Path) -> ComparisonFile:
    try:
        return ComparisonFile.model_validate(read_values(path))
    except ValidationError as error:
        raise RecipeError(
            f"{path} is not a comparison: {faults_text(error)}. It has recipe, set, and methods with name and set"
        ) from error
