"""The pose encoder of FITE's point avatar: a U-Net over one view's position maps (Lin et al., ECCV 2022)."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, layer_norm, leaky_relu

SMALLEST_MAP = 16
_GROUPS = 4
_SLOPE = 0.2


class PoseUNet(nn.Module):
    """Position maps ``[b, 3, size, size]`` to features ``[b, channels, size, size]``.

    The map is halved down to 2 x 2, the channels doubling from ``width`` up to eight times as many. It comes up by
    transposed convolutions, of which the third serves for every level above it too, as in the released network, and
    over the last three levels by bilinear interpolation and 3 x 3 convolutions. At size 256 and width 16 it has the
    2,339,136 parameters of the released one that are in use; another 262,144 there are never called.

    Parameters
    ----------
    size
        Pixels across a map: a power of two from 16 on.
    width
        Channels after the first level.
    channels
        Channels of the features.
    normalisation
        ``group`` or ``batch`` (:func:`normalised`).

    Raises
    ------
    ValueError
        The size is no such power of two.
    """

    def __init__(self, *, size: int, width: int, channels: int, normalisation: str) -> None:
        super().__init__()
        if size < SMALLEST_MAP or size & (size - 1):
            raise ValueError(f"size must be a power of two of at least {SMALLEST_MAP}, got {size}")
        levels = size.bit_length() - 2
        widths = [width * min(2**level, 8) for level in range(levels)]
        self.down = nn.ModuleList(
            nn.Conv2d(before, after, 4, stride=2, padding=1, bias=False) for before, after in pairwise([3, *widths])
        )
        self.down_norms = nn.ModuleList(_norm(channels, normalisation) for channels in widths[1:-1])
        self._rises = levels - 3
        kinds = [(1 if first else 2) * 8 * width for first in (True, False, False)][: self._rises]
        self.up = nn.ModuleList(nn.ConvTranspose2d(before, 8 * width, 4, 2, 1, bias=False) for before in kinds)
        self.up_norms = nn.ModuleList(_norm(8 * width, normalisation) for _ in range(self._rises))
        coarse = 12 * width if self._rises else widths[-1]
        ends = [(coarse, 2 * width), (4 * width, width), (2 * width, channels)]
        self.rise = nn.ModuleList(nn.Conv2d(before, after, 3, padding=1) for before, after in ends)
        self.rise_norms = nn.ModuleList(_norm(after, normalisation) for _, after in ends[:-1])

    def forward(self, maps: Tensor) -> Tensor:
        """Return ``[b, channels, size, size]`` for ``[b, 3, size, size]``."""
        kept = self._down(maps)
        features = kept.pop()
        for level in range(self._rises):
            raised = self.up[min(level, len(self.up) - 1)](torch.relu(features))
            features = torch.cat([self.up_norms[level](raised), kept.pop()], dim=1)
        for convolution, norm in zip(self.rise, self.rise_norms, strict=False):
            features = torch.cat([norm(_raised(convolution, features)), kept.pop()], dim=1)
        return _raised(self.rise[-1], features)

    def _down(self, maps: Tensor) -> list[Tensor]:
        """The rectified features of every level, the finest first."""
        kept = [leaky_relu(self.down[0](maps), _SLOPE)]
        for convolution, norm in zip(self.down[1:-1], self.down_norms, strict=True):
            kept.append(leaky_relu(norm(convolution(kept[-1])), _SLOPE))
        return [*kept, leaky_relu(self.down[-1](kept[-1]), _SLOPE)]


def normalised(channels: int, normalisation: str) -> nn.Module:
    """Return what normalises ``[n, channels]``, with a scale and a shift for each channel.

    ``group``: over four groups of channels of each row (Wu and He, 2018), so that a row depends neither on the others
    nor on how a batch is split among ranks; ``batch``: over the rows, as released.

    Raises
    ------
    ValueError
        Another normalisation.
    """
    if normalisation == "group":
        return RowGroupNorm(math.gcd(channels, _GROUPS), channels)
    if normalisation == "batch":
        return nn.BatchNorm1d(channels)
    raise ValueError(f"normalisation must be 'group' or 'batch', got {normalisation!r}")


class RowGroupNorm(nn.GroupNorm):
    """:class:`torch.nn.GroupNorm` of rows ``[n, channels]``, by layer norms over the groups: less than half the time.

    PyTorch's kernel is made for pictures; that of a row has one pixel.
    """

    def forward(self, rows: Tensor) -> Tensor:
        """Return ``[n, channels]`` for as much."""
        groups = rows.view(len(rows), self.num_groups, self.num_channels // self.num_groups)
        return layer_norm(groups, groups.shape[2:], eps=self.eps).flatten(1) * self.weight + self.bias


def _norm(channels: int, normalisation: str) -> nn.Module:
    """The same over maps, without scale and shift."""
    if normalisation == "batch":
        return nn.BatchNorm2d(channels, affine=False)
    return nn.GroupNorm(math.gcd(channels, _GROUPS), channels, affine=False)


def _raised(convolution: nn.Module, features: Tensor) -> Tensor:
    twice = interpolate(torch.relu(features), scale_factor=2, mode="bilinear", align_corners=False)
    raised: Tensor = convolution(twice)
    return raised
