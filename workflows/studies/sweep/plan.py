"""What a sweep tries: the grid of varied values, or a file of named trials; every one of them a recipe of its own."""

import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from datagen.common.errors import RecipeError
from datagen.common.files import write_atomically
from datagen.recipe import Frozen
from datagen.recipe.text import faults_text, read_values
from training.recipes.training import TrainingRecipe
from training.tracking.record import flatten
from workflows.recipe.loader import WorkflowRecipe, load_recipe
from workflows.recipe.names import file_of, known_files

_OPENING, _CLOSING = "[{(", "]})"


def parse_grid(vary: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Keys and their values from words ``training.key=VALUE,VALUE,...``; commas within brackets part no values.

    Raises
    ------
    RecipeError
        A word is not of that form, names no value, or a key that another word varies too.
    """
    grid: dict[str, tuple[str, ...]] = {}
    for word in vary:
        key, sign, text = word.partition("=")
        if not (key and sign):
            raise RecipeError(f"--vary {word!r} is not of the form training.key=VALUE,VALUE,...")
        values = split_values(text)
        if not all(values):
            raise RecipeError(f"--vary {word!r} has an empty value. Write e.g. --vary {key}=A,B")
        if key in grid:
            raise RecipeError(f"--vary names {key!r} twice. Write all its values in one word: {key}=A,B,C")
        grid[key] = values
    return grid


def split_values(text: str) -> tuple[str, ...]:
    """Values between the commas that no bracket encloses."""
    values, depth = [""], 0
    for letter in text:
        depth += (letter in _OPENING) - (letter in _CLOSING)
        if letter == "," and depth == 0:
            values.append("")
        else:
            values[-1] += letter
    return tuple(value.strip() for value in values)


def short_names(keys: list[str]) -> list[str]:
    """The last parts of dotted keys, as many as it takes to tell them apart."""
    parts = [key.split(".") for key in keys]

    def short(own: list[str], length: int) -> str:
        return ".".join(own[-length:])

    longest = max(map(len, parts), default=0)
    found = []
    for own in parts:
        alike = (n for n in range(1, longest + 1) if sum(short(other, n) == short(own, n) for other in parts) == 1)
        found.append(short(own, next(alike, longest)))
    return found


def in_a_name(value: str) -> str:
    """A value with what a folder's name cannot hold replaced by dashes."""
    return re.sub(r"[^A-Za-z0-9._+-]+", "-", value).strip("-") or "-"


_MOST_TRIALS = 10_000
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=+-]{0,99}")


class TrialEntry(Frozen):
    """One entry of a file of trials."""

    name: str = Field(description="folder of its run below OUT/trials")
    description: str = Field("", description="one line for people")
    set: tuple[str, ...] = Field((), description="words training.key=value, beyond what all trials share")


class SweepFile(Frozen):
    """A sweep as YAML: what all trials share, and the trials, the varied values, or both (then every pair)."""

    description: str = Field("", description="one line for people")
    recipe: str | None = Field(None, description="name or file of the recipe that all start from")
    set: tuple[str, ...] = Field((), description="words section.key=value that all trials share")
    trials: tuple[TrialEntry, ...] = Field((), description="the named trials")
    vary: tuple[str, ...] = Field((), description="words training.key=VALUE,VALUE,...")


@dataclass(frozen=True)
class Trial:
    """One training of a sweep: its name, and the recipe with ``words`` (training.key=value) set in it."""

    name: str
    description: str
    words: tuple[str, ...]
    recipe: WorkflowRecipe

    @cached_property
    def training(self) -> TrainingRecipe:
        """The training as a trial runs it: one rank, in the process of its task."""
        as_task = {"launcher": "inline", "ranks": 1, "fewest_ranks": None}
        return TrainingRecipe.model_validate(self.recipe.training.model_dump() | as_task)

    def folder(self, out: Path) -> Path:
        """Where its run lies."""
        return out / "trials" / self.name


@dataclass(frozen=True)
class Sweep:
    """All trials, and the recipe that they start from."""

    recipe_name: str
    words: tuple[str, ...]
    recipe: WorkflowRecipe
    trials: tuple[Trial, ...]

    @cached_property
    def varied(self) -> tuple[str, ...]:
        """Keys that any trial sets, each once, in order."""
        return tuple(dict.fromkeys(word.split("=", 1)[0] for trial in self.trials for word in trial.words))


def known_sweeps() -> dict[str, Path]:
    """Sweeps that come with the project, by name."""
    return known_files("sweeps")


def plan_sweep(
    *, recipe: str | None, shared: Sequence[str], vary: Sequence[str] = (), trials: str | None = None
) -> Sweep:
    """Resolve every trial of a sweep, before anything is run.

    Parameters
    ----------
    recipe
        Name or file of the recipe; None: the file's, or `dsffnet-small`.
    shared
        Words ``section.key=value`` for all trials; they come after the file's own, and before a trial's.
    vary
        Words ``training.key=VALUE,VALUE,...``; every combination is a trial.
    trials
        Name or file of a sweep, see :class:`SweepFile`. With ``vary``, each of its trials in every combination.

    Raises
    ------
    RecipeError
        Nothing to try, a key that is not there, a value that cannot be, two trials of one name, an unreadable file.
    """
    file = read_sweep(trials) if trials else SweepFile()
    name, words = recipe or file.recipe or "dsffnet-small", (*file.set, *shared)
    entries = list(_combined(file.trials, parse_grid([*file.vary, *vary])))
    if not entries:
        raise RecipeError(
            "a sweep needs something to try, e.g. --vary training.learning_rate=0.001,0.002, or --trials with a file "
            f"or one of {', '.join(known_sweeps())}"
        )
    return resolve(entries, recipe=name, words=words)


def resolve(entries: Sequence[TrialEntry], *, recipe: str, words: tuple[str, ...]) -> Sweep:
    """Entries as trials, each with its whole recipe; the errors are those of :func:`plan_sweep`."""
    _check_names(entries)
    base = load_recipe(recipe, words)
    if not (base.data.identities.evaluation and base.data.poses.unseen and base.data.triples.count):
        raise RecipeError(
            f"trials are compared on unseen poses of new identities, of which recipe {recipe} has none. "
            "Use --set data.identities.evaluation=... data.poses.unseen=... data.triples.count=..."
        )
    return Sweep(recipe, words, base, tuple(_trial(entry, recipe, words) for entry in entries))


def read_sweep(name_or_file: str) -> SweepFile:
    """Read a sweep by name or file: a mapping as :class:`SweepFile` says, or just the list of its trials.

    Raises
    ------
    RecipeError
        No such sweep, not YAML, or not a list of trials.
    """
    path = file_of(name_or_file, known_sweeps(), what="sweep")
    values = read_values(path)
    try:
        return SweepFile.model_validate({"trials": values} if isinstance(values, list) else values)
    except ValidationError as error:
        raise RecipeError(f"{path} is not a list of trials: {faults_text(error)}. {_FORM}") from error


def write_sweep(sweep: Sweep, path: Path) -> None:
    """Write a sweep as a file of named trials, from which the same can be run again."""
    import yaml

    entries = [
        TrialEntry(name=trial.name, description=trial.description, set=trial.words).model_dump(mode="json")
        for trial in sweep.trials
    ]
    values: dict[str, Any] = {"recipe": sweep.recipe_name, "set": list(sweep.words), "trials": entries}
    write_atomically(path, yaml.safe_dump(values, sort_keys=False, width=120).encode())


def varied_values(sweep: Sweep, trial: Trial) -> dict[str, str]:
    """The value in ``trial`` of every key that any trial sets; keys that its kind of network lacks are left out."""
    values = flatten({"training": trial.recipe.training.model_dump(mode="json")})
    return {key: values[key] for key in sweep.varied if key in values}


_FORM = (
    "A trial is {name: fast, description: for people, set: [training.learning_rate=0.004]}; "
    "words with commas or brackets want quotes"
)


def _combined(trials: Sequence[TrialEntry], grid: dict[str, tuple[str, ...]]) -> Iterable[TrialEntry]:
    """Every trial with every combination of varied values."""
    names = short_names(list(grid))
    if not (trials or grid):
        return
    count = max(1, len(trials)) * math.prod(map(len, grid.values()))
    if count > _MOST_TRIALS:
        raise RecipeError(f"the varied values make {count:,} trials, more than {_MOST_TRIALS:,}. Vary fewer at a time")
    for entry in trials or (None,):
        for values in itertools.product(*grid.values()):
            own = [f"{short}={in_a_name(value)}" for short, value in zip(names, values, strict=True)]
            words = tuple(f"{key}={value}" for key, value in zip(grid, values, strict=True))
            yield TrialEntry(
                name="_".join([*([entry.name] if entry else []), *own]),
                description=entry.description if entry else "",
                set=(*(entry.set if entry else ()), *words),
            )


def _check_names(entries: Sequence[TrialEntry]) -> None:
    for entry in entries:
        if not _NAME.fullmatch(entry.name):
            raise RecipeError(
                f"trial name {entry.name!r} cannot be a folder's: use letters, digits and ._=+- (100 at most)"
            )
        for word in entry.set:
            if not word.startswith(("training.", "training=")):
                raise RecipeError(
                    f"trial {entry.name} sets {word!r}, but only keys of training can differ between trials, as the "
                    "dataset is made once. Set it for all with --set"
                )
            if word.startswith("training.evaluate_triples="):
                raise RecipeError(f"trial {entry.name} sets {word!r}, but trials are compared on the same triples")
    (name, count), *_ = Counter(entry.name for entry in entries).most_common()
    if count > 1:
        raise RecipeError(f"{count} trials are called {name!r}. Give each a name, or a value, of its own")


def _trial(entry: TrialEntry, recipe: str, words: tuple[str, ...]) -> Trial:
    try:
        return Trial(entry.name, entry.description, entry.set, load_recipe(recipe, [*words, *entry.set]))
    except RecipeError as error:
        raise RecipeError(f"trial {entry.name}: {error}") from error
