"""Where the meshes of a bank are, and those that are all there in one tensor."""

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.layout import Layout
from training.sending import sent


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
