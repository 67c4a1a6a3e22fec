"""Random changes of a training batch: meshes turned, cut, thinned, noisy, and bodies of other proportions.

The paper trains without.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from training.data.augmentation.proportions import of_other_proportions
from training.data.batch import Batch, Counts, counts_of
from training.data.rigs.posed_bodies import PosedBodies
from training.data.rigs.rig_table import RigTable
from training.data.row_random import Purpose, RowRandom
from training.data.triples import Triples
from training.networks.execution import sent
from training.networks.layers.rigid_parts import about_vertical, turned_about
from training.networks.parts import boxed
from training.objectives.losses import PackedEdges
from training.recipes.networks import PartsRecipe
from training.recipes.training import AugmentationRecipe, TrainingRecipe


class Augmentation:
    """The augmentation of a recipe, a function of (seed, step, place of the triple in the whole batch).

    So it is the same for any number of ranks and parts, from any cache and, but for rounding, on any device.

    Parameters
    ----------
    recipe
        Of the training.
    rigs
        What a network that learns from rigs is told; None: nothing but vertices.
    bodies
        By which poses are recombined; None: none are.
    """

    def __init__(self, recipe: TrainingRecipe, rigs: RigTable | None = None, bodies: PosedBodies | None = None) -> None:
        self._recipe, self._seed, self._rigs, self._bodies = recipe.augmentation, recipe.seed, rigs, bodies
        self._network = recipe.network
        self._draws_edges = not isinstance(recipe.network, PartsRecipe)  # it has no edge loss

    def __call__(self, triples: Triples, batch: Batch, *, step: int, first: int) -> Batch:
        """The batch changed: posed anew, as points, turned, cut, thinned; told of its rigs; then resized, and noisy.

        Parameters
        ----------
        triples
            Those of the batch.
        step
            Steps done before this one.
        first
            Place of the batch's first triple in the whole batch (:meth:`training.data.triples.TripleOrder.places`).
        """
        recipe = self._recipe
        if recipe == AugmentationRecipe(shuffle=recipe.shuffle):
            return self._told(triples, batch)
        random = RowRandom.of_batch(self._seed, step, first=first, rows=len(batch), device=batch.source.device)
        batch = self._other_bodies(triples, batch, random)
        if recipe.source_holes:
            batch = _cut(batch, recipe.source_holes, random)
        if recipe.vertices < 1:
            batch = _some_of_the_source(batch, recipe.vertices, random)
        if recipe.subset:
            batch = self._subset(triples, batch, recipe.subset, random)
        batch = self._told(triples, batch)
        if batch.surfaces:
            batch = _without_some_surfaces(batch, random)
        if recipe.proportions and isinstance(self._network, PartsRecipe):
            batch = of_other_proportions(batch, recipe.proportions, self._network.joints, random)
        if recipe.source_noise:
            batch = _noisy(batch, recipe.source_noise, random)
        return batch

    def _other_bodies(self, triples: Triples, batch: Batch, random: RowRandom) -> Batch:
        """The batch in other poses, as points, turned."""
        recipe = self._recipe
        if recipe.recombined and self._bodies:
            batch = self._bodies.recombined(triples, batch, recipe.recombined, random)
        if recipe.points and self._rigs:
            batch = self._rigs.of_points(triples, batch, recipe.points, random)
        if recipe.turn or recipe.lean:
            batch = _turned(batch, np.radians(recipe.turn), np.radians(recipe.lean), random)
        return batch

    def _told(self, triples: Triples, batch: Batch) -> Batch:
        return self._rigs.posed(triples, batch) if self._rigs else batch

    def _subset(self, triples: Triples, batch: Batch, size: int, random: RowRandom) -> Batch:
        """So many vertices of each source and each target; more often than once where a mesh has fewer.

        With them go edges of each target, a quarter of ``size``, some perhaps twice, and their ends are taken in any
        case; of a target whose vertices are all taken, too.
        """
        of_source, of_target = self._rigs.areas(triples, batch) if self._rigs else (None, None)
        counts = _counts(batch.source, batch.source_counts)
        source = _drawn(random, _OF_SOURCES, counts, batch.source.shape[1], size, areas=of_source)
        counts, rows = _counts(batch.target, batch.target_counts), batch.target.shape[1]
        ends = _edges_drawn(batch, size // 4 if self._draws_edges else 0, random)
        target = _drawn(random, _OF_TARGETS, counts, rows, size, areas=of_target, always=ends.flatten(1))
        return replace(
            batch,
            source=_taken(batch.source, source),
            target=_taken(batch.target, target),
            truth=_taken(batch.truth, target),
            edges=_among(target, counts, ends, rows),
            source_counts=None,
            target_counts=None,
            source_rows=source if batch.source_rows is None else batch.source_rows.gather(1, source),
            target_rows=target,
        )


_OF_SOURCES = Purpose.SOURCE_SUBSET, Purpose.SOURCE_AGAIN
_OF_TARGETS = Purpose.TARGET_SUBSET, Purpose.TARGET_AGAIN
_NUMBERS = 24  # bits of the number of a vertex, below the 32 of a key
_BEFORE = _NUMBERS + 32


def _counts(meshes: Tensor, counts: Counts | None) -> Tensor:
    """Vertices [b, 1] of each mesh, on its device."""
    return sent(torch.tensor(counts or (meshes.shape[1],) * len(meshes))[:, None], meshes.device)


def _inside(counts: Tensor, rows: int) -> Tensor:
    """Which of so many rows [b, rows] are those of a mesh, and not after its count [b, 1]."""
    return torch.arange(rows, device=counts.device) < counts


def _taken(vertices: Tensor, rows: Tensor) -> Tensor:
    return vertices.gather(1, rows[..., None].expand(-1, -1, 3))


def _drawn(
    random: RowRandom,
    purposes: tuple[Purpose, Purpose],
    counts: Tensor,
    rows: int,
    size: int,
    *,
    areas: Tensor | None,
    always: Tensor | None = None,
) -> Tensor:
    """Numbers [b, size] of vertices, none twice where a mesh has enough: by the areas [b, rows] around them, or alike.

    Where it has fewer than ``size``, all are taken, whatever the areas, and some again. ``always`` [b, m] are taken in
    any case.
    """
    keys = random.uniform(purposes[0], rows)
    if areas is not None:
        keys = -(1 - keys).log() / areas.clamp_min(1e-12)  # the first to come, where an area says how often they come
    # no two alike, lest it were the device or the padding that decides: the bits of a float that is not negative order
    # as it does
    order = (keys.view(torch.int32).long() << _NUMBERS) + torch.arange(rows, device=keys.device)
    if always is not None and always.shape[1]:
        order = order - (torch.zeros_like(order).scatter(1, always, 1) << _BEFORE)
    order = order.masked_fill(~_inside(counts, rows), 1 << _BEFORE)
    first = order.topk(min(rows, size), largest=False).indices
    again = random.below(purposes[1], counts[:, 0], size)
    return torch.where(_inside(counts, size), pad(first, (0, max(0, size - rows))), again)


def _edges_drawn(batch: Batch, count: int, random: RowRandom) -> Tensor:
    """So many edges [b, e, 2] of each target, by its own vertices; one may be drawn twice."""
    edges, rows = batch.edges, batch.target.shape[1]
    if not isinstance(edges, PackedEdges):
        return edges[random.below(Purpose.EDGES, len(edges), count)]
    meshes = torch.arange(len(batch), device=edges.meshes.device)
    first, end = (torch.searchsorted(edges.meshes, meshes, right=right) for right in (False, True))
    numbers = first[:, None] + random.below(Purpose.EDGES, end - first, count)
    return edges.pairs[numbers] - rows * meshes[:, None, None]


def _among(target: Tensor, counts: Tensor, ends: Tensor, rows: int) -> PackedEdges:
    """Edges [b, e, 2] by their places among the vertices [b, size] that were taken of targets of up to ``rows``."""
    size, meshes = target.shape[1], torch.arange(len(target), device=target.device)[:, None]
    of_its_own = torch.where(_inside(counts, size), target, rows)  # what is taken again is at its first place
    places = torch.arange(size, device=target.device).expand_as(target)
    place = target.new_zeros((len(target), rows + 1)).scatter(1, of_its_own, places)
    pairs = place.gather(1, ends.flatten(1)) + size * meshes
    return PackedEdges(pairs.view(-1, 2), meshes.expand(-1, ends.shape[1]).flatten())


def _some_of_the_source(batch: Batch, fraction: float, random: RowRandom) -> Batch:
    """A random subset of each source, in its own order."""
    counts = batch.source_counts or (batch.source.shape[1],) * len(batch)
    keys = random.uniform(Purpose.FEWER, batch.source.shape[1])
    return _of_highest(batch, keys, [max(1, round(fraction * count)) for count in counts])


def _cut(batch: Batch, most: float, random: RowRandom) -> Batch:
    """Each source without what lies about one of its vertices, boxed by what is left."""
    counts = batch.source_counts or (batch.source.shape[1],) * len(batch)
    shares = (most * random.on_host().uniform(Purpose.HOLE) ** 3).tolist()
    kept = [max(1, round(count * (1 - share))) for count, share in zip(counts, shares, strict=True)]
    middle = random.below(Purpose.HOLE_MIDDLE, _counts(batch.source, batch.source_counts)[:, 0], 1)
    away = (batch.source - _taken(batch.source, middle)).square().sum(dim=2)
    batch = _of_highest(batch, away, kept)
    return replace(batch, source=_boxed(batch.source, batch.source_counts))


def _of_highest(batch: Batch, keys: Tensor, kept: Sequence[int]) -> Batch:
    """So many vertices of each source, of the highest keys [b, n], in their own order, padded.

    ``source_rows`` stay those of the mesh in the dataset.
    """
    count, before = keys.shape[1], batch.source_rows
    there = _inside(_counts(batch.source, batch.source_counts), count)
    numbers, of_kept = torch.arange(count, device=keys.device), _counts(batch.source, tuple(kept))
    order = torch.where(there, keys, -1).argsort(dim=1, descending=True, stable=True)
    is_kept = torch.zeros_like(there).scatter(1, order, _inside(of_kept, count))
    place = torch.where(is_kept, is_kept.cumsum(1) - 1, max(kept))  # the others' is cut off
    rows = order.new_zeros((len(batch), max(kept) + 1)).scatter(1, place, numbers.expand_as(place))[:, :-1]
    inside = _inside(of_kept, max(kept))
    return replace(
        batch,
        source=_taken(batch.source, rows) * inside[..., None],
        source_counts=counts_of(np.array(kept)),
        source_rows=rows if before is None else before.gather(1, rows) * inside,
    )


def _without_some_surfaces(batch: Batch, random: RowRandom) -> Batch:
    """A quarter of the sources, by chance, as points are: it is not told what is near along their surfaces."""
    assert batch.surfaces is not None
    source, target = batch.surfaces
    unknown = random.uniform(Purpose.UNTOLD) < 0.25
    return replace(batch, surfaces=(source._replace(near=source.near | unknown[:, None, None]), target))


def _noisy(batch: Batch, most: float, random: RowRandom) -> Batch:
    deviation = most * random.uniform(Purpose.DEVIATION).square()
    noise = deviation[:, None, None] * random.normal(Purpose.NOISE, *batch.source.shape[1:])
    if batch.source_counts:
        noise = noise * _inside(_counts(batch.source, batch.source_counts), batch.source.shape[1])[..., None]
    return replace(batch, source=batch.source + noise)


def _turned(batch: Batch, most: float, lean: float, random: RowRandom) -> Batch:
    """Source and target each turned about the vertical, then tilted, the truth as the source; in their new boxes."""
    angles = most * (random.uniform(Purpose.TURN, 2) * 2 - 1)
    turns = about_vertical(torch.cos(angles), torch.sin(angles))
    if lean:
        side, amount = random.uniform(Purpose.LEAN, 2, 2).unbind(2)
        towards = torch.stack([(2 * np.pi * side).cos(), torch.zeros_like(side), (2 * np.pi * side).sin()], dim=2)
        tilts = turned_about((lean * amount.square()[..., None] * towards).flatten(0, 1))
        turns = tilts.view_as(turns) @ turns
    turns = turns.to(batch.source.dtype)
    source, target = turns.unbind(1)
    return replace(
        batch,
        source=_boxed(batch.source @ source.mT, batch.source_counts),
        target=_boxed(batch.target @ target.mT, batch.target_counts),
        truth=_boxed(batch.truth @ source.mT, batch.target_counts),
    )


def _boxed(meshes: Tensor, counts: Counts | None) -> Tensor:
    """Meshes [b, n, 3] in their own boxes; rows after a mesh' count stay zero."""
    if counts is None:
        return boxed(meshes)
    inside = _inside(_counts(meshes, counts), meshes.shape[1])[..., None]
    return boxed(torch.where(inside, meshes, meshes[:, :1])) * inside
