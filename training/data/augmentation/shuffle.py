"""Another order of the targets' vertices at each step.

It changes nothing for DSFFNet and NPT, which are invariant to the source's order and equivariant to the target's. The
generator of 3D-CoreNet has a kernel of three along the list of the target's vertices: it learns from the order that a
body model happens to list them in, unless they are shuffled.
"""

import numpy as np
import torch
from torch import Tensor

from datagen.common.seeding import Stream
from training.data.batch import Batch


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
    state = np.random.SeedSequence((seed, int(Stream.AUGMENTATION), step, _SHUFFLED - count)).generate_state(
        1, np.uint64
    )
    return torch.randperm(count, generator=torch.Generator().manual_seed(int(state[0])))


_SHUFFLED = 2**63  # less a vertex count: no place of a triple in a batch
