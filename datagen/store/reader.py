"""Reading a dataset: only a complete and sound one; anything else is an error that names the mending command."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from datagen.errors import DatasetError
from datagen.grid import Grid, PoseType, Split
from datagen.recipe import DatasetRecipe
from datagen.store.schema import (
    ManifestRow,
    array_at,
    attributes_of,
    check_version,
    identity_name,
    open_group,
    stored_recipe,
    stored_sizes,
    vertices_path,
)


@dataclass(frozen=True)
class Dataset:
    """A complete dataset. Identities and poses are numbered as in its recipe's :class:`~datagen.grid.Grid`."""

    url: str
    group: zarr.Group

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """The root attributes (see :mod:`datagen.store.schema`)."""
        return attributes_of(self.group)

    @cached_property
    def recipe(self) -> DatasetRecipe:
        """The recipe that the dataset was made by."""
        return stored_recipe(self.url, self.group)

    @cached_property
    def grid(self) -> Grid:
        """The identity x pose grid of the recipe."""
        return Grid(self.recipe)

    @property
    def uuid(self) -> str:
        """Identity of the content: equal for two datasets made from one recipe and one set of assets."""
        return str(self.attributes["uuid"])

    @property
    def manifest(self) -> list[ManifestRow]:
        """One row a shard, ordered by path."""
        return read_manifest(self.group)

    def identities(self, split: Split) -> list[int]:
        """Identity numbers of a split."""
        return [i for i in range(self.grid.identity_count) if self.grid.split(i) == split]

    def faces(self, identity: int) -> NDArray[np.int32]:
        """Triangles [face, 3] of an identity."""
        topology = self.group[f"identity/{identity_name(identity)}"].attrs["topology"]
        return np.asarray(array_at(self.group, f"topology/{topology}/faces")[:])

    def parameters(self, identity: int) -> NDArray[np.float64]:
        """Body-model parameters [parameter] of an identity."""
        return np.asarray(array_at(self.group, f"identity/{identity_name(identity)}/parameters")[:])

    def vertices(self, identity: int, rows: slice | int = slice(None)) -> NDArray[np.float32]:
        """Vertices [row, vertex, 3] (or [vertex, 3] for one row) in metres; row r is pose ``grid.poses_of(i)[r]``.

        Raises
        ------
        DatasetError
            A shard is missing or damaged; the message names it and the command that mends it.
        """
        path = vertices_path(identity)
        try:
            vertices = np.asarray(array_at(self.group, path)[rows])
        except (RuntimeError, ValueError, OSError) as error:
            raise DatasetError(f"{self._shards(path)} damaged ({error}). {self._mend}") from error
        if not np.isfinite(vertices).all():  # a missing shard reads as the fill value, NaN
            raise DatasetError(f"{self._shards(path)} missing (fill values were read). {self._mend}")
        return vertices

    def evaluation_triples(self, pose_type: PoseType) -> NDArray[np.int32]:
        """Rows of (source identity, source pose, target identity, target pose); truth = (target, source pose)."""
        return np.asarray(array_at(self.group, f"evaluation/{pose_type}")[:])

    @property
    def _mend(self) -> str:
        return f"Mend it: dsffnet verify {self.url} --repair"

    def _shards(self, path: str) -> str:
        return f"{self.url}: a shard of {path} is"


def read_manifest(group: zarr.Group) -> list[ManifestRow]:
    """Manifest rows of a group, empty where there is no manifest yet."""
    if "manifest" not in group:
        return []
    manifest = group.require_group("manifest")
    return [ManifestRow.from_json(row) for row in attributes_of(manifest).get("shards", [])]


def open_dataset(url: str) -> Dataset:
    """Open a complete dataset and check that every shard of its manifest is there with its size.

    Contents are checked on every read (crc32c) and, by hash, by ``dsffnet verify``.

    Raises
    ------
    DatasetError
        No dataset, another format version, still building, or shards missing or truncated.
    """
    group = open_group(url)
    check_version(url, group)
    status = attributes_of(group)["status"]
    if status != "complete":
        raise DatasetError(
            f"{url} is incomplete (status {status!r}). Finish it: run the command that made it again, "
            f"or dsffnet verify {url} --repair"
        )
    manifest = read_manifest(group)
    faults = list(_quick_faults(group, manifest))
    if faults:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise DatasetError(f"{url}: {faults[0]}{more}. Mend it: dsffnet verify {url} --repair")
    return Dataset(url, group)


def _quick_faults(group: zarr.Group, manifest: list[ManifestRow]) -> Iterator[str]:
    sizes = stored_sizes(group, [row.path for row in manifest])
    for row in manifest:
        if row.path not in sizes:
            yield f"shard {row.path} is missing"
        elif sizes[row.path] != row.bytes:
            yield f"shard {row.path} has {sizes[row.path]} bytes instead of {row.bytes}"
