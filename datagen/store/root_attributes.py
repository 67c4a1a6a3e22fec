"""The types of a dataset's root attributes: what is read of them without a second look."""

from typing import Annotated, Any

import zarr
from pydantic import Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from datagen.store.schema import attributes_of

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
