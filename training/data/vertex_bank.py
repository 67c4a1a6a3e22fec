"""The meshes of some identities, decoded and normalised, where there is room for them; batches of triples of them.

>>> bank = open_bank(dataset, identities, device=device)                              # doctest: +SKIP
>>> shares = bank.prefetch(order.batches(first_step=0, rank=0, ranks=2, parts=1))     # doctest: +SKIP
>>> batches = [bank.batch(triples) for triples in next(shares)]                       # doctest: +SKIP

A batch is the same to the bit from any place. ``device``: a GPU's memory, where a batch is a gather and nothing else.
``memory``: each process' own copy. ``mapped``: a file that the processes of a machine share
(:mod:`training.data.mmap_cache`). ``stream``: only what is needed soon (:mod:`training.data.streaming_cache`).
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.errors import DatasetError, StorageError
from datagen.common.resources import bytes_text
from datagen.store import Dataset
from training.data.batch import Batch, EdgeSum, EdgeTable, counts_of
from training.data.cache_policy import Cache, Choice, Place, choose, default_folder, memory_room
from training.data.mmap_cache import Log, map_vertices, mapped_path
from training.data.prefetch import Lookahead, Share
from training.data.streaming_cache import StreamedMeshes
from training.data.triples import Triples
from training.data.vertex_layout import Floats, Layout, decode
from training.networks.execution import sent


class Meshes(Protocol):
    """Where vertices are."""

    def gather(self, *groups: NDArray[np.int64]) -> list[Tensor]:
        """Vertices [mesh, vertex, 3] of each group of meshes, padded with zeros to the largest of the group."""

    def fetch(self, meshes: NDArray[np.int64]) -> None:
        """Make ready what will be gathered soon."""

    def close(self) -> None:
        """Give back what is held beside memory."""


class HeldMeshes:
    """All vertices [vertex, 3] of a layout in one tensor: on a device, in memory, or mapped."""

    def __init__(self, layout: Layout, vertices: Tensor) -> None:
        self._vertices, self._layout, self._count = vertices, layout, layout.count
        self._device = vertices.device

    def gather(self, *groups: NDArray[np.int64]) -> list[Tensor]:
        """See :class:`Meshes`. Where to look is sent to the device once for all groups."""
        meshes, sizes = np.concatenate(groups), [len(group) for group in groups]
        if self._count is not None:
            whole = self._vertices.view(-1, self._count, 3)
            numbers = sent(torch.from_numpy(meshes), self._device)
            return [whole.index_select(0, its) for its in torch.split_with_sizes(numbers, sizes)]
        where = np.stack([self._layout.counts[meshes], self._layout.starts[meshes]])
        parts = torch.split_with_sizes(sent(torch.from_numpy(where), self._device), sizes, dim=1)
        longest = [int(self._layout.counts[group].max()) for group in groups]
        return [self._padded(part[0], part[1], rows) for part, rows in zip(parts, longest, strict=True)]

    def _padded(self, counts: Tensor, starts: Tensor, rows: int) -> Tensor:
        """Vertices [mesh, rows, 3] of meshes of so many vertices that begin at these places; zeros behind them."""
        places = torch.arange(rows, device=counts.device)
        inside = places < counts[:, None]
        found = self._vertices.index_select(0, (starts[:, None] + torch.where(inside, places, 0)).flatten())
        return found.view(*inside.shape, 3).masked_fill_(~inside[..., None], 0)

    def fetch(self, meshes: NDArray[np.int64]) -> None:
        """See :class:`Meshes`; all are there."""

    def close(self) -> None:
        """See :class:`Meshes`."""


_TOGETHER_BYTES = (
    2**26
)  # of meshes that a streamed bank asks for at a time; batches of three times as many may be ready
_STREAM_SHARE = 0.25  # of the free memory, for a streamed bank
_LOGGER = logging.getLogger(__name__)


class Bank:
    """Batches of triples from meshes that are kept somewhere.

    Attributes
    ----------
    where
        In words, where the meshes are kept and why there.
    place
        The same in a word: device, memory, mapped or stream.
    """

    def __init__(
        self, layout: Layout, meshes: Meshes, edges: EdgeTable, choice: Choice, *, device: torch.device, window: int = 0
    ) -> None:
        self._layout, self._meshes, self._edges, self._device = layout, meshes, edges, device
        self.where, self.place = choice.why, choice.place
        self._window = window
        self._lookaheads: list[Lookahead] = []
        self._ready: dict[bytes, Batch] = {}

    def __len__(self) -> int:
        return len(self._layout.counts)

    def batch(self, triples: Triples) -> Batch:
        """The meshes of rows (source identity, source pose, target identity, target pose), on the bank's device.

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
        """The same shares; a thread assembles their batches ahead where that takes time, for `batch` to hand out.

        Raises
        ------
        DatasetError
            While iterating: a shard is missing or damaged.
        """
        if not self._slow():
            return shares
        lookahead = Lookahead(shares, self._prepare, self._steps_together)
        self._lookaheads.append(lookahead)
        return self._handed_out(lookahead)

    def close(self) -> None:
        """End the threads and let go of the meshes."""
        for lookahead in self._lookaheads:
            lookahead.close()
        self._meshes.close()

    def _slow(self) -> bool:
        """Whether assembling a batch takes longer than handing it from one thread to another (some 0.2 ms)."""
        if self._device.type == "cuda":
            return self.place != "device"
        out_of_memory = self._layout.bytes > memory_room().free
        return self.place == "stream" or (self.place == "mapped" and out_of_memory)

    def _handed_out(self, lookahead: Lookahead) -> Iterator[Share]:
        try:
            for share, batches in lookahead:
                self._ready = {triples.tobytes(): batch for triples, batch in zip(share, batches, strict=True)}
                yield share
        finally:
            lookahead.close()

    def _steps_together(self, share: Share) -> int:
        """How many steps' meshes to ask for together: no more than a streamed bank holds at a time."""
        return max(1, self._window // (3 * sum(len(triples) for triples in share)))

    def _prepare(self, shares: list[Share]) -> list[list[Batch]]:
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
    folder: str | Path | None = None,
    sharers: int = 1,
    edge_sum: EdgeSum = "edges",
    log: Log = _LOGGER.warning,
) -> Bank:
    """Decode the meshes of some identities to where there is room for them.

    Parameters
    ----------
    device
        Where batches are wanted.
    cache
        As :class:`training.recipes.training.TrainingRecipe` has it.
    folder
        Of memory-mapped files; by default below DSFFNET_CACHE or the user's cache folder.
    sharers
        Processes of this machine that open the same bank.
    edge_sum
        Edges of a batch: every edge once, or the three sides of every face (NPT).
    log
        Told what a person should know: a file that had to be made again, a long wait.

    Raises
    ------
    DatasetError
        A shard is missing or damaged; there are no identities.
    RecipeError
        ``cache`` names a place that has no room.
    StorageError
        ``cache`` is ``mapped`` and the file cannot be written; ``auto`` streams then.
    """
    if not len(identities):
        raise DatasetError(f"{dataset.url} has no such identities: there is nothing to train on")
    device, layout = torch.device(device), Layout(dataset, identities)
    edges = EdgeTable(dataset, identities, device=device, of=edge_sum)

    def mapped() -> Path:
        return mapped_path(layout, Path(folder) if folder else default_folder())

    choice = choose(cache, layout.bytes, device=device, mapped=mapped, sharers=sharers)
    try:
        if choice.place != "stream":
            held = _held(layout, choice.place, device, mapped, sharers=sharers, log=log)
            return Bank(layout, HeldMeshes(layout, held), edges, choice, device=device)
    except StorageError as error:
        if cache != "auto":
            raise
        log(f"training meshes are streamed, not mapped: {error}")
        choice = Choice("stream", f"streamed, {bytes_text(layout.bytes)} in all: {mapped().parent} cannot be written")
    memory = int(_STREAM_SHARE * memory_room().free / sharers)
    return streamed_bank(layout, edges, device=device, memory=memory, why=choice.why)


def _held(
    layout: Layout, place: Place, device: torch.device, mapped: Callable[[], Path], *, sharers: int, log: Log
) -> Tensor:
    """All vertices [vertex, 3] of a layout, in the place that was chosen for them."""
    if place == "mapped":
        return map_vertices(layout, mapped().parent, log=log)
    return _decoded(layout, device if place == "device" else torch.device("cpu"), sharers=sharers)


def streamed_bank(
    layout: Layout, edges: EdgeTable, *, device: torch.device, memory: int, why: str = "streamed"
) -> Bank:
    """A bank that holds ``memory`` bytes of its meshes at a time."""
    streamed = StreamedMeshes(layout, memory=memory)
    choice = Choice("stream", f"{why}; {bytes_text(12 * streamed.rows * streamed.slots)} held at a time")
    window = min(streamed.slots, _TOGETHER_BYTES // (12 * streamed.rows))
    return Bank(layout, streamed, edges, choice, device=device, window=window)


def _decoded(layout: Layout, device: torch.device, *, sharers: int) -> Tensor:
    """All vertices [vertex, 3] of a layout in a device's memory."""
    vertices = torch.empty(layout.vertices, 3, device=device)

    def put(start: int, its: Floats) -> None:
        vertices[start : start + len(its)] = torch.from_numpy(its).to(device)

    decode(layout, put, sharers=sharers)
    return vertices


def _pinned(batch: Batch) -> Batch:
    """The same in memory from which a GPU copies by itself; edges are there already."""
    source, target, truth = (its.pin_memory() for its in (batch.source, batch.target, batch.truth))
    return Batch(source, target, truth, batch.edges, batch.source_counts, batch.target_counts)
