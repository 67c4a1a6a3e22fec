"""Where the meshes of some identities lie in one array of vertices, and how they come there from a dataset."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.grid import HOLE, SPLITS, Split
from datagen.mesh.geometry import bounding_box
from datagen.store import Dataset
from datagen.store.objects import is_local

Numbers = NDArray[np.integer]
Floats = NDArray[np.float32]

_CHUNK_BYTES = 2**25  # decoded at a time by one thread
_MOST_THREADS = 8
_LOCAL_READERS, _REMOTE_READERS = 2, 16  # a remote store answers in some 30 ms, whatever is asked


def normalised(meshes: Floats) -> Floats:
    """Vertices [mesh, vertex, 3] float32 in any unit, each mesh moved and scaled to its own bounding box, in [-1, 1].

    The box's centre goes to the origin, half its longest edge to one (DSFFNet, section 4.1, after NPT).
    """
    return bounding_box(meshes).normalise(meshes).astype(np.float32, copy=False)


def readers_of(dataset: Dataset) -> int:
    """How many threads read from where a dataset lies."""
    return _LOCAL_READERS if is_local(dataset.url) else _REMOTE_READERS


def read_each(dataset: Dataset, identities: Sequence[int], poses: Sequence[int]) -> list[Floats]:
    """Vertices [vertex, 3] in metres of each mesh (identity, pose), several read at a time.

    Raises
    ------
    DatasetError
        A shard is missing or damaged.
    """
    with ThreadPoolExecutor(readers_of(dataset), thread_name_prefix="meshes") as pool:
        return list(pool.map(dataset.vertices, identities, poses))


class Layout:
    """All meshes of some identities, one after another in an array [vertex, 3], identity by identity, pose by pose.

    Attributes
    ----------
    counts
        Vertices of each mesh [mesh] int64.
    starts
        Place of each mesh' first vertex [mesh] int64.
    shards
        A number for the part of a shard that each mesh is in [mesh] int64, ascending; a part is of one identity.
    """

    def __init__(self, dataset: Dataset, identities: Sequence[int]) -> None:
        self.dataset, self.identities = dataset, tuple(int(identity) for identity in identities)
        grid = dataset.grid
        meshes = [len(grid.poses_of(identity)) for identity in self.identities]
        self.counts = np.repeat([dataset.vertex_count(identity) for identity in self.identities], meshes)
        self.starts = np.cumsum(self.counts) - self.counts
        self._owner = np.repeat(np.arange(len(meshes)), meshes)
        self._firsts = np.cumsum(meshes) - meshes
        self._index = np.full(grid.identity_count, -1)
        self._index[list(self.identities)] = np.arange(len(self.identities))
        self._split = np.array([SPLITS.index(grid.split(identity)) for identity in self.identities])
        self._place = np.stack([self._places_in(split) for split in SPLITS])
        self._columns = np.concatenate([self._shards_of(identity) for identity in self.identities])
        self.shards = self._owner * (1 + self._columns.max()) + self._columns

    def _places_in(self, split: Split) -> NDArray[np.int64]:
        """Place of every pose among those of a split's identities; -1 where they were not made in it."""
        grid = self.dataset.grid
        places, members = np.full(grid.pose_count, -1), grid.identities(split)
        poses = grid.poses_of(members[0]) if members else np.empty(0, np.int64)
        places[poses] = np.arange(len(poses))
        return places

    def _shards_of(self, identity: int) -> NDArray[np.int64]:
        """The shard of each mesh of an identity, numbered along its poses."""
        array, _ = self.dataset.arrays.row_of(identity)
        return np.flatnonzero(array.poses != HOLE) // array.room[1]

    @cached_property
    def files(self) -> NDArray[np.int64]:
        """A number for the whole shard that each mesh is in [mesh]; a shard may be of several identities."""
        held = [self.dataset.arrays.row_of(identity) for identity in self.identities]
        bands = [(SPLITS.index(array.split), array.topology, row // array.room[0]) for array, row in held]
        numbers = np.unique(bands, axis=0, return_inverse=True)[1].ravel()
        return numbers[self._owner] * (1 + self._columns.max()) + self._columns

    @cached_property
    def _by_file(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        order = np.argsort(self.files, kind="stable")
        return order, self.files[order]

    def whole_files(self, meshes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of all meshes of the shards that hold some, ascending."""
        order, files = self._by_file
        first, end = (np.searchsorted(files, np.unique(self.files[meshes]), side) for side in ("left", "right"))
        return np.sort(np.concatenate([order[start:stop] for start, stop in zip(first, end, strict=True)]))

    @property
    def vertices(self) -> int:
        """Vertices of all meshes together."""
        return int(self.counts.sum())

    @property
    def bytes(self) -> int:
        """Size of the array."""
        return 12 * self.vertices

    @property
    def count(self) -> int | None:
        """Vertices of every mesh; None where they differ."""
        return int(self.counts[0]) if (self.counts == self.counts[0]).all() else None

    def meshes(self, identities: Numbers, poses: Numbers) -> NDArray[np.int64]:
        """Numbers of the meshes (identity, pose).

        Raises
        ------
        KeyError
            An identity is not among these, or was not made in that pose.
        """
        index = self._index[identities]
        place = self._place[self._split[index], poses]
        strangers = np.flatnonzero((index < 0) | (place < 0))
        if len(strangers):
            identity, pose = int(identities[strangers[0]]), int(poses[strangers[0]])
            raise KeyError(f"identity {identity} in pose {pose} is not among the meshes of these identities")
        return self._firsts[index] + place

    def chunks(self) -> Iterator[NDArray[np.int64]]:
        """Numbers of all meshes, in order, a few whole shards of one identity at a time."""
        ends = np.append(np.flatnonzero(np.diff(self.shards)) + 1, len(self.shards))
        first = last = 0
        for end in ends.tolist():
            size = 12 * self.counts[first] * (end - first)
            if last > first and (self._owner[end - 1] != self._owner[first] or size > _CHUNK_BYTES):
                yield np.arange(first, last)
                first = last
            last = end
        yield np.arange(first, last)

    def read(self, meshes: NDArray[np.int64], *, among: NDArray[np.int64] | None = None) -> Floats:
        """Normalised vertices [mesh, vertex, 3] of some meshes of one identity, in ascending order.

        Parameters
        ----------
        among
            Read these, of which they are some; for where a whole shard is read more quickly than its parts.

        Raises
        ------
        DatasetError
            A shard is missing or damaged.
        """
        owner = int(self._owner[meshes[0]])
        asked = meshes if among is None else among
        poses = self.dataset.grid.poses_of(self.identities[owner])[asked - self._firsts[owner]]
        found = self.dataset.vertices(self.identities[owner], poses)
        return normalised(found if among is None else found[np.searchsorted(among, meshes)])

    def read_file(self, meshes: NDArray[np.int64]) -> Floats:
        """Normalised vertices [mesh, vertex, 3] of some meshes of one shard, which is read whole.

        Raises
        ------
        DatasetError
            The shard is missing or damaged.
        """
        owners, grid = self._owner[meshes], self.dataset.grid
        identities = [self.identities[owner] for owner in owners.tolist()]
        places = (meshes - self._firsts[owners]).tolist()
        poses = [grid.poses_of(identity)[place] for identity, place in zip(identities, places, strict=True)]
        return normalised(self.dataset.shard_vertices(identities, poses))


def decode(layout: Layout, device: torch.device, *, sharers: int = 1) -> Tensor:
    """Return all normalised vertices [vertex, 3] of a layout, in a device's memory.

    A few threads read: from a disk as many as the machine has processors for each of ``sharers`` processes.

    Raises
    ------
    DatasetError
        A shard is missing or damaged.
    """
    vertices = torch.empty(layout.vertices, 3, device=device)

    def one(meshes: NDArray[np.int64]) -> None:
        start, read = int(layout.starts[meshes[0]]), layout.read(meshes).reshape(-1, 3)
        vertices[start : start + len(read)] = torch.from_numpy(read).to(device)

    processors = (os.cpu_count() or 1) // sharers if is_local(layout.dataset.url) else _MOST_THREADS
    threads = max(1, min(_MOST_THREADS, processors))
    with ThreadPoolExecutor(threads, thread_name_prefix="decode") as pool:
        futures = [pool.submit(one, meshes) for meshes in layout.chunks()]
        try:
            for future in futures:
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return vertices
