"""Meshes of a dataset that is larger than memory: read when needed, the last used ones kept, memory bounded.

Where triples are random over the whole grid, a mesh, not a shard, is what is kept: a batch touches nearly as many
shards as meshes; were shards kept, one mesh in a hundred of them would be of use soon. Meshes of many steps are asked
for together, and a shard is decoded whole where that costs less than asking the store for each of its wanted meshes.
Where triples come in blocks of shards (:class:`training.data.triples.BlockOrder`), whole shards are read and kept.
"""

import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.errors import RecipeError
from datagen.common.resources import bytes_text
from datagen.store.objects import is_local
from training.data.vertex_layout import Floats, Layout, readers_of

_LOCAL_REQUEST_BYTES, _REMOTE_REQUEST_BYTES = 2**18, 2**21  # that are read and decoded in the time of one more request
_FEWEST_SLOTS = 64


class StreamedMeshes:
    """Normalised meshes of a layout in a given number of bytes: ``slots`` of ``rows`` vertices, the oldest used again.

    Parameters
    ----------
    memory
        Bytes for meshes.
    whole
        Read and keep whole shards.
    """

    def __init__(self, layout: Layout, *, memory: int, whole: bool = False) -> None:
        self._layout, self._whole, self.rows = layout, whole, int(layout.counts.max())
        self.slots = min(max(_FEWEST_SLOTS, memory // (12 * self.rows)), len(layout.counts))
        self._held = torch.from_numpy(np.zeros((self.slots, self.rows, 3), np.float32))  # takes memory as it fills
        self._slot: OrderedDict[int, int] = OrderedDict()
        self._guard = threading.RLock()
        self._request_bytes = _LOCAL_REQUEST_BYTES if is_local(layout.dataset.url) else _REMOTE_REQUEST_BYTES
        self._readers = ThreadPoolExecutor(readers_of(layout.dataset), thread_name_prefix="stream")

    @property
    def together(self) -> int:
        """Meshes to ask for at a time: of whole shards a quarter is room for those that the meshes asked for bring."""
        return self.slots * 3 // 4 if self._whole else self.slots

    def close(self) -> None:
        """End the reading threads."""
        self._readers.shutdown(wait=True, cancel_futures=True)

    def fetch(self, meshes: NDArray[np.int64]) -> None:
        """Read those meshes that are not held, together, and hold them all.

        Raises
        ------
        DatasetError
            A shard is missing or damaged.
        RecipeError
            They are more than there is memory for.
        """
        wanted = np.unique(meshes)
        if len(wanted) > self.slots:
            raise RecipeError(
                f"a batch needs {len(wanted)} meshes at once, but streaming has memory for {self.slots} "
                f"({bytes_text(12 * self.rows * self.slots)}). Lower training.batch"
            )
        shards, read = self._layout.shards, self._read
        if self._whole and len(whole := self._layout.whole_files(wanted)) <= self.slots:
            wanted, shards, read = whole, self._layout.files, self._layout.read_file
        with self._guard:
            missing = np.array([mesh for mesh in wanted.tolist() if mesh not in self._slot], np.int64)
            for mesh in np.setdiff1d(wanted, missing).tolist():
                self._slot.move_to_end(mesh)
            missing = missing[np.argsort(shards[missing], kind="stable")]
            places = np.flatnonzero(np.diff(shards[missing])) + 1
            by_shard = [some for some in np.split(missing, places) if len(some)]
            for some, found in zip(by_shard, self._readers.map(read, by_shard), strict=True):
                self._hold(some, found)

    def _read(self, meshes: NDArray[np.int64]) -> Floats:
        """Vertices [mesh, vertex, 3] of some meshes of one shard, which is decoded whole if that is quicker."""
        first, end = np.searchsorted(self._layout.shards, self._layout.shards[meshes[0]] + np.arange(2))
        whole = 12 * int(self._layout.counts[first]) * (end - first)
        among = np.arange(first, end) if whole < len(meshes) * self._request_bytes else None
        return self._layout.read(meshes, among=among)

    def _hold(self, meshes: NDArray[np.int64], read: Floats) -> None:
        for mesh, vertices in zip(meshes.tolist(), read, strict=True):
            free = len(self._slot) < self.slots
            slot = len(self._slot) if free else self._slot.popitem(last=False)[1]
            self._held[slot, : len(vertices)] = torch.from_numpy(vertices)
            self._held[slot, len(vertices) :] = 0
            self._slot[mesh] = slot

    def gather(self, *groups: NDArray[np.int64]) -> list[Tensor]:
        """Vertices [mesh, vertex, 3] of each group of meshes, padded with zeros to the largest of the group."""
        return [self._gathered(group) for group in groups]

    def _gathered(self, meshes: NDArray[np.int64]) -> Tensor:
        with self._guard:
            if not self._slot.keys() >= set(meshes.tolist()):
                self.fetch(meshes)
            slots = torch.tensor([self._slot[int(mesh)] for mesh in meshes])
            rows = int(self._layout.counts[meshes].max())
            return self._held[:, :rows].index_select(0, slots)
