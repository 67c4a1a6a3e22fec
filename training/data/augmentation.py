"""Random changes of a training batch: another subset of the source's vertices each time, and noise on them.

The paper trains without. Shuffling vertices changes nothing for DSFFNet and NPT, which are invariant to the source's
order and equivariant to the target's. The generator of 3D-CoreNet has a kernel of three along the list of the target's
vertices: it learns from the order that a body model happens to list them in, unless they are shuffled.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from datagen.common.seeding import Stream
from training.data.batch import Batch, Counts, counts_of
from training.recipes.training import TrainingRecipe


class Augmentation:
    """The augmentation of a recipe, a function of (seed, step, place of the triple in the whole batch).

    So it is the same for any number of ranks and parts and from any cache. A CPU and a GPU draw different numbers.
    """

    def __init__(self, recipe: TrainingRecipe) -> None:
        self._vertices, self._noise = recipe.augmentation.vertices, recipe.augmentation.source_noise
        self._seed = recipe.seed

    def __call__(self, batch: Batch, *, step: int, first: int) -> Batch:
        """The batch with its sources changed.

        Parameters
        ----------
        step
            Steps done before this one.
        first
            Place of the batch's first triple in the whole batch (:meth:`training.data.triples.TripleOrder.places`).
        """
        if self._vertices == 1 and self._noise == 0:
            return batch
        counts = batch.source_counts or (batch.source.shape[1],) * len(batch.source)
        sources = [
            self._changed(mesh[:count], step=step, place=first + row)
            for row, (mesh, count) in enumerate(zip(batch.source, counts, strict=True))
        ]
        source, kept = _padded(sources)
        return replace(batch, source=source, source_counts=kept)

    def _changed(self, mesh: Tensor, *, step: int, place: int) -> Tensor:
        """One source [n, 3]: a random subset in its own order, and noise."""
        random = _generator(self._seed, step, place, mesh.device)
        if self._vertices < 1:
            kept = max(1, round(self._vertices * len(mesh)))
            subset = torch.randperm(len(mesh), generator=random, device=mesh.device)[:kept]
            mesh = mesh[subset.sort().values]
        if self._noise:
            mesh = mesh + self._noise * torch.randn(mesh.shape, generator=random, device=mesh.device)
        return mesh


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


def _padded(meshes: list[Tensor]) -> tuple[Tensor, Counts | None]:
    counts = counts_of(np.array([len(mesh) for mesh in meshes]))
    return torch.nn.utils.rnn.pad_sequence(meshes, batch_first=True), counts
