"""The meshes of some identities, decoded and normalised, and batches of triples of them.

>>> bank = open_bank(dataset, identities, device=device)                              # doctest: +SKIP
>>> shares = bank.prefetch(order.batches(first_step=0, rank=0, ranks=2, parts=1))     # doctest: +SKIP
>>> batches = [bank.batch(triples) for triples in next(shares)]                       # doctest: +SKIP

A batch is the same to the bit from either place. ``device``: the memory of the device that trains, where a batch is a
gather and nothing else. ``stream``: as many as memory has room for (:mod:`training.data.streaming_cache`).
"""

from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.errors import DatasetError
from datagen.common.resources import bytes_text
from datagen.store import Dataset
from training.data.batch import Batch, EdgeSum, EdgeTable, counts_of
from training.data.cache_policy import Cache, Choice, choose, room_of, stream_memory
from training.data.prefetch import Share, prepared_ahead
from training.data.streaming_cache import StreamedMeshes
from training.data.triples import Triples
from training.data.vertex_layout import Layout, decode
from training.networks.execution import sent

_TOGETHER_BYTES = 2**26
"""Of meshes that are streamed at a time; batches of three times as many may be ready."""


class HeldMeshes:
    """All vertices [vertex, 3] of a layout in one tensor on a device."""

    def __init__(self, layout: Layout, vertices: Tensor) -> None:
        self._vertices, self._layout, self._count = vertices, layout, layout.count
        self._device = vertices.device

    def gather(self, *groups: NDArray[np.int64]) -> list[Tensor]:
        """Return the vertices [mesh, vertex, 3] of each group of meshes, padded with zeros to its largest.

        The numbers of all groups are sent to the device together.
        """
        meshes, sizes = np.concatenate(groups), [len(group) for group in groups]
        if self._count is not None:
            whole = self._vertices.view(-1, self._count, 3)
            numbers = sent(torch.from_numpy(meshes), self._device)
            return [whole.index_select(0, group) for group in torch.split_with_sizes(numbers, sizes)]
        where = np.stack([self._layout.counts[meshes], self._layout.starts[meshes]])
        parts = torch.split_with_sizes(sent(torch.from_numpy(where), self._device), sizes, dim=1)
        longest = [int(self._layout.counts[group].max()) for group in groups]
        return [self._padded(part[0], part[1], rows) for part, rows in zip(parts, longest, strict=True)]

    def _padded(self, counts: Tensor, starts: Tensor, rows: int) -> Tensor:
        """Vertices [mesh, rows, 3] of meshes of so many vertices that begin at these places; zeros after them."""
        places = torch.arange(rows, device=counts.device)
        inside = places < counts[:, None]
        vertices = self._vertices.index_select(0, (starts[:, None] + torch.where(inside, places, 0)).flatten())
        return vertices.view(*inside.shape, 3).masked_fill_(~inside[..., None], 0)


class VertexBank:
    """Batches of triples from meshes that are kept somewhere.

    Attributes
    ----------
    where
        In words, where the meshes are kept and why there.
    place
        The same in a word: device or stream.
    """

    def __init__(
        self,
        layout: Layout,
        meshes: HeldMeshes | StreamedMeshes,
        edges: EdgeTable,
        choice: Choice,
        *,
        device: torch.device,
    ) -> None:
        self._layout, self._meshes, self._edges, self._device = layout, meshes, edges, device
        self.where, self.place = choice.why, choice.place
        self._ahead: list[Generator[Share]] = []
        self._ready: dict[bytes, Batch] = {}

    def __len__(self) -> int:
        return len(self._layout.counts)

    def batch(self, triples: Triples) -> Batch:
        """Return the meshes of rows (source identity, source pose, target identity, target pose), on the device.

        Raises
        ------
        DatasetError
            A shard is missing or damaged (streamed meshes only; others are decoded when the bank is opened).
        KeyError
            A triple names an identity that the bank does not have, or a pose that it was not made in.
        """
        ready = self._ready.pop(triples.tobytes(), None)
        return (ready or self._assemble(triples)).to(self._device, non_blocking=True)

    def prefetch(self, shares: Iterator[Share]) -> Iterator[Share]:
        """Return the same shares; a thread assembles batches of streamed meshes ahead, for `batch` to hand out.

        Raises
        ------
        DatasetError
            While iterating: a shard is missing or damaged.
        """
        if not isinstance(self._meshes, StreamedMeshes):
            return shares  # a gather takes no longer than handing a batch from one thread to another (some 0.2 ms)
        self._ahead.append(self._handed_out(shares))
        return self._ahead[-1]

    def close(self) -> None:
        """End the threads and let go of the meshes."""
        for shares in self._ahead:
            shares.close()
        if isinstance(self._meshes, StreamedMeshes):
            self._meshes.close()

    def _handed_out(self, shares: Iterator[Share]) -> Generator[Share]:
        with closing(prepared_ahead(shares, self._prepare, self._steps_together)) as ahead:
            for share, batches in ahead:
                self._ready = {triples.tobytes(): batch for triples, batch in zip(share, batches, strict=True)}
                yield share

    def _steps_together(self, share: Share) -> int:
        """How many steps' meshes to ask for together: no more than are held at a time."""
        assert isinstance(self._meshes, StreamedMeshes)
        window = min(self._meshes.together, _TOGETHER_BYTES // (12 * self._meshes.rows))
        return max(1, window // (3 * sum(len(triples) for triples in share)))

    def _prepare(self, shares: list[Share]) -> list[list[Batch]]:
        assert isinstance(self._meshes, StreamedMeshes)
        triples = np.concatenate([triples for share in shares for triples in share])
        self._meshes.fetch(np.concatenate(self._numbers(triples)))
        prepared = [[self._assemble(triples) for triples in share] for share in shares]
        if self._device.type != "cuda":
            return prepared
        with torch.cuda.device(self._device):  # a new thread's is the first one
            return [[_pinned(batch) for batch in each] for each in prepared]

    def _assemble(self, triples: Triples) -> Batch:
        source_meshes, target_meshes = self._numbers(triples)
        source, both = self._meshes.gather(source_meshes, target_meshes)
        target, truth = both.chunk(2)
        edges = self._edges.of(triples[:, 2], rows=target.shape[1])
        counts = self._layout.counts
        source_counts, target_counts = counts_of(counts[source_meshes]), counts_of(counts[target_meshes])
        targets = target_counts and target_counts[: len(triples)]
        return Batch(source, target, truth, edges, source_counts, targets)

    def _numbers(self, triples: Triples) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Mesh numbers of the sources [b], and of the targets and then the truths [2 b]."""
        source_identity, source_pose, target_identity, target_pose = triples.T
        poses = np.concatenate([target_pose, source_pose])
        targets = self._layout.meshes(np.concatenate([target_identity, target_identity]), poses)
        return self._layout.meshes(source_identity, source_pose), targets


def open_bank(
    dataset: Dataset,
    identities: Sequence[int],
    *,
    device: torch.device | str = "cpu",
    cache: Cache = "auto",
    sharers: int = 1,
    edge_sum: EdgeSum = "edges",
    block: int | None = None,
    memory: int | None = None,
) -> VertexBank:
    """Decode the meshes of some identities to a device where it has room for them; stream them else.

    Parameters
    ----------
    device
        Where batches are wanted.
    cache
        As :class:`training.recipes.training.TrainingRecipe` has it.
    sharers
        Processes of this machine that open the same bank.
    edge_sum
        Edges of a batch: every edge once, or the three sides of every face (NPT).
    block
        Bytes of meshes that triples in blocks of shards need at a time; None: triples over the whole grid.
    memory
        Bytes that streamed meshes may take; by default half of what is free, divided among the sharers.

    Raises
    ------
    DatasetError
        A shard is missing or damaged; there are no identities.
    RecipeError
        ``cache`` is ``device``, which has no room.
    """
    if not len(identities):
        raise DatasetError(f"{dataset.url} has no such identities: there is nothing to train on")
    device, layout = torch.device(device), Layout(dataset, identities)
    edges = EdgeTable(dataset, identities, device=device, of=edge_sum)
    choice = choose(cache, layout.bytes, room_of(device, sharers=sharers))
    if choice.place == "device":
        held = HeldMeshes(layout, decode(layout, device, sharers=sharers))
        return VertexBank(layout, held, edges, choice, device=device)
    free = stream_memory(sharers=sharers) if memory is None else memory
    streamed = StreamedMeshes(layout, memory=free if block is None else min(block, free), whole=block is not None)
    held_at_once = bytes_text(12 * streamed.rows * streamed.slots)
    reads = _reads(block, free) if streamed.slots < len(layout.counts) else ""
    why = f"{choice.why}; {held_at_once} held at a time{reads}"
    return VertexBank(layout, streamed, edges, replace(choice, why=why), device=device)


def _reads(block: int | None, free: int) -> str:
    """What the memory for streamed meshes means for the store that is read."""
    if block is None:
        return ", meshes read again and again (training.block has each shard read once an epoch; set it in a new run)"
    if block > free:
        return f", less than the {bytes_text(block)} of the block: shards are read more than once an epoch"
    return ", each shard read about once an epoch"


def _pinned(batch: Batch) -> Batch:
    """The same in memory from which a GPU copies by itself; edges are there already."""
    source, target, truth = (mesh.pin_memory() for mesh in (batch.source, batch.target, batch.truth))
    return replace(batch, source=source, target=target, truth=truth)
