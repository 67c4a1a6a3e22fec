"""The root attributes of a dataset: their types, and whether a recipe and its assets fit those that are there."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, NotRequired

import zarr
from pydantic import Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from datagen.common.errors import DatasetError
from datagen.recipe import DatasetRecipe
from datagen.store.schema import attributes_of, check_version, stored_recipe

_Triple = Annotated[list[float], Field(min_length=3, max_length=3)]


class _Asset(TypedDict):
    name: str
    licence: str
    version: str


class _Body(TypedDict):
    family: str
    assets: list[_Asset]
    parameters: list[str]


class _Provenance(TypedDict):
    packages: dict[str, str]
    git_commit: str


class _Statistics(TypedDict):
    meshes: int
    bytes: int
    minimum: _Triple
    maximum: _Triple


class _Parts(TypedDict):
    names: list[str]
    parents: list[int]
    drivers: list[int]


class _Attributes(TypedDict):
    uuid: str
    status: str
    recipe_sha256: str
    body: _Body
    units: str
    frame: str
    provenance: _Provenance
    joints: list[str]
    joint_parents: list[int]
    splits: dict[str, Any]
    rigs: list[_Parts]
    labelled: NotRequired[list[int]]


class _Complete(_Attributes):
    statistics: _Statistics


_MOST_PARTS = 300  # of a rig; Anny has 52 bones
_BUILDING, _COMPLETE = TypeAdapter(_Attributes), TypeAdapter(_Complete)


def attributes_fault(group: zarr.Group) -> str | None:
    """What is wrong with the types of the root's attributes, None if nothing is."""
    attributes = attributes_of(group)
    typed = _COMPLETE if attributes.get("status") == "complete" else _BUILDING
    try:
        typed.validate_python(attributes, strict=True)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        return f"its attribute {'.'.join(map(str, first['loc']))[:80]} is wrong: {first['msg']}"
    if not _is_tree(attributes["joints"], attributes["joint_parents"]):
        return "its attributes joints and joint_parents are no tree"
    if not all(_are_parts(parts, joints=len(attributes["joints"])) for parts in attributes["rigs"]):
        return "its attribute rigs names no parts of a body"
    return None


def _are_parts(parts: _Parts, *, joints: int) -> bool:
    """Whether the parts of a rig have parents before them and pose joints that are there."""
    names, parents, drivers = parts["names"], parts["parents"], parts["drivers"]
    return (
        0 < len(names) == len(parents) == len(drivers) <= _MOST_PARTS
        and all(-1 <= parent < part for part, parent in enumerate(parents))
        and all(-1 <= driver < joints for driver in drivers)
    )


def _is_tree(joints: list[str], parents: list[int]) -> bool:
    """Whether every joint has its parent before it, or is a root, whose parent is -1."""
    return len(joints) == len(parents) and all(-1 <= parent < joint for joint, parent in enumerate(parents))


def check_same_assets(url: str, group: zarr.Group, present: list[dict[str, str]]) -> None:
    fault = attributes_fault(group)
    if fault:
        raise DatasetError(f"{url}: {fault}. Repair it: dsffnet verify {url} --repair")
    stored = attributes_of(group)["body"]["assets"]
    if _identities(stored) == _identities(present):
        return
    there, here = _identities(stored), _identities(present)
    raise DatasetError(
        f"{url} was made from {_named(there - here)}, but here is {_named(here - there)}. "
        "Use what it was made from, or write to another place, or add --fresh to make it anew"
    )


def _identities(assets: Sequence[dict[str, str]]) -> set[tuple[str, str]]:
    """Name and version of each asset; how its licence is worded does not change its bytes."""
    return {(asset["name"], asset["version"]) for asset in assets}


def _named(assets: set[tuple[str, str]]) -> str:
    return ", ".join(f"{name} {version}" for name, version in sorted(assets)) or "nothing of the kind"


def check_same_recipe(url: str, group: zarr.Group, recipe: DatasetRecipe) -> None:
    """Refuse to resume a dataset that another recipe (or version) began; the message names what differs."""
    check_version(url, group)
    if attributes_of(group).get("recipe_sha256") == recipe.sha256():
        return
    stored = stored_recipe(url, group)
    changed = ", ".join(_differences(stored.identifying(), recipe.identifying()))
    if not changed:
        raise changed_recipe(url)
    raise DatasetError(
        f"{url} was made by another recipe ({changed}). Write to another place, or add --fresh to make it anew"
    )


def changed_recipe(url: str) -> DatasetError:
    """The error of a dataset whose recipe is not the one that its hash is of."""
    return DatasetError(
        f"{url}: the recipe in its attributes is not the one that it was made by. Run the command that made it again, "
        "with that recipe, and it is repaired"
    )


def _differences(old: dict[str, Any], new: dict[str, Any], prefix: str = "data") -> Iterator[str]:
    for key in sorted(old.keys() | new.keys()):
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            yield from _differences(before, after, f"{prefix}.{key}")
        elif before != after:
            yield f"{prefix}.{key}: {before} there, {after} here"


def with_history(now: Mapping[str, Any], before: Any) -> dict[str, Any]:
    """The provenance of a dataset that is made on with: what makes it now, and what made the part that is there."""
    earlier = dict(before) if isinstance(before, dict) else {}
    history = earlier.pop("earlier", [])
    if not isinstance(history, list):
        history = []
    if earlier and earlier != now:
        history = [*history, earlier]
    return {**now, "earlier": history} if history else dict(now)
