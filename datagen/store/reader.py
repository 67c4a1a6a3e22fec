"""Reading a dataset: only a complete and sound one; anything else is an error that names the command to repair it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import ByteRequest, RangeByteRequest, SuffixByteRequest

from datagen.common.errors import DatasetError, ShardDamage, UnsafeFileError, reason_of
from datagen.grid import Grid, GridArray, GridArrays, PoseType, Split, shard_path
from datagen.mesh.rig import Rig, Rigs
from datagen.recipe import DatasetRecipe
from datagen.store.arrays import ArrayDamage, check_vertices, read_array
from datagen.store.attributes import attributes_fault
from datagen.store.codec import ShardCodec
from datagen.store.manifest import Manifest, changed_objects, covers, is_sealed, read_manifest
from datagen.store.objects import read_bytes, stored_sizes
from datagen.store.schema import (
    attributes_of,
    check_version,
    codec_of,
    open_group,
    stored_arrays,
    stored_recipe,
    stored_rig_numbers,
    stored_rigs,
)

Meshes = NDArray[np.float32]
_TOGETHER_FROM = 4  # the part of a shard that holds some meshes is read at once where a quarter of it is wanted
_MOST_INDEXES = 4096  # of shards, that are kept


@dataclass(frozen=True)
class Dataset:
    """A complete dataset. Identities and poses are numbered as in its recipe's :class:`~datagen.grid.Grid`."""

    url: str
    group: zarr.Group
    _codecs: dict[str, ShardCodec] = field(default_factory=dict, init=False, repr=False, compare=False)
    _topologies: dict[int, NDArray[np.int32]] = field(default_factory=dict, init=False, repr=False, compare=False)
    _parameters: dict[str, NDArray[np.float64]] = field(default_factory=dict, init=False, repr=False, compare=False)
    _rigs: dict[int, Rigs] = field(default_factory=dict, init=False, repr=False, compare=False)
    _indexes: dict[str, NDArray[np.uint64]] = field(default_factory=dict, init=False, repr=False, compare=False)

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
    def committed(self) -> Manifest | None:
        """What the dataset was when it was committed; None where its manifest is damaged."""
        return read_manifest(self.group)

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of each shard by its path."""
        return self.committed.sizes if self.committed else {}

    @cached_property
    def arrays(self) -> GridArrays:
        """The arrays of vertices that the dataset has for its grid.

        Raises
        ------
        DatasetError
            What says so is missing or damaged.
        """
        with self._damage():
            return stored_arrays(self.group, self.grid)

    def require_unchanged(self) -> None:
        """Refuse a dataset of which an object beside the shards is not as it was committed (DatasetError)."""
        changed = changed_objects(self.group, self.committed) if self.committed else iter(())
        if fault := next(changed, None):
            raise DatasetError(f"{self.url}: {fault[0]}: {fault[1]}. {self._mend}")

    def identities(self, split: Split) -> list[int]:
        """Identity numbers of a split."""
        return self.grid.identities(split)

    def faces(self, identity: int) -> NDArray[np.int32]:
        """Triangles [face, 3] of an identity."""
        topology = int(self.arrays.topologies[identity])
        if topology not in self._topologies:
            with self._damage():
                self._topologies[topology] = self._faces_of(topology)
        return self._topologies[topology]

    def part(self, identity: int) -> NDArray[np.int32] | None:
        """What each vertex [vertex] of an identity belongs to: 0 skin, from 1 on garments; None of a bare body."""
        topology = int(self.arrays.topologies[identity])
        if topology not in self.attributes.get("labelled", ()):
            return None
        with self._damage():
            return read_array(self.group, f"topology/{topology}/part", "int32", (self.arrays.vertices[topology],))

    def _faces_of(self, topology: int) -> NDArray[np.int32]:
        path, vertices = f"topology/{topology}/faces", self.arrays.vertices[topology]
        faces = read_array(self.group, path, "int32", (None, 3))
        if faces.size and not 0 <= faces.min() <= faces.max() < vertices:
            raise ArrayDamage(f"{path}/c/0/0", f"a face of other vertices than the {vertices} that there are")
        return faces

    def parameters(self, identity: int) -> NDArray[np.float64]:
        """Body-model parameters [parameter] of an identity."""
        array, row = self.arrays.row_of(identity)
        return self.parameters_along(array)[row]

    def parameters_along(self, array: GridArray) -> NDArray[np.float64]:
        """Body-model parameters [identity, parameter] along the first axis of an array; NaN in holes."""
        if array.path not in self._parameters:
            shape = len(array.identities), len(self.attributes["body"]["parameters"])
            with self._damage():
                self._parameters[array.path] = read_array(self.group, f"{array.path}/parameters", "float64", shape)
        return self._parameters[array.path]

    def rig(self, identity: int) -> Rig | None:
        """The rig of an identity; None where its body has no skeleton. Read when first asked for, then kept.

        Examples
        --------
        >>> world = world_rotations(dataset.rotations(), dataset.attributes["joint_parents"])
        >>> transforms = dataset.rig(0).transforms(world)  # [pose, part, 3, 4], from rest to each pose
        """
        number = int(self.rig_numbers[identity])
        if number < 0:
            return None
        if number not in self._rigs:
            self._rigs[number] = self.rigs(number)
        return self._rigs[number][int((self.rig_numbers[:identity] == number).sum())]

    def rigs(self, number: int) -> Rigs:
        """The rigs of all identities whose bodies have the parts of a number; nothing of them is kept.

        Raises
        ------
        DatasetError
            They are not as the format has them.
        """
        identities = np.flatnonzero(self.rig_numbers == number)
        vertices = self.arrays.vertices[self.arrays.topologies[identities[0]]] if len(identities) else 0
        parts = self.attributes["rigs"][number]
        with self._damage():
            return stored_rigs(self.group, number, parts, identities=len(identities), vertices=vertices)

    @cached_property
    def rig_numbers(self) -> NDArray[np.int32]:
        """Number [identity] of each identity's rig in the attribute ``rigs``; -1 where its body has none."""
        with self._damage():
            return stored_rig_numbers(self.group, self.arrays, len(self.attributes["rigs"]))

    def rotations(self) -> NDArray[np.float64]:
        """Rotations [pose, joint, 3] of the whole dataset's poses, axis-angle in radians, over its named joints."""
        joints = self.attributes["joints"]
        with self._damage():
            return read_array(self.group, "pose/parameters", "float64", (self.grid.pose_count, len(joints), 3))

    def vertex_count(self, identity: int) -> int:
        """Vertices of an identity's meshes."""
        return self._checked(self.arrays.row_of(identity)[0]).vertices

    def _checked(self, array: GridArray) -> ShardCodec:
        """How an array's shards are laid out, once its metadata were compared with it."""
        if array.path not in self._codecs:
            codec, first = codec_of(self.recipe, array), shard_path(array.place(0, 0))
            with self._damage():
                check_vertices(self.group, array, codec, stored=self.sizes.get(first, 0))
            self._codecs[array.path] = codec
        return self._codecs[array.path]

    def check_axes(self, array: GridArray) -> None:
        """Compare the numbers along the two axes of an array with the grid's (DatasetError where they differ)."""
        for name, numbers in (("identity", array.identities), ("pose", array.poses)):
            path = f"{array.path}/{name}"
            with self._damage():
                if not np.array_equal(read_array(self.group, path, "int32", numbers.shape), numbers):
                    raise ArrayDamage(f"{path}/c/0", "other numbers than the grid's")

    def vertices(self, identity: int, poses: int | Sequence[int] | NDArray[np.integer] | None = None) -> Meshes:
        """Vertices [pose, vertex, 3] float32 in metres of an identity in some poses; [vertex, 3] for one number.

        Without ``poses`` in all of its own, in the order of ``grid.poses_of(identity)``.

        Raises
        ------
        DatasetError
            A shard is missing or damaged; the message names it and the command that repairs it.
        KeyError
            The identity was not made in such a pose.
        """
        if isinstance(poses, (int, np.integer)):
            return self.vertices(identity, [int(poses)])[0]
        array, row = self.arrays.row_of(identity)
        codec = self._checked(array)
        wanted = self.grid.poses_of(identity) if poses is None else poses
        columns = np.array([array.columns[int(pose)] for pose in wanted], np.int64)
        band, first = divmod(row, codec.identities)
        meshes = np.empty((len(columns), codec.vertices, 3), np.float32)
        for number in np.unique(columns // codec.poses).tolist():
            places = np.flatnonzero(columns // codec.poses == number)
            rows = first * codec.poses + columns[places] % codec.poses
            meshes[places] = self._from_shard(shard_path(array.place(band, number)), codec, rows)
        return meshes

    def shard_vertices(self, identities: Sequence[int], poses: Sequence[int] | NDArray[np.integer]) -> Meshes:
        """Vertices [mesh, vertex, 3] float32 in metres of meshes (identity, pose) of one shard, read whole at once.

        Raises
        ------
        DatasetError
            The shard is missing or damaged.
        ValueError
            They do not all lie in one shard.
        """
        array, _ = self.arrays.row_of(identities[0])
        codec = self._checked(array)
        members = {identity: self.arrays.row_of(identity) for identity in set(identities)}
        row = np.array([members[identity][1] for identity in identities])
        column = np.array([array.columns[int(pose)] for pose in poses])
        band, place = row // codec.identities, column // codec.poses
        if any(held is not array for held, _ in members.values()) or np.ptp(band) or np.ptp(place):
            raise ValueError("the meshes lie in several shards")
        rows = row % codec.identities * codec.poses + column % codec.poses
        return self._from_shard(shard_path(array.place(int(band[0]), int(place[0]))), codec, rows, whole=True)

    def _from_shard(self, path: str, codec: ShardCodec, rows: NDArray[np.int64], *, whole: bool = False) -> Meshes:
        try:
            if whole or len(rows) * _TOGETHER_FROM >= codec.rows:
                return codec.decode(self._bytes(path), rows)
            index = self._index(path, codec)
            if len(rows) * _TOGETHER_FROM >= codec.poses:
                return self._run(path, codec, index, rows)
            return np.concatenate([self._run(path, codec, index, rows[[place]]) for place in range(len(rows))])
        except ShardDamage as error:
            self._indexes.pop(path, None)
            raise DatasetError(f"{self.url}: shard {path} is damaged: {error}. {self._mend}") from error

    def _run(self, path: str, codec: ShardCodec, index: NDArray[np.uint64], rows: NDArray[np.int64]) -> Meshes:
        """Meshes of some rows, from the bytes between the first and the last of them, which are read at once."""
        places = list(codec.places(index, rows))
        start, end = min(offset for offset, _ in places), max(offset + size for offset, size in places)
        return codec.decode_rows(self._bytes(path, RangeByteRequest(start, end)), index, rows, start=start)

    def _index(self, path: str, codec: ShardCodec) -> NDArray[np.uint64]:
        """The index of a shard, kept: a mesh that is read alone then takes one read."""
        index = self._indexes.get(path)
        if index is None:
            index = codec.decode_index(self._bytes(path, SuffixByteRequest(codec.index_bytes)))
            if len(self._indexes) >= _MOST_INDEXES:  # another thread may clear them at any time
                self._indexes.clear()
            self._indexes[path] = index
        return index

    def _bytes(self, path: str, byte_range: ByteRequest | None = None) -> bytes:
        try:
            found = read_bytes(self.group, path, limit=self.sizes.get(path, 0), byte_range=byte_range)
        except (OSError, UnsafeFileError) as error:
            raise DatasetError(f"{self.url}: shard {path} cannot be read ({reason_of(error)}). {self._mend}") from error
        if found is None:
            raise DatasetError(f"{self.url}: shard {path} is missing. {self._mend}")
        return found

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
            triples = read_array(self.group, path, "int32", (None, 4))
            if triples.size and not ((triples >= 0) & (triples < most)).all():
                raise ArrayDamage(f"{path}/c/0/0", "a triple of identities or poses that are not there")
        return triples

    @property
    def _mend(self) -> str:
        return f"Repair it: dsffnet verify {self.url} --repair"


def damage_of(read: Callable[[], Any]) -> ArrayDamage | None:
    """The damage of an array that a reading method of a dataset came to, None where there is none."""
    try:
        read()
    except DatasetError as error:
        if isinstance(error.__cause__, ArrayDamage):
            return error.__cause__
        raise
    return None


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
        raise DatasetError(f"{url}: {faults[0]}{more}. Repair it: dsffnet verify {url} --repair")
    return dataset


def _quick_faults(dataset: Dataset) -> Iterator[str]:
    if not is_sealed(dataset.group):
        yield "its attributes (zarr.json) are not as they were written"
    fault = attributes_fault(dataset.group)
    if fault:
        yield fault
    if dataset.committed is None:
        yield "its manifest is not the one that was committed"
    if damage := damage_of(lambda: dataset.arrays):
        yield f"{damage.path} is missing or damaged ({damage.reason})"
    elif dataset.committed and not covers(dataset.committed, dataset.arrays):
        yield "its manifest does not list the shards that its recipe has"
        return
    sizes = stored_sizes(dataset.group, list(dataset.sizes))
    for path, size in dataset.sizes.items():
        if path not in sizes:
            yield f"shard {path} is missing"
        elif sizes[path] != size:
            yield f"shard {path} has {sizes[path]} bytes instead of {size}"
