"""The root attributes of a dataset: what they say, and whether a recipe and its assets fit those that are there."""

import importlib.metadata
import subprocess
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import zarr
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from datagen.bodies import BodyModel
from datagen.common.errors import DatasetError
from datagen.grid import POSE_TYPES, Grid
from datagen.poses import load_poses
from datagen.recipe import DatasetRecipe
from datagen.store.schema import FORMAT_VERSION, attributes_of, check_version, identity_name, stored_recipe

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


class _Complete(_Attributes):
    statistics: _Statistics


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
    return None


def _is_tree(joints: list[str], parents: list[Any]) -> bool:
    """Whether every joint leads up to a root, whose parent is -1."""
    if len(joints) != len(parents) or not all(-1 <= parent < len(joints) for parent in parents):
        return False
    rooted = {-1}
    for _ in joints:
        rooted |= {joint for joint, parent in enumerate(parents) if parent in rooted}
        if len(rooted) > len(joints):
            return True
    return not joints


_NAMESPACE = uuid.UUID("6f5a4b1e-52f7-5f0b-9a35-2f2a3a7d6c11")
_PACKAGES = ("anny", "smplx", "numpy", "scipy", "zarr", "numcodecs")


def stated(recipe: DatasetRecipe, body: BodyModel) -> dict[str, Any]:
    """What follows from a recipe and its assets alone; an existing dataset must say the same."""
    grid, digest = Grid(recipe), recipe.sha256()
    assets, poses = assets_of(recipe, body), load_poses(recipe.poses)
    identities = [(asset["name"], asset["version"]) for asset in assets]
    return {
        "format_version": FORMAT_VERSION,
        "uuid": str(uuid.uuid5(_NAMESPACE, f"{FORMAT_VERSION} {digest} {sorted(identities)}")),
        "recipe": recipe.model_dump(mode="json"),
        "recipe_sha256": digest,
        "body": {"family": recipe.body.family, "assets": assets, "parameters": list(body.parameter_names)},
        "units": "metres",
        "frame": "Y up, facing +Z, +X to the body's left",
        "joints": list(poses.joints),
        "joint_parents": list(poses.parents),
        "splits": {
            "identities": {identity_name(i): grid.split(i) for i in range(grid.identity_count)},
            "poses": {kind: _spans(grid.poses(kind)) for kind in POSE_TYPES},
        },
    }


def assets_of(recipe: DatasetRecipe, body: BodyModel) -> list[dict[str, str]]:
    """What the bytes depend on beside the recipe: the body's files and packages, and the poses'."""
    return [vars(asset) for asset in dict.fromkeys([*body.assets, *load_poses(recipe.poses).assets])]


def _spans(numbers: NDArray[np.int64]) -> list[list[int]]:
    """Numbers as a few ranges [first, end)."""
    breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
    return [[int(run[0]), int(run[-1]) + 1] for run in np.split(numbers, breaks) if len(run)]


def check_same_assets(url: str, group: zarr.Group, present: list[dict[str, str]]) -> None:
    fault = attributes_fault(group)
    if fault:
        raise DatasetError(f"{url}: {fault}. Mend it: dsffnet verify {url} --repair")
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
    """Refuse to go on with a dataset that another recipe (or version) began; the message names what differs."""
    check_version(url, group)
    if attributes_of(group).get("recipe_sha256") == recipe.sha256():
        return
    stored = stored_recipe(url, group)
    changed = ", ".join(_differences(stored.identifying(), recipe.identifying()))
    if not changed:
        raise DatasetError(
            f"{url}: the recipe in its attributes is not the one that it was made by. Run the command that made it "
            "again, with that recipe, and it is mended"
        )
    raise DatasetError(
        f"{url} was made by another recipe ({changed}). Write to another place, or add --fresh to make it anew"
    )


def _differences(old: dict[str, Any], new: dict[str, Any], prefix: str = "data") -> Iterator[str]:
    for key in sorted(old.keys() | new.keys()):
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            yield from _differences(before, after, f"{prefix}.{key}")
        elif before != after:
            yield f"{prefix}.{key}: {before} there, {after} here"


def provenance(earlier: Any) -> dict[str, Any]:
    """What makes the data here and now, and what made the part that is there already, if that was something else."""
    now = {"packages": _versions(), "git_commit": _git_commit()}
    before = dict(earlier) if isinstance(earlier, dict) else {}
    history = before.pop("earlier", [])
    if not isinstance(history, list):
        history = []
    if before and before != now:
        history = [*history, before]
    return {**now, "earlier": history} if history else now


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in _PACKAGES}


def _git_commit() -> str:
    """Commit of the working tree this code runs from, or 'unknown' (an installed copy, a submitted job)."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(
            command, capture_output=True, encoding="utf-8", errors="replace", check=True, timeout=10
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
