"""Reading a dataset: only a complete and sound one; anything else is an error that names the mending command."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import ByteRequest, RangeByteRequest, SuffixByteRequest

from datagen.common.errors import DatasetError, ShardDamage, UnsafeFileError, reason_of
from datagen.grid import Grid, PoseType, Split
from datagen.poses import Poses
from datagen.recipe import DatasetRecipe
from datagen.store.arrays import ArrayDamage, read_array, read_topology, read_vertex_count
from datagen.store.attributes import attributes_fault
from datagen.store.codec import ShardCodec, require_plausible
from datagen.store.manifest import Manifest, covers, is_sealed, read_manifest
from datagen.store.schema import (
    ManifestRow,
    attributes_of,
    check_version,
    codec_of,
    identity_name,
    open_group,
    read_bytes,
    stored_recipe,
    stored_sizes,
    vertices_path,
)

Meshes = NDArray[np.float32]
_WHOLE_FROM = 4  # a shard is read whole where at least a quarter of it is wanted


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

    @cached_property
    def manifest(self) -> list[ManifestRow]:
        """One row a shard, ordered by path."""
        return self.committed.shards if self.committed else []

    @cached_property
    def committed(self) -> Manifest | None:
        """What the dataset was when it was committed; None where its manifest is damaged."""
        return read_manifest(self.group)

    @cached_property
    def _sizes(self) -> dict[str, int]:
        return {row.path: row.bytes for row in self.manifest}

    def identities(self, split: Split) -> list[int]:
        """Identity numbers of a split."""
        return self.grid.identities(split)

    def faces(self, identity: int) -> NDArray[np.int32]:
        """Triangles [face, 3] of an identity."""
        with self._damage():
            topology, vertices = read_topology(self.group, identity), self.vertex_count(identity)
            if (topology, vertices) not in self._topologies:
                self._topologies[topology, vertices] = self._faces_of(topology, vertices)
        return self._topologies[topology, vertices]

    def _faces_of(self, topology: str, vertices: int) -> NDArray[np.int32]:
        path = f"topology/{topology}/faces"
        faces = self._small(path, "int32", (None, 3))
        if faces.size and not 0 <= faces.min() <= faces.max() < vertices:
            raise ArrayDamage(f"{path}/c/0/0", f"a face of other vertices than the {vertices} that there are")
        return faces

    def parameters(self, identity: int) -> NDArray[np.float64]:
        """Body-model parameters [parameter] of an identity."""
        count = len(self.attributes["body"]["parameters"])
        with self._damage():
            return self._small(f"identity/{identity_name(identity)}/parameters", "float64", (count,))

    def poses(self) -> Poses:
        """The poses of the whole dataset, over its named joints."""
        joints, parents = self.attributes["joints"], self.attributes["joint_parents"]
        with self._damage():
            rotations = self._small("pose/parameters", "float64", (self.grid.pose_count, len(joints), 3))
        return Poses(tuple(joints), tuple(parents), rotations)

    def vertex_count(self, identity: int) -> int:
        """Vertices of an identity's meshes."""
        if identity not in self._counts:
            with self._damage():
                self._counts[identity] = self._vertex_count(identity)
        return self._counts[identity]

    def _vertex_count(self, identity: int) -> int:
        rows, size = len(self.grid.rows_of(identity)), self.grid.rows_per_shard(self.grid.split(identity))
        count = read_vertex_count(self.group, identity, rows=rows, rows_per_shard=size)
        first = f"{vertices_path(identity)}/c/0/0/0"
        try:
            require_plausible(12 * count * min(rows, size), stored=self._sizes.get(first, 0))
        except ShardDamage as error:
            raise ArrayDamage(f"{vertices_path(identity)}/zarr.json", f"meshes of {count} vertices: {error}") from error
        return count

    @cached_property
    def _counts(self) -> dict[int, int]:
        return {}

    @cached_property
    def _topologies(self) -> dict[tuple[str, int], NDArray[np.int32]]:
        return {}

    def vertices(self, identity: int, poses: int | Sequence[int] | NDArray[np.integer] | None = None) -> Meshes:
        """Vertices [pose, vertex, 3] float32 in metres of an identity in some poses; [vertex, 3] for one number.

        Without ``poses`` in all of its own, in the order of ``grid.poses_of(identity)``.

        Raises
        ------
        DatasetError
            A shard is missing or damaged; the message names it and the command that mends it.
        KeyError
            The identity was not made in such a pose.
        """
        if isinstance(poses, (int, np.integer)):
            return self.vertices(identity, [int(poses)])[0]
        wanted = self.grid.poses_of(identity) if poses is None else poses
        rows = np.array([self.grid.row_of(identity, int(pose)) for pose in wanted], np.int64)
        codec = codec_of(self.recipe, self.grid.split(identity), vertices=self.vertex_count(identity))
        meshes = np.empty((len(rows), codec.vertices, 3), np.float32)
        for number in np.unique(rows // codec.rows):
            places = np.flatnonzero(rows // codec.rows == number)
            path = f"{vertices_path(identity)}/c/{number}/0/0"
            meshes[places] = self._from_shard(path, codec, rows[places] % codec.rows)
        return meshes

    def _from_shard(self, path: str, codec: ShardCodec, rows: NDArray[np.int64]) -> Meshes:
        try:
            if len(rows) * _WHOLE_FROM >= codec.rows:
                return codec.decode(self._bytes(path), int(rows.max()) + 1)[rows]
            return self._single_meshes(path, codec, rows)
        except ShardDamage as error:
            raise DatasetError(f"{self.url}: shard {path} is damaged: {error}. {self._mend}") from error

    def _single_meshes(self, path: str, codec: ShardCodec, rows: NDArray[np.int64]) -> Meshes:
        index = codec.decode_index(self._bytes(path, SuffixByteRequest(codec.index_bytes)))
        meshes = np.empty((len(rows), codec.vertices, 3), np.float32)
        for mesh, (offset, size) in zip(meshes, codec.places(index, rows.tolist()), strict=True):
            codec.decode_mesh(self._bytes(path, RangeByteRequest(offset, offset + size)), mesh)
        return meshes

    def _bytes(self, path: str, byte_range: ByteRequest | None = None) -> bytes:
        try:
            found = read_bytes(self.group, path, limit=self._sizes.get(path, 0), byte_range=byte_range)
        except (OSError, UnsafeFileError) as error:
            raise DatasetError(f"{self.url}: shard {path} cannot be read ({reason_of(error)}). {self._mend}") from error
        if found is None:
            raise DatasetError(f"{self.url}: shard {path} is missing. {self._mend}")
        return found

    def _small(self, path: str, dtype: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
        return read_array(self.group, path, dtype, shape, objects=self.committed.objects if self.committed else ())

    @contextmanager
    def _damage(self) -> Iterator[None]:
        try:
            yield
        except ArrayDamage as error:
            raise DatasetError(
                f"{self.url}: {error.path} is missing or damaged ({error.reason}). {self._mend}"
            ) from error

    def evaluation_triples(self, pose_type: PoseType) -> NDArray[np.int32]:
        """Rows of (source identity, source pose, target identity, target pose); truth = (target, source pose)."""
        path = f"evaluation/{pose_type}"
        most = [self.grid.identity_count, self.grid.pose_count] * 2
        with self._damage():
            triples = self._small(path, "int32", (None, 4))
            if triples.size and not ((triples >= 0) & (triples < most)).all():
                raise ArrayDamage(f"{path}/c/0/0", "a triple of identities or poses that are not there")
        return triples

    @property
    def _mend(self) -> str:
        return f"Mend it: dsffnet verify {self.url} --repair"


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
    status = attributes_of(group).get("status")
    if status != "complete":
        raise DatasetError(
            f"{url} is incomplete (status {status!r}). Finish it: run the command that made it again, "
            f"or dsffnet verify {url} --repair"
        )
    dataset = Dataset(url, group)
    faults = list(islice(_quick_faults(dataset), 1000))
    if faults:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise DatasetError(f"{url}: {faults[0]}{more}. Mend it: dsffnet verify {url} --repair")
    return dataset


def _quick_faults(dataset: Dataset) -> Iterator[str]:
    if not is_sealed(dataset.group):
        yield "its attributes (zarr.json) are not as they were written"
    fault = attributes_fault(dataset.group)
    if fault:
        yield fault
    if dataset.committed is None:
        yield "its manifest is not the one that was committed"
    elif not covers(dataset.committed, dataset.grid):
        yield "its manifest does not list the shards that its recipe has"
    sizes = stored_sizes(dataset.group, [row.path for row in dataset.manifest])
    for row in dataset.manifest:
        if row.path not in sizes:
            yield f"shard {row.path} is missing"
        elif sizes[row.path] != row.bytes:
            yield f"shard {row.path} has {sizes[row.path]} bytes instead of {row.bytes}"
