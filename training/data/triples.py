"""Which triples a training shows, and in which order: shuffled over the whole grid, or in blocks of its shards."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import DatasetError, RecipeError
from datagen.common.resources import bytes_text
from datagen.common.seeding import Stream, generator
from datagen.store import Dataset
from training.data.order import BatchOrder
from training.recipes.training import TrainingRecipe, block_bytes

Triples = NDArray[np.integer]
"""Rows [triple, 4] of (source identity, source pose, target identity, target pose)."""


def epoch_triples(*, identities: int, poses: int, seed: int, epoch: int) -> NDArray[np.int64]:
    """All triples of an epoch in their order: rows (source identity, source pose, target identity, target pose).

    A pure function of its arguments; identities are numbered within the training split. Row order is a random
    permutation of the grid's cells, each cell (target identity, source pose) being the truth once.
    """
    random = generator(seed, Stream.TRAINING_TRIPLES, epoch)
    target, source_pose = np.divmod(random.permutation(identities * poses), poses)
    source = (target + random.integers(1, identities, len(target))) % identities
    target_pose = (source_pose + random.integers(1, poses, len(target))) % poses
    return np.stack([source, source_pose, target, target_pose], axis=1)


def order_of(recipe: TrainingRecipe, dataset: Dataset) -> "TripleOrder":
    """The order of triples of a training by this recipe on this dataset: training identities in seen poses.

    Raises
    ------
    DatasetError, RecipeError
        See :class:`TripleOrder`, :class:`BlockOrder`.
    """
    identities, poses = dataset.identities("training"), dataset.grid.poses("seen")
    if recipe.block is None:
        return TripleOrder(identities, poses, batch=recipe.batch, seed=recipe.seed)
    rows, columns = dataset.arrays.strips("training")
    mesh_bytes = 12 * max(dataset.vertex_count(identity) for identity in identities)
    room = Block(Strips(rows), Strips(columns), meshes=block_bytes(recipe.block) // mesh_bytes, mesh_bytes=mesh_bytes)
    return BlockOrder(identities, poses, room, batch=recipe.batch, seed=recipe.seed)


def last_step_of(recipe: TrainingRecipe, dataset: Dataset) -> int:
    """The step at which a training of this recipe on this dataset ends, unless early stopping ends it before."""
    return recipe.last_step(order_of(recipe, dataset).steps_per_epoch)


@dataclass(frozen=True)
class TripleOrder(BatchOrder):
    """The order of training triples of some identities and poses."""

    identities: Sequence[int]
    poses: Sequence[int] | NDArray[np.integer]

    def __post_init__(self) -> None:
        if len(self.identities) < 2 or len(self.poses) < 2:
            raise DatasetError(
                f"a training triple needs two identities and two poses, but the training split has "
                f"{len(self.identities)} identities in {len(self.poses)} poses. Make a larger one: "
                "--set data.identities.training=... data.poses.seen=..."
            )
        if self.steps_per_epoch == 0:
            raise DatasetError(
                f"the training grid has {self.cells} cells, fewer than a batch of {self.batch}. "
                f"Use --set training.batch={self.cells} at most, or make more poses"
            )

    @property
    def cells(self) -> int:
        return len(self.identities) * len(self.poses)

    def memory(self, *, rank: int = 0, ranks: int = 1) -> int | None:
        """Bytes of the meshes that this rank's triples need for a while; None: of all meshes, at any time."""
        return None

    def epoch(self, number: int) -> NDArray[np.int64]:
        """An epoch's triples, by the dataset's numbers of identities and poses."""
        identities, poses = np.asarray(self.identities), np.asarray(self.poses)
        triples = epoch_triples(identities=len(identities), poses=len(poses), seed=self.seed, epoch=number)
        source, source_pose, target, target_pose = triples.T
        return np.stack([identities[source], poses[source_pose], identities[target], poses[target_pose]], axis=1)


class Strips:
    """What lies along one axis of the grid, in strips: those that lie in one row, or one column, of shards.

    Parameters
    ----------
    of
        The strip of each [number], from 0.
    """

    def __init__(self, of: NDArray[np.integer]) -> None:
        self.of, self.sizes = of.astype(np.int32), np.bincount(of).astype(np.int32)
        self._members = np.argsort(of, kind="stable").astype(np.int32)
        self._starts = (np.cumsum(self.sizes) - self.sizes).astype(np.int32)
        self._place = np.empty(len(of), np.int32)
        self._place[self._members] = np.arange(len(of)) - self._starts[of[self._members]]

    @property
    def groups(self) -> int:
        """How many groups of two strips there are; the last one has three where their number is odd."""
        return max(1, len(self.sizes) // 2)

    def group(self, place: NDArray[np.integer]) -> NDArray[np.integer]:
        """The group of a strip at a place of a shuffled list of strips."""
        return np.minimum(place // 2, self.groups - 1)

    def others(
        self, random: np.random.Generator, of: NDArray[np.int32], lists: NDArray[np.int32], which: NDArray[np.integer]
    ) -> NDArray[np.int32]:
        """Another than each of ``of`` [n], from its strip or another one of its group.

        Over all lists each other is drawn alike often, where strips are equally long; what lies in a shorter one a
        little less often.

        Parameters
        ----------
        lists
            Shuffled lists of all strips [list, strip].
        which
            The list that holds for each [n].
        """
        strip, count = self.of[of], len(self.of)
        place = _places(lists)[which, strip]
        first = 2 * self.group(place)
        strips = np.where(first == 2 * (self.groups - 1), len(self.sizes) - first, 2).astype(np.int32)
        next_to = first + (place - first + 1 + _below(random, np.maximum(strips - 1, 1))) % strips
        del place, first, strips
        elsewhere = lists[which, next_to]
        del next_to
        there = self._starts[elsewhere] + _below(random, self.sizes[elsewhere])
        size = self.sizes[strip]
        here = self._starts[strip] + (self._place[of] + 1 + _below(random, np.maximum(size - 1, 1))) % size
        del strip
        away = (count - size) / max(count - 1, 1) * self.sizes[elsewhere] / self.sizes.max()
        away[size == 1] = 1.0  # one that is alone has nothing else here
        del size, elsewhere
        return self._members[np.where(random.random(len(of)) < away, there, here)]


def _places(lists: NDArray[np.int32]) -> NDArray[np.int32]:
    """The place of each strip in shuffled lists [list, strip]."""
    return np.argsort(lists, axis=-1).astype(np.int32)


def _below(random: np.random.Generator, ends: NDArray[np.int32]) -> NDArray[np.int32]:
    """A number from 0 to below each of some ends."""
    return random.integers(0, ends).astype(np.int32)


@dataclass(frozen=True)
class Block:
    """The shards of a training grid, by rows of identities and columns of poses, and how many meshes may be held."""

    rows: Strips
    columns: Strips
    meshes: int
    mesh_bytes: int

    @property
    def tiles(self) -> int:
        """Tiles of an epoch."""
        return self.rows.groups * self.columns.groups

    @property
    def tile(self) -> float:
        """Meshes of a tile, in the mean."""
        return len(self.rows.of) * len(self.columns.of) / self.tiles


_HELD_TILES, _EPOCH_TILES = 4, 8
"""Of each lane at least: that a block holds, so that triples of several are mixed; that an epoch has, as those at its
two ends are read by two lanes."""


@dataclass(frozen=True)
class BlockOrder(TripleOrder):
    """An order for meshes that do not fit into memory: each shard is needed once an epoch, for a while.

    An epoch pairs the columns of shards by chance and, for each pair of columns, the rows of shards: four shards are a
    tile (six or nine where a number is odd). The meshes of a triple lie in one tile. The tiles come in random order,
    the triples of a tile in random order; then each triple is put off by a random number of places, up to a
    ``reach``, so that those of several tiles mix.

    A batch has ``lanes`` equal parts, each of which goes through a stretch of tiles of its own: ranks that share
    lanes as a whole read each tile once, all together, and the triples do not depend on how many ranks there are.

    As in the full shuffle, each cell (target identity, source pose) is the truth once an epoch, and any single triple
    has the same distribution, where shards are equally large. (Else a pose of a smaller shard is the target's somewhat
    less often, and so is an identity the source's.) What differs: triples that are near in the order share identities
    and poses.

    Raises
    ------
    RecipeError
        The block is too small for its four tiles, or all meshes take no more than these.
    """

    block: Block

    def __post_init__(self) -> None:
        super().__post_init__()
        least = int(_HELD_TILES * self.block.tile) + 1
        if self.block.meshes < least and least >= self.cells:
            raise RecipeError(
                f"training.block is for data larger than memory, but all {self.cells:,} meshes take "
                f"{bytes_text(self.cells * self.block.mesh_bytes)}: leave it out"
            )
        if self.block.meshes < least:
            raise RecipeError(
                f"training.block holds {self.block.meshes:,} meshes of {bytes_text(self.block.mesh_bytes)}, but "
                f"{_HELD_TILES} tiles of this dataset's shards have {least:,}. Set it to "
                f"{bytes_text(1.1 * least * self.block.mesh_bytes).replace(' ', '').replace(',', '')} or more"
            )

    @cached_property
    def lanes(self) -> int:
        """Parts of a batch that go through tiles of their own."""
        most = min(self.block.meshes / (_HELD_TILES * self.block.tile), self.block.tiles / _EPOCH_TILES)
        return max(lanes for lanes in range(1, self.batch + 1) if self.batch % lanes == 0 and lanes <= max(1, most))

    @property
    def reach(self) -> float:
        """Places of its lane that a triple is put off at most."""
        return 0.75 * self.block.meshes / self.lanes - 2 * self.block.tile  # the rest is for what is read ahead

    def memory(self, *, rank: int = 0, ranks: int = 1) -> int:
        ((start, stop),), width = self._cuts(rank=rank, ranks=ranks, parts=1), self.batch // self.lanes
        lanes = (stop - 1) // width - start // width + 1
        return self.block.meshes * self.block.mesh_bytes * lanes // self.lanes

    def epoch(self, number: int) -> NDArray[np.int64]:
        """An epoch's triples, by the dataset's numbers of identities and poses."""
        random = generator(self.seed, Stream.TRAINING_TRIPLES, number)
        rows, columns = self.block.rows, self.block.columns
        target, source_pose = self._cells(random)
        column_list = random.permutation(len(columns.sizes)).astype(np.int32)[None]
        row_lists = np.tile(np.arange(len(rows.sizes), dtype=np.int32), (columns.groups, 1))
        row_lists = random.permuted(row_lists, axis=1)
        group = columns.group(_places(column_list[0])[columns.of[source_pose]])
        tile = group * rows.groups + rows.group(_places(row_lists)[group, rows.of[target]])
        source = rows.others(random, target, row_lists, group)
        del group
        target_pose = columns.others(random, source_pose, column_list, np.zeros_like(tile))
        order = np.argsort(random.permutation(self.block.tiles).astype(np.int32)[tile], kind="stable")
        del tile
        order = order[self._mixed(random)]
        identities, poses = np.asarray(self.identities), np.asarray(self.poses)
        triples = np.empty((self.cells, 4), np.int64)
        numbers = ((identities, source), (poses, source_pose), (identities, target), (poses, target_pose))
        for column, (named, each) in enumerate(numbers):
            triples[:, column] = named[each[order]]
        return triples

    def _cells(self, random: np.random.Generator) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Target identity and source pose of each cell, in any order."""
        cells, poses = random.permutation(self.cells), len(self.poses)
        target = (cells // poses).astype(np.int32)
        cells %= poses
        return target, cells.astype(np.int32)

    def _mixed(self, random: np.random.Generator) -> NDArray[np.int64]:
        """Places of triples that lie tile by tile, in the order of the batches: put off, and dealt to the lanes."""
        steps, width = self.steps_per_epoch, self.batch // self.lanes
        places, lane = np.arange(self.cells), steps * width
        dealt = places[: steps * self.batch].reshape(steps, self.lanes, width)
        for number in range(self.lanes):
            order = np.argsort(np.arange(lane) + random.uniform(0, self.reach, lane), kind="stable")
            dealt[:, number] = (number * lane + order).reshape(steps, width)
        return places
