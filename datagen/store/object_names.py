"""The objects that a dataset can have: their paths, and how long each can be."""

import re

from zarr.core.buffer import Buffer

from datagen.common.errors import DatasetError, UnsafeFileError
from datagen.store.codec import LARGEST_CHUNK

_NUMBER = "[0-9]{1,9}"
_MEMBER = re.compile(
    rf"""(?:(?:grid|grid/training|grid/evaluation|topology|pose|evaluation|rig|manifest)/)?zarr\.json
    |grid/topology/(?:zarr\.json|c/0)
    |grid/(?:training|evaluation)/{_NUMBER}/(?:zarr\.json|(?:vertices|identity|pose|parameters)/zarr\.json
        |(?:identity|pose)/c/0|parameters/c/0/0|vertices/c/{_NUMBER}/{_NUMBER}/0/0)
    |topology/vertex_count/(?:zarr\.json|c/0)
    |topology/{_NUMBER}/(?:zarr\.json|(?:faces|part)/zarr\.json|faces/c/0/0|part/c/0)
    |pose/parameters/(?:zarr\.json|c/0/0/0)
    |evaluation/(?:seen|unseen)/(?:zarr\.json|c/0/0)
    |rig/number/(?:zarr\.json|c/0)
    |rig/{_NUMBER}/(?:zarr\.json|(?:weights|kind|joints|corrections)/zarr\.json|kind/c/0
        |(?:weights|joints|corrections)/c/0/0/0)
    |manifest/(?:rows|bytes)/(?:zarr\.json|c/0)
    |manifest/(?:place|blake3|object_sha256)/(?:zarr\.json|c/0/0)
    |manifest/extent/(?:zarr\.json|c/0/0/0)
    |manifest/so_far""",
    re.VERBOSE,
)
MEMBERS = ("grid", "topology", "pose", "evaluation", "rig", "manifest")
"""The groups that a dataset's root holds; ``rig`` only where bodies have one."""
_LEFTOVER = re.compile(r"(?:[a-z0-9_]+/)*[a-z0-9_]+\.[0-9a-f]+\.partial")
"""What a killed writer leaves of an object."""
LONGEST_LIST = 2**27
"""Bytes of zarr.json and manifest/zarr.json, which grow with the steps and the topologies of a dataset."""
_LONGEST_METADATA = 2**20
_LONGEST_ARRAY = LARGEST_CHUNK + 2**24


def is_member(path: str) -> bool:
    """Whether a path is one that an object of a dataset can have."""
    return _MEMBER.fullmatch(path) is not None


def require_member(path: str) -> None:
    """Refuse a path that no object of a dataset has.

    Raises
    ------
    UnsafeFileError
        It is not of the layout: absolute, with "..", or just something else.
    """
    if not is_member(path):
        raise UnsafeFileError(f"the dataset names {path[:200]!r}, none of its objects. Do not trust what it holds")


def is_leftover(path: str) -> bool:
    """Whether a path is that of a file that a killed writer left behind."""
    return _LEFTOVER.fullmatch(path) is not None


def limit_of(path: str) -> int:
    """The most bytes that an object can have, where nothing more is known of it."""
    if path in ("zarr.json", "manifest/zarr.json"):
        return LONGEST_LIST
    return _LONGEST_METADATA if path.endswith("zarr.json") else _LONGEST_ARRAY


def require_short(path: str, content: Buffer) -> None:
    """Refuse to write metadata that readers would refuse to read (DatasetError)."""
    if path.endswith("zarr.json") and len(content) > limit_of(path):
        raise DatasetError(
            f"{path} would have {len(content):,} bytes, more than the {limit_of(path):,} that readers take. Make "
            "several datasets"
        )
