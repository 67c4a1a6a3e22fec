"""The recipe of a whole workflow: its sections, reading it from YAML, overrides, and errors a person can act on."""

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError, model_validator

from datagen.bodies import FAMILIES
from datagen.errors import RecipeError
from datagen.poses import SOURCES
from datagen.recipe import DatasetRecipe, Frozen
from training.recipe import DEFAULT_NETWORK, NETWORK_NAMES, EvaluationRecipe, TrainingRecipe
from workflows.named_recipes import known_recipes, known_trainings, named_training, nearest
from workflows.recipe_paths import with_absolute_paths

__all__ = [
    "WorkflowRecipe",
    "change_recipe",
    "check_recipe",
    "describe_fields",
    "known_recipes",
    "load_recipe",
    "override_values",
    "recipe_faults",
    "save_recipe",
    "with_absolute_paths",
]


class WorkflowRecipe(Frozen):
    """Everything that a workflow does, apart from where its files go."""

    description: str = Field("", description="one line for people")
    data: DatasetRecipe = Field(default_factory=DatasetRecipe)
    training: TrainingRecipe = Field(default_factory=TrainingRecipe)
    evaluation: EvaluationRecipe = Field(default_factory=EvaluationRecipe)

    @model_validator(mode="after")
    def _stops_by_what_there_is(self) -> "WorkflowRecipe":
        sizes = {
            "data.poses.unseen": self.data.poses.unseen,
            "data.identities.evaluation": self.data.identities.evaluation,
            "data.triples.count": self.data.triples.count,
        }
        missing = [name for name, size in sizes.items() if size == 0]
        if self.training.early_stopping and missing:
            raise ValueError(
                f"training.early_stopping goes by the PMD on unseen poses, but {missing[0]} is 0: "
                f"set {missing[0]}, or training.early_stopping=null"
            )
        return self


def load_recipe(name_or_file: str, overrides: Sequence[str] = ()) -> WorkflowRecipe:
    """Read a recipe by name or file, or from a dataset, apply overrides ``section.key=value``, and check all of it.

    Raises
    ------
    RecipeError
        No such recipe, not YAML, an unknown key (the nearest one is named), or a value that cannot be.
    """
    return change_recipe(_find(name_or_file), overrides, where=str(name_or_file))


def change_recipe(base: Path | dict[str, Any], overrides: Sequence[str], *, where: str) -> WorkflowRecipe:
    """A recipe from a file or from values, with overrides; the errors are those of :func:`load_recipe`."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    folder = base.resolve().parent if isinstance(base, Path) else Path.cwd()
    try:
        read = OmegaConf.to_container(OmegaConf.load(base)) if isinstance(base, Path) else base
        name, overrides = _named_by(overrides)
        config = OmegaConf.create(with_absolute_paths(_with_training(read, name), folder))
        changes = OmegaConf.create(override_values(overrides))
        for section, kind, default in _KINDS:
            chosen = OmegaConf.select(changes, f"{section}.{kind}")
            if chosen is not None and chosen != OmegaConf.select(config, f"{section}.{kind}", default=default):
                OmegaConf.update(config, section, {}, merge=False)  # the keys of another kind would not fit it
        for override in overrides:  # one by one, as a key may count the entries of a list
            key = override.split("=", 1)[0]
            value = OmegaConf.select(OmegaConf.from_dotlist([override]), key)
            plain = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            last = key.rsplit(".", 1)[-1]
            OmegaConf.update(config, key, with_absolute_paths({last: plain}, Path.cwd())[last], merge=True)
        values = OmegaConf.to_container(config, resolve=True)
    except (OmegaConfBaseException, YAMLError, OSError, ValueError, TypeError, AttributeError, IndexError) as error:
        raise RecipeError(f"recipe {where} cannot be read: {_first_line(error)}") from error
    return check_recipe(values, where=where)


def override_values(overrides: Sequence[str]) -> dict[str, Any]:
    """Nested values of ``section.key=value`` words.

    Raises
    ------
    RecipeError
        A word is not of that form.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    for override in overrides:
        if "=" not in override:
            raise RecipeError(f"--set {override!r} is not of the form section.key=value, e.g. --set training.steps=100")
    try:
        return dict(OmegaConf.to_container(OmegaConf.from_dotlist(list(overrides))))
    except (OmegaConfBaseException, YAMLError, ValueError, TypeError) as error:
        raise RecipeError(f"--set {' '.join(overrides)} cannot be read: {_first_line(error)}") from error


def _named_by(overrides: Sequence[str]) -> tuple[str | None, list[str]]:
    """The training recipe that ``training=NAME`` asks for, if any, and the other overrides, which refine it."""
    import yaml

    name, others = None, []
    for word in overrides:
        value = yaml.safe_load(word.removeprefix("training=")) if word.startswith("training=") else None
        if isinstance(value, str):
            name = value
        else:
            others.append(word)
    return name, others


def _with_training(values: Any, name: str | None) -> Any:
    """The same with a training recipe in the place of its name, or the one named here in the place of any."""
    if name is None and isinstance(values, dict) and isinstance(values.get("training"), str):
        name = values["training"]
    return values if name is None else {**(values or {}), "training": named_training(name)}


def check_recipe(values: Any, *, where: str) -> WorkflowRecipe:
    """A recipe from nested values.

    Raises
    ------
    RecipeError
        With one line a fault: which key, what is wrong, what was given.
    """
    if not isinstance(values, dict) or not values:
        raise RecipeError(f"recipe {where} is not a mapping of sections (data, training, evaluation), or is empty")
    with recipe_faults(where):
        return WorkflowRecipe.model_validate(values)


@contextmanager
def recipe_faults(where: str) -> Iterator[None]:
    """Turn a failed validation into one line a fault: which key, what is wrong, what was given."""
    try:
        yield
    except ValidationError as error:
        faults = "; ".join(_describe(fault) for fault in error.errors())
        raise RecipeError(f"recipe {where}: {faults}. All keys: dsffnet recipe --help") from error


def save_recipe(recipe: WorkflowRecipe, path: Path) -> None:
    """Write the resolved recipe as YAML."""
    import yaml

    from datagen.mesh import write_atomically

    write_atomically(path, yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False).encode())


def describe_fields(model: type[BaseModel] = WorkflowRecipe, prefix: str = "") -> Iterator[str]:
    """One line for each key of the recipe: dotted name, default, meaning."""
    for name, field in model.model_fields.items():
        is_list = get_origin(field.annotation) is tuple
        parts = [] if is_list else list(_parts(field.annotation))
        sections = [part for part in parts if isinstance(part, type) and issubclass(part, BaseModel)]
        if sections == [TrainingRecipe]:
            names = ", ".join(known_trainings())
            yield f"  {prefix}{name} = NAME\n      a published recipe in place of the whole section: {names}"
        for section in sections:
            yield from describe_fields(section, f"{prefix}{name}.")
        if not sections:
            default = field.get_default(call_default_factory=True)
            shown = (
                [part.model_dump() for part in default]
                if is_list and default and isinstance(default[0], BaseModel)
                else default
            )
            words = textwrap.wrap(field.description or "", 100)
            yield "\n".join([f"  {prefix}{name} = {shown}", *(f"      {line}" for line in words)])


_KINDS = (
    ("data.body", "family", None),
    ("data.poses.distribution", "name", None),
    ("training.network", "name", DEFAULT_NETWORK),
)
"""Sections of which there are several kinds, the key that says which, and which it is where that key is left out."""


def _find(name_or_file: str) -> Path | dict[str, Any]:
    """The file of a recipe, or the recipe that is stored with a dataset."""
    known = known_recipes()
    if name_or_file in known:
        return known[name_or_file]
    if "://" in name_or_file or name_or_file.rstrip("/").endswith(".zarr"):
        from datagen.store.verify import require_recipe

        return {"data": require_recipe(name_or_file).model_dump(mode="json")}
    path = Path(name_or_file)
    if path.suffix in (".yaml", ".yml"):
        if path.is_file():
            return path
        raise RecipeError(f"no recipe file {path}")
    if name_or_file in known_trainings():
        raise RecipeError(
            f"{name_or_file!r} is a recipe of training only. Add to another: --set training={name_or_file}"
        )
    raise RecipeError(f"no recipe {name_or_file!r}{nearest(name_or_file, list(known))}; there are {', '.join(known)}")


def _describe(fault: Any) -> str:
    # pydantic puts the name of a union's chosen member into the location; a person never wrote it
    location = [str(part) for part in fault["loc"]]
    parts = zip(["", *location], location, strict=False)
    key = ".".join(part for before, part in parts if not (before in _UNIONS and part in _MEMBERS))
    if fault["type"] == "extra_forbidden":
        known = [line.split()[0] for line in describe_fields()]
        if key in known:
            return f"{key!r} is a key of another kind of {key.rpartition('.')[0]!r} than the one chosen"
        return f"unknown key {key!r}{nearest(key, known)}"
    message = fault["msg"].removeprefix("Value error, ")
    # of a whole section that does not fit together, the message names the keys
    given = "" if isinstance(fault["input"], dict) else f" (given: {fault['input']!r})"
    return f"{key}: {message}{given}" if key else f"{message}{given}"


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _parts(annotation: Any) -> Iterator[Any]:
    members = get_args(annotation)
    if isinstance(annotation, type) or not members:
        yield annotation
    else:
        for member in members:
            yield from _parts(member)


_UNIONS = {section.rpartition(".")[2] for section, _, _ in _KINDS}
_MEMBERS = {*FAMILIES, *SOURCES, *NETWORK_NAMES}
