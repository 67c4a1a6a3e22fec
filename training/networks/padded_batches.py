"""Batches whose meshes have different numbers of vertices, for any network: padded outside, exact inside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from training.networks.layers.surface import Surface

Counts = Sequence[int]
"""Vertices of each mesh of a batch; rows after them are padding and may hold anything."""


class MixedCounts(nn.Module):
    """Call a network on a padded batch, so that every mesh gets what it would get alone.

    Meshes of equal counts go through the network together, those of different counts one group after another: an
    instance norm over padded rows would need a mask in every sum, and the wide products of a thousand rows and more are
    as fast in groups as they are together.

    Parameters
    ----------
    network
        Called as ``network(source=[b, n_source, 3], target=[b, n_target, 3])``.

    Examples
    --------
    >>> from training.networks.dsffnet import DSFFNet
    >>> network = MixedCounts(DSFFNet(encoder_widths=(8, 8, 8), decoder_widths=(8, 8, 8)))
    >>> padded = torch.rand(2, 50, 3)
    >>> network(source=padded, target=padded, source_counts=[50, 40], target_counts=[30, 50]).shape
    torch.Size([2, 50, 3])
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(
        self,
        *,
        source: Tensor,
        target: Tensor,
        source_counts: Counts | None = None,
        target_counts: Counts | None = None,
        **surfaces: Surface,
    ) -> Tensor:
        """Return ``[b, n_target, 3]``; rows after a mesh's count are zero.

        Parameters
        ----------
        source, target
            ``[b, n_source, 3]`` and ``[b, n_target, 3]``, padded.
        source_counts, target_counts
            Vertices of each mesh; None: all rows.
        **surfaces
            ``source_surface`` and ``target_surface`` for a network that takes them.

        Raises
        ------
        ValueError
            If counts do not fit the shapes, or there is no mesh.
        """
        _check_batch(source, target)
        counts = list(
            zip(_checked("source", source, source_counts), _checked("target", target, target_counts), strict=True)
        )
        if len(set(counts)) == 1:
            return self._of_counts(slice(None), *counts[0], source, target, surfaces)
        groups: dict[tuple[int, int], list[int]] = {}
        for mesh, pair in enumerate(counts):
            groups.setdefault(pair, []).append(mesh)
        parts = [self._of_counts(meshes, *pair, source, target, surfaces) for pair, meshes in groups.items()]
        order = torch.tensor([mesh for meshes in groups.values() for mesh in meshes], device=target.device)
        return torch.cat(parts)[torch.argsort(order)]

    def _of_counts(
        self,
        meshes: list[int] | slice,
        n_source: int,
        n_target: int,
        source: Tensor,
        target: Tensor,
        surfaces: dict[str, Surface],
    ) -> Tensor:
        counts = {"source_surface": n_source, "target_surface": n_target}
        told = {name: surface.of(meshes, counts[name]) for name, surface in surfaces.items()}
        moved = self.network(source=source[meshes, :n_source], target=target[meshes, :n_target], **told)
        return _padded(cast(Tensor, moved), target.shape[1])


def _check_batch(source: Tensor, target: Tensor) -> None:
    shapes = list(source.shape), list(target.shape)
    if source.ndim != 3 or target.ndim != 3 or source.shape[0] != target.shape[0] or source.shape[0] < 1:
        raise ValueError(
            f"source and target must be equally many meshes, [batch, vertex, 3], and at least one, got shapes "
            f"{shapes[0]} and {shapes[1]}"
        )


def _checked(name: str, meshes: Tensor, counts: Counts | None) -> Counts:
    if counts is None:
        return [meshes.shape[1]] * meshes.shape[0]
    if len(counts) != meshes.shape[0] or not all(1 <= count <= meshes.shape[1] for count in counts):
        raise ValueError(
            f"{name}_counts must be {meshes.shape[0]} numbers from 1 to {meshes.shape[1]}, as {name} is of shape "
            f"{list(meshes.shape)}, got {list(counts)}"
        )
    return counts


def _padded(meshes: Tensor, rows: int) -> Tensor:
    return nn.functional.pad(meshes, (0, 0, 0, rows - meshes.shape[1])) if meshes.shape[1] < rows else meshes
