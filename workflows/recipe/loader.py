"""The recipe of a whole workflow: its sections, overrides, and errors a person can act on."""

import difflib
import os
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, Field, ValidationError, model_validator
from pydantic_core import PydanticUndefined, to_json

from datagen.common.errors import RecipeError
from datagen.common.printable import nearest
from datagen.recipe import ANIMALS, PART_KINDS, DatasetRecipe, Frozen
from datagen.recipe import PATH_KEYS as DATA_PATH_KEYS
from datagen.recipe.text import Words, changed, fault_text, faults_text, parse_words, read_values, require_plain, shown
from training.recipes.networks import DEFAULT_NETWORK, AvatarRecipe, TemplateRecipe
from training.recipes.training import PATH_KEYS as TRAINING_PATH_KEYS
from training.recipes.training import EvaluationRecipe, TrainingRecipe
from workflows.recipe.names import known_recipes, known_trainings, named_training


def with_absolute_paths(values: Any, folder: Path) -> Any:
    """The same with absolute paths of files that lie in ``folder``: tasks run in other folders.

    Raises
    ------
    RecipeError
        On a cluster, where this folder is a copy that is thrown away, a path is relative.
    """
    if isinstance(values, dict):
        return {
            key: _absolute(value, folder, key in TRAINING_PATH_KEYS)
            if key in DATA_PATH_KEYS | TRAINING_PATH_KEYS
            else with_absolute_paths(value, folder)
            for key, value in values.items()
        }
    return [with_absolute_paths(value, folder) for value in values] if isinstance(values, list) else values


def _absolute(value: Any, folder: Path, always: bool) -> Any:
    """Data's paths that do not lie in the folder may be found elsewhere; training's may be folders still to be made."""
    if not isinstance(value, str) or value in ("", ANIMALS) or "://" in value:
        return value
    path = Path(value).expanduser()
    if not (always or (folder / path).exists()):
        return value
    if "RAY_ADDRESS" in os.environ and not path.is_absolute():
        raise RecipeError(
            f"{value!r} is a relative path, which other machines do not have. On a cluster name a full one"
        )
    return str((folder / path).resolve())


class WorkflowRecipe(Frozen):
    """Everything that a workflow does, apart from where its files go."""

    description: str = Field("", description="one line for people")
    data: DatasetRecipe = Field(default_factory=DatasetRecipe)
    training: TrainingRecipe = Field(default_factory=TrainingRecipe)
    beside: TrainingRecipe | None = Field(
        None, description="another training on the same data, measured beside the first; its keys are those of training"
    )
    evaluation: EvaluationRecipe = Field(default_factory=EvaluationRecipe)

    @model_validator(mode="after")
    def _transfers_poses(self) -> "WorkflowRecipe":
        for section, training in (("training", self.training), ("beside", self.beside)):
            if training and isinstance(training.network, _OF_AVATARS):
                name = training.network.name
                raise ValueError(f"{section}.network: {name!r} learns from scans of a person: dsffnet avatar train")
        return self

    @model_validator(mode="after")
    def _stops_by_what_there_is(self) -> "WorkflowRecipe":
        sizes = {
            "data.poses.unseen": self.data.poses.unseen,
            "data.identities.evaluation": self.data.identities.evaluation,
            "data.triples.count": self.data.triples.count,
        }
        missing = [name for name, size in sizes.items() if size == 0]
        for section, training in (("training", self.training), ("beside", self.beside)):
            if training and training.early_stopping and missing:
                raise ValueError(
                    f"{section}.early_stopping goes by the PMD on unseen poses, but {missing[0]} is 0: "
                    f"set {missing[0]}, or {section}.early_stopping=null"
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
    folder = base.resolve().parent if isinstance(base, Path) else Path.cwd()
    name, words = _named_by(parse_words(overrides, option="--set "))
    values = read_values(base) if isinstance(base, Path) else base
    require_plain(values, where=f"recipe {where}")
    if not isinstance(values, dict):
        raise RecipeError(f"recipe {where} {_NO_SECTIONS}")
    values = with_absolute_paths(_with_training(values, name), folder)
    here = Path.cwd()
    words = [(key, with_absolute_paths({(last := key.rsplit(".", 1)[-1]): value}, here)[last]) for key, value in words]
    values = changed(values, words, kinds=(*_KINDS, ("beside.network", "name", DEFAULT_NETWORK)))
    if isinstance(values.get("beside"), str):
        values["beside"] = named_training(values["beside"])
    if not values:
        raise RecipeError(f"recipe {where} {_NO_SECTIONS}")
    with recipe_faults(where):
        return WorkflowRecipe.model_validate(values)


def _named_by(words: Words) -> tuple[str | None, Words]:
    """The training recipe that ``training=NAME`` asks for, if any, and the other overrides, which refine it."""
    names = [value for key, value in words if key == "training" and isinstance(value, str)]
    others = [(key, value) for key, value in words if not (key == "training" and isinstance(value, str))]
    return (names[-1] if names else None), others


def _with_training(values: dict[str, Any], name: str | None) -> dict[str, Any]:
    """The same with a training recipe in the place of its name, or the one named here in the place of any."""
    if name is None and isinstance(values.get("training"), str):
        name = values["training"]
    return values if name is None else {**values, "training": named_training(name)}


@contextmanager
def recipe_faults(
    where: str, *, model: type[BaseModel] = WorkflowRecipe, keys: str = "dsffnet recipe --help-all"
) -> Iterator[None]:
    """Turn a failed validation of a ``model`` into one line a fault: which key, what is wrong, what was given.

    ``keys`` lists all.
    """
    try:
        yield
    except ValidationError as error:
        listed: set[str] | None = set() if error.title == model.__name__ else None
        faults = faults_text(error, lambda fault: _describe(fault, listed, model))
        end = "" if faults.endswith("?") else "."
        raise RecipeError(f"recipe {where}: {faults}{end} All keys: {keys}") from error


def save_recipe(recipe: BaseModel, path: Path) -> None:
    """Write the resolved recipe as YAML."""
    import yaml

    from datagen.common.files import write_atomically

    write_atomically(path, yaml.safe_dump(recipe.model_dump(mode="json"), sort_keys=False).encode())


def describe_fields(
    model: type[BaseModel] = WorkflowRecipe, prefix: str = "", *, recipe: BaseModel | None = None
) -> Iterator[str]:
    """One line for each key: dotted name, default, meaning; of a recipe its own values, and the kinds that it chose."""
    for name, field in model.model_fields.items():
        value = getattr(recipe, name) if recipe else None
        is_list = get_origin(field.annotation) is tuple
        parts = [] if is_list else list(_parts(field.annotation))
        sections = [part for part in parts if isinstance(part, type) and issubclass(part, BaseModel)]
        if name == "beside":
            sections = []
        if not recipe:
            sections = [section for section in sections if section not in _OF_AVATARS]
        if sections == [TrainingRecipe]:
            names = ", ".join(known_trainings())
            yield f"  {prefix}{name} = NAME\n      a published recipe in place of the whole section: {names}"
        for section in [kind for kind in sections if isinstance(value, kind)] or sections:
            own = value if isinstance(value, section) else None
            yield from describe_fields(section, f"{prefix}{name}.", recipe=own)
        if not sections:
            default: Any = value if recipe else field.get_default(call_default_factory=True)
            default = f"a training of {default.network.name!r}" if isinstance(default, TrainingRecipe) else default
            is_text = isinstance(default, str) or default is PydanticUndefined
            shown = default if is_text else to_json(default).decode()
            words = textwrap.wrap(field.description or "", 100)
            yield "\n".join([f"  {prefix}{name} = {shown}", *(f"      {line}" for line in words)])


_OF_AVATARS = (TemplateRecipe, AvatarRecipe)


_KINDS = (
    ("data.body", "family", None),
    ("data.poses.distribution", "name", None),
    ("training.network", "name", DEFAULT_NETWORK),
)
"""Sections of which there are several kinds, the key that says which, and which it is where that key is left out."""


def load_section(name_or_file: str, words: Sequence[str], section: str) -> Any:
    """The section of a recipe that a command takes; words that change another one are refused, as they change nothing.

    Raises
    ------
    RecipeError
        As :func:`load_recipe`; or a word is of another section.
    """
    recipe = load_recipe(name_or_file, words)
    for key, _ in parse_words(words, option="--set "):
        if key.split(".")[0] != section:
            raise RecipeError(f"--set {key} changes nothing here: {_TAKES[section]}. Leave it out")
    return getattr(recipe, section)


_TAKES = {
    "data": "what is made goes by data alone; give the key to the command that trains or measures",
    "training": "--data is taken as it was made, and what is learned goes by training alone",
    "evaluation": "--data and the weights are taken as they were made, and what is measured goes by evaluation alone",
}


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
    if os.path.exists(path):
        raise RecipeError(f"{path} is no recipe, which is a file called .yaml, and no dataset, which is called .zarr")
    raise RecipeError(f"no recipe {name_or_file!r}{nearest(name_or_file, list(known))}; there are {', '.join(known)}")


def _describe(fault: Any, listed: set[str] | None, model: type[BaseModel]) -> str:
    """One fault in words; of an unknown key with the keys of its section, unless these are ``listed`` (None: never)."""
    # pydantic puts the name of a union's chosen member into the location; a person never wrote it
    location = [str(part) for part in fault["loc"]]
    parts = zip(["", "", *location], ["", *location], location, strict=False)
    key = ".".join(part for *before, part in parts if not (_is_one_of_several(*before) and part in _MEMBERS))
    if fault["type"] == "extra_forbidden":
        known = [line.split()[0] for line in describe_fields(model)]
        if key.startswith("beside."):
            known = [f"beside.{name.removeprefix('training.')}" for name in known if name.startswith("training.")]
        section, keys, names = key.rpartition(".")[0], "", _names_in(location, model)
        if listed is not None and section not in listed:
            listed.add(section)
            keys = f" ({section or 'a recipe'} has {', '.join(names)})"
        if any(name == key or name.startswith(f"{key}.") for name in known):
            having = _members(section, having=location[-1])
            whose = f"of {', '.join(having)}" if having else f"of another kind of {section!r}"
            return f"{key!r} is a key {whose}, not of the one chosen{keys}"
        return f"unknown key {shown(key)}{_nearest_key(key, names, known)}{keys}"
    return fault_text(fault, key=key)


def _nearest_key(key: str, names: Sequence[str], known: Sequence[str]) -> str:
    """Words that suggest a key of that name elsewhere; one of the section, which has ``names``; or any that is near."""
    section, _, last = key.rpartition(".")
    every = [".".join(name.split(".")[:upto]) for name in known for upto in range(1, name.count(".") + 2)]
    if there := nearest(key, [name for name in every if name.split(".")[-1] == last]):
        return there
    if close := difflib.get_close_matches(last, names, n=1, cutoff=0.6):
        return f", did you mean {'.'.join(filter(None, (section, close[0])))!r}?"
    return nearest(key, known)


def _is_one_of_several(section: str, place: str) -> bool:
    """Whether what stands at a place of a section, a key or a number in a list, may be of several kinds."""
    return place in _UNIONS or (section in ("bodies", "parts") and place.isdigit())


def _names_in(location: list[str], model: type[BaseModel]) -> list[str]:
    """The keys of the section of an unknown key, of the kind that was chosen; ``location`` names it."""
    models: list[type[BaseModel]] = [model]
    for part in location[:-1]:
        chosen = [model for model in models if part in (field.default for field in model.model_fields.values())]
        fields = [model.model_fields[part] for model in models if part in model.model_fields]
        inner = [kind for field in fields for kind in _parts(field.annotation) if hasattr(kind, "model_fields")]
        models = chosen or inner or models
    return list(dict.fromkeys(name for model in models for name in model.model_fields))


def _parts(annotation: Any) -> Iterator[Any]:
    members = get_args(annotation)
    if isinstance(annotation, type) or not members:
        yield annotation
    else:
        for member in members:
            yield from _parts(member)


_NO_SECTIONS = "is not a mapping of sections (data, training, beside, evaluation), or is empty"


_UNIONS = {section.rpartition(".")[2] for section, _, _ in _KINDS}


def _members(section: str, *, having: str = "") -> list[str]:
    """What a section that has several kinds may be, those ``having`` a key or all; none of another section."""
    tag = next((key for name, key, _ in _KINDS if name == section.replace("beside.", "training.")), None)
    if tag is None:
        return []
    *way, last = section.replace("beside.", "training.").split(".")
    model: Any = WorkflowRecipe
    for name in way:
        model = model.model_fields[name].annotation
    kinds = _parts(model.model_fields[last].annotation)
    return [kind.model_fields[tag].default for kind in kinds if (having or tag) in kind.model_fields]


_MEMBERS = {*PART_KINDS, *(member for section, _, _ in _KINDS for member in _members(section))}
