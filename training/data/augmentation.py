"""Random changes of a training batch: meshes turned, cut, thinned, noisy, and bodies of other proportions.

The paper trains without. Shuffling vertices changes nothing for DSFFNet and NPT, which are invariant to the source's
order and equivariant to the target's. The generator of 3D-CoreNet has a kernel of three along the list of the target's
vertices: it learns from the order that a body model happens to list them in, unless they are shuffled.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from datagen.common.seeding import Stream
from training.data.batch import Batch, Counts, counts_of
from training.data.proportions import of_other_proportions
from training.data.rig_table import RigTable
from training.data.triples import Triples
from training.networks.layers.rigid_parts import about_vertical, turned_about
from training.networks.layers.sampling import MOST_SAMPLED
from training.networks.parts import boxed
from training.objectives.losses import PackedEdges
from training.recipes.training import AugmentationRecipe, PartsRecipe, TrainingRecipe


class Augmentation:
    """The augmentation of a recipe, a function of (seed, step, place of the triple in the whole batch).

    So it is the same for any number of ranks and parts and from any cache. A CPU and a GPU draw different numbers.

    Parameters
    ----------
    recipe
        Of the training.
    rigs
        What a network that learns from rigs is told; None: nothing but vertices.
    """

    def __init__(self, recipe: TrainingRecipe, rigs: RigTable | None = None) -> None:
        self._recipe, self._seed, self._rigs = recipe.augmentation, recipe.seed, rigs
        self._network = recipe.network
        self._draws_edges = not isinstance(recipe.network, PartsRecipe)  # it has no edge loss

    def __call__(self, triples: Triples, batch: Batch, *, step: int, first: int) -> Batch:
        """The batch changed: as points, turned, cut, thinned; told of its rigs; then of other proportions, and noisy.

        Parameters
        ----------
        triples
            Those of the batch.
        step
            Steps done before this one.
        first
            Place of the batch's first triple in the whole batch (:meth:`training.data.triples.TripleOrder.places`).
        """
        recipe, device = self._recipe, batch.source.device
        if recipe == AugmentationRecipe(shuffle=recipe.shuffle):
            return self._told(triples, batch)
        random = [_generator(self._seed, step, first + row, device) for row in range(len(batch))]
        if recipe.points and self._rigs:
            batch = self._rigs.of_points(triples, batch, recipe.points, random)
        if recipe.turn or recipe.lean:
            batch = _turned(batch, np.radians(recipe.turn), np.radians(recipe.lean), random)
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

    def _told(self, triples: Triples, batch: Batch) -> Batch:
        return self._rigs.posed(triples, batch) if self._rigs else batch

    def _subset(self, triples: Triples, batch: Batch, size: int, random: Sequence[torch.Generator]) -> Batch:
        """So many vertices of each source and each target; more often than once where a mesh has fewer."""
        targets = batch.target_counts or (batch.target.shape[1],) * len(batch)
        of_source = zip(_counts(batch), random, self._areas(triples, batch, 0), strict=True)
        source = torch.stack([_drawn(count, size, own, areas) for count, own, areas in of_source])
        of_target = zip(targets, random, self._areas(triples, batch, 1), strict=True)
        drawn = [
            self._target(_edges_of(batch, row) if self._draws_edges else _NO_EDGES, count, size, own, areas)
            for row, (count, own, areas) in enumerate(of_target)
        ]
        target, pairs = torch.stack([rows for rows, _ in drawn]), [own for _, own in drawn]
        meshes = torch.cat([torch.full_like(own[:, 0], mesh) for mesh, own in enumerate(pairs)])
        packed = PackedEdges(torch.cat([own + size * mesh for mesh, own in enumerate(pairs)]), meshes)
        return replace(
            batch,
            source=_taken(batch.source, source),
            target=_taken(batch.target, target),
            truth=_taken(batch.truth, target),
            edges=packed,
            source_counts=None,
            target_counts=None,
            source_rows=source if batch.source_rows is None else batch.source_rows.gather(1, source),
            target_rows=target,
        )

    def _areas(self, triples: Triples, batch: Batch, side: int) -> list[Tensor | None]:
        """The area around each vertex [n] of the sources (0) or targets (1) of which some are drawn by it.

        These are meshes of more vertices than a network samples, of which it leaves out most in faces and hands, too.
        None: of meshes with fewer, of points, which lie evenly, and where no rigs are known.
        """
        identities, rows = triples[:, 2 * side], (batch.source_rows, batch.target_rows)[side]
        found = list[Tensor | None]()
        for row, identity in enumerate(identities.tolist()):
            areas = self._rigs.areas(identity) if self._rigs else None
            is_points = batch.points is not None and batch.points[side].drawn[row]
            if areas is None or len(areas) <= MOST_SAMPLED or is_points:
                found.append(None)
            else:
                found.append(areas if rows is None else areas[rows[row]])
        return found

    def _target(
        self, edges: Tensor, count: int, size: int, random: torch.Generator, areas: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Vertices [size] of a target, and edges [e, 2] by their places there: a quarter as many, with their ends.

        Of a target that has no more vertices than that all are taken, with all edges.
        """
        if not self._draws_edges:
            return _drawn(count, size, random, areas), edges[:0]
        if count <= size:
            rows = _drawn(count, size, random)
            return rows, torch.argsort(rows[:count])[edges]
        chosen = edges[torch.randint(len(edges), (size // 4,), generator=random, device=edges.device)]
        ends = torch.unique(chosen)
        others = torch.randperm(count, generator=random, device=edges.device)
        rows = torch.cat([ends, others[~torch.isin(others, ends)][: size - len(ends)]])
        return rows, torch.searchsorted(ends, chosen)


_NO_EDGES = torch.empty((0, 2), dtype=torch.int64)


def _counts(batch: Batch) -> Counts:
    return batch.source_counts or (batch.source.shape[1],) * len(batch.source)


def _taken(vertices: Tensor, rows: Tensor) -> Tensor:
    return vertices.gather(1, rows[..., None].expand(-1, -1, 3))


def _drawn(count: int, size: int, random: torch.Generator, areas: Tensor | None = None) -> Tensor:
    """So many numbers below ``count``, none twice where there are enough: by the areas [n] around them, or alike.

    Where there are not, all are taken, whatever the areas.
    """
    if areas is not None and count > size:
        return torch.multinomial(areas[:count].clamp_min(1e-12), size, generator=random)
    order = torch.randperm(count, generator=random, device=random.device)
    more = torch.randint(count, (max(0, size - count),), generator=random, device=random.device)
    return torch.cat([order[:size], more])


def _edges_of(batch: Batch, row: int) -> Tensor:
    """Edges [e, 2] of one of the targets, by its own vertices."""
    if isinstance(batch.edges, PackedEdges):
        return batch.edges.part(row, row + 1, rows=batch.target.shape[1]).pairs
    return batch.edges


def _some_of_the_source(batch: Batch, fraction: float, random: Sequence[torch.Generator]) -> Batch:
    """A random subset of each source, in its own order."""
    rows = []
    for mesh, count, own in zip(batch.source, _counts(batch), random, strict=True):
        kept = max(1, round(fraction * count))
        rows.append(torch.randperm(count, generator=own, device=mesh.device)[:kept].sort().values)
    return _of_rows(batch, rows)


def _of_rows(batch: Batch, rows: Sequence[Tensor]) -> Batch:
    """Each source's vertices of these numbers, padded; ``source_rows`` stay those of the mesh in the dataset."""
    counts = counts_of(np.array([len(own) for own in rows]))
    numbers = torch.nn.utils.rnn.pad_sequence(list(rows), batch_first=True)
    there = torch.arange(numbers.shape[1], device=numbers.device) < torch.tensor([len(own) for own in rows])[
        :, None
    ].to(numbers.device)
    source = _taken(batch.source, numbers) * there[..., None]
    before = batch.source_rows
    return replace(
        batch,
        source=source,
        source_counts=counts,
        source_rows=numbers if before is None else before.gather(1, numbers) * there,
    )


def _cut(batch: Batch, most: float, random: Sequence[torch.Generator]) -> Batch:
    """Each source without what lies about one of its vertices, boxed by what is left."""
    device = batch.source.device
    shares = (most * torch.stack([torch.rand((), generator=own, device=device) for own in random]) ** 3).tolist()
    rows = []
    for mesh, count, share, own in zip(batch.source, _counts(batch), shares, random, strict=True):
        middle = mesh[torch.randint(count, (1,), generator=own, device=device)]
        far = (mesh[:count] - middle).square().sum(dim=1).argsort(descending=True)
        rows.append(far[: max(1, round(count * (1 - share)))].sort().values)
    batch = _of_rows(batch, rows)
    return replace(batch, source=_boxed(batch.source, batch.source_counts))


def _without_some_surfaces(batch: Batch, random: Sequence[torch.Generator]) -> Batch:
    """A quarter of the sources, by chance, as points are: it is not told what is near along their surfaces."""
    assert batch.surfaces is not None
    source, target = batch.surfaces
    unknown = torch.stack([torch.rand((), generator=own, device=batch.source.device) < 0.25 for own in random])
    return replace(batch, surfaces=(source._replace(near=source.near | unknown[:, None, None]), target))


def _noisy(batch: Batch, most: float, random: Sequence[torch.Generator]) -> Batch:
    source = batch.source.clone()
    for mesh, count, own in zip(source, _counts(batch), random, strict=True):
        deviation = most * torch.rand((), generator=own, device=mesh.device).square()
        mesh[:count] += deviation * torch.randn((count, 3), generator=own, device=mesh.device)
    return replace(batch, source=source)


def _turned(batch: Batch, most: float, lean: float, random: Sequence[torch.Generator]) -> Batch:
    """Source and target each turned about the vertical, then tilted, the truth as the source; in their new boxes."""
    device = batch.source.device
    angles = torch.stack([torch.rand(2, generator=own, device=device) for own in random]) * 2 - 1
    turns = about_vertical(torch.cos(most * angles), torch.sin(most * angles))
    if lean:
        side, amount = torch.stack([torch.rand((2, 2), generator=own, device=device) for own in random]).unbind(2)
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
    out = torch.zeros_like(meshes)
    for row, count in enumerate(counts):
        out[row, :count] = _boxed(meshes[row : row + 1, :count], None)[0]
    return out


class Shuffle:
    """Another order of the target's vertices at each step, undone in what comes out.

    Meshes of one vertex count share an order, a function of (seed, step, count).
    """

    def __init__(self, batch: Batch, *, seed: int, step: int) -> None:
        rows = batch.target.shape[1]
        orders = {
            count: torch.cat([_order(seed, step, count), torch.arange(count, rows)])
            for count in set(batch.target_counts or (rows,))
        }
        counts = batch.target_counts or (rows,) * len(batch)
        self._index = torch.stack([orders[count] for count in counts]).to(batch.target.device)[..., None]

    def __call__(self, vertices: Tensor) -> Tensor:
        """Vertices [b, n, 3] in the new order."""
        return vertices.gather(1, self._index.expand(vertices.shape))

    def undone(self, vertices: Tensor) -> Tensor:
        """Vertices [b, n, 3] in their own order again."""
        return torch.zeros_like(vertices).scatter(1, self._index.expand(vertices.shape), vertices)


def _order(seed: int, step: int, count: int) -> Tensor:
    random = _generator(seed, step, _SHUFFLED - count, torch.device("cpu"))
    return torch.randperm(count, generator=random)


_SHUFFLED = 2**63  # less a vertex count: no place of a triple in a batch


def _generator(seed: int, step: int, place: int, device: torch.device) -> torch.Generator:
    state = np.random.SeedSequence((seed, int(Stream.AUGMENTATION), step, place)).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(state[0]))
