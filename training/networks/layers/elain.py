"""Mesh refinement of 3D-CoreNet: elastic instance normalisation (ElaIN), its residual block, and the generator.

Shapes: ``b`` meshes, ``n`` vertices, ``c`` channels, ``k`` channels of the identity feature; arrays are channels-last.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm
from torch.nn.utils.parametrize import ParametrizationList

from training.networks.layers.modulation import full_precision, vertex_mean

VARIANCE_FLOOR = 1e-5
"""Added to the variance in ElaIN (released code)."""

SLOPE = 0.2
"""Slope of every LeakyReLU below zero (released code)."""


class Centred(NamedTuple):
    """Features of meshes, taken apart: ``values + mean`` are the features."""

    values: Tensor
    """``[b, n, c]``, with zero mean over the vertices."""
    mean: Tensor
    """``[b, 1, c]``."""
    deviation: Tensor
    """``[b, 1, c]``, standard deviation over the vertices."""


def centred(features: Tensor, constant: Tensor, masses: Tensor | None = None) -> Centred:
    """Take ``features + constant`` apart, ``[b, n, c]`` and ``[c]``; vertices count by their masses (`Identity`).

    The constant goes to the mean alone: added to features in 16 bits, it and its gradient would drown in rounding.
    """
    mean = vertex_mean(features, masses)
    return with_deviation(features - mean, mean + constant, masses)


def with_deviation(values: Tensor, mean: Tensor, masses: Tensor | None) -> Centred:
    """Add the deviation to centred values.

    The variance is the unbiased one, as in the released code (unlike an instance norm's). A single vertex has none in
    it; here its deviation is that of a constant channel, so that it is moved to a finite place.
    """
    squares, count = values.square(), values.shape[1]
    total = squares.sum(dim=1, keepdim=True) if masses is None else count * vertex_mean(squares, masses)
    variance = total / max(count - 1, 1)
    return Centred(values, mean, torch.sqrt(variance + VARIANCE_FLOOR))


class Identity(NamedTuple):
    """The target's features, which condition every ElaIN."""

    features: Tensor
    """``[b, n, k + 1]``, the last channel one."""
    mean: Tensor
    """``[b, 1, k + 1]``, over the vertices."""
    masses: Tensor | None
    """``[b, n, 1]``, how much each vertex counts in means and deviations, in sum one; None: equally."""

    @classmethod
    def of(cls, features: Tensor, masses: Tensor | None = None) -> Identity:
        """Make it from ``[b, n, k]`` features."""
        extended = nn.functional.pad(features, (0, 1), value=1.0)
        return cls(extended, vertex_mean(extended, masses), masses)


class ElaIN(nn.Module):
    """Normalise features and modulate them by the identity feature and by their own statistics.

    With ``s = side(identity)`` and ``w = blend([mean(s), mean(h)])``: ``gamma = scale(s) w + std(h) (1 - w)``,
    ``beta = shift(s) w + mean(h) (1 - w)`` and the output is ``(h - mean(h)) / std(h) (1 + gamma) + beta``.

    All but the identity is constant over a mesh, so factor and summand of ``h - mean(h)`` are two affine maps of the
    identity feature, composed once a mesh: a vertex costs ``2 k c`` products instead of ``k c + 2 c c``.
    """

    def __init__(self, channels: int, identity: int) -> None:
        super().__init__()
        self.side = nn.Linear(identity, channels)
        self.scale = nn.Linear(channels, channels)
        self.shift = nn.Linear(channels, channels)
        self.blend = nn.Linear(2 * channels, channels)

    def forward(self, features: Centred, identity: Identity) -> Tensor:
        """Return ``[b, n, c]``."""
        scale, shift = self._maps(features, identity)
        return torch.addcmul(identity.features @ shift, features.values, identity.features @ scale)

    def _maps(self, features: Centred, identity: Identity) -> tuple[Tensor, Tensor]:
        """Return the ``[b, k + 1, c]`` maps of the identity feature to factor and summand."""
        with full_precision(identity.features):
            side = torch.cat([self.side.weight.t(), self.side.bias.unsqueeze(0)])
            weight = self.blend(torch.cat([identity.mean @ side, features.mean], dim=2))
            own = 1 - weight
            scale = _composed(side, self.scale) * weight
            shift = _composed(side, self.shift) * weight
            scale = _with_constant(scale, 1 + features.deviation * own) / features.deviation
            return scale, _with_constant(shift, features.mean * own)


def _composed(first: Tensor, second: nn.Linear) -> Tensor:
    """Return ``second`` after the affine map ``first``, ``[k + 1, c]``, whose last row is its constant."""
    return _with_constant(first @ second.weight.t(), second.bias.unsqueeze(0))


def _with_constant(linear: Tensor, constant: Tensor) -> Tensor:
    """Add to the last row of ``[..., k + 1, c]`` the constant ``[..., 1, c]``."""
    return linear + nn.functional.pad(constant, (0, 0, linear.shape[-2] - 1, 0))


class ElaINBlock(nn.Module):
    """``shortcut(f(ElaIN(h))) + linear1(f(ElaIN(linear0(f(ElaIN(h))))))`` with ``f`` a LeakyReLU.

    The three linear maps are divided by their largest singular value (spectral norm), estimated by one power iteration
    a forward pass in training, or a step (`iterated_once`); in evaluation the estimate stays as it is. The released
    code's older function updates the two singular vectors in the other order, which is the same once they have
    settled. The shortcut is learned although the channels do not change, and has no bias (released code).
    """

    def __init__(self, channels: int, identity: int) -> None:
        super().__init__()
        self.norm0, self.norm1, self.norm_shortcut = (ElaIN(channels, identity) for _ in range(3))
        self.linear0 = spectral_norm(nn.Linear(channels, channels))
        self.linear1 = spectral_norm(nn.Linear(channels, channels))
        self.shortcut = spectral_norm(nn.Linear(channels, channels, bias=False))

    def forward(self, features: Centred, identity: Identity) -> tuple[Tensor, Tensor]:
        """Return what the shortcut and the last linear map act on, ``[b, n, c]`` each (see `followed_by`)."""
        skipped = nn.functional.leaky_relu_(self.norm_shortcut(features, identity), SLOPE)
        active = nn.functional.leaky_relu_(self.norm0(features, identity), SLOPE)
        with full_precision(active):  # the spectral norm's own products too, which run when the weight is read
            weight = cast(Tensor, self.linear0.weight)
        hidden = nn.functional.linear(active, weight)
        with full_precision(hidden):
            inner = centred(hidden.to(features.values.dtype), cast(Tensor, self.linear0.bias), identity.masses)
        return skipped, nn.functional.leaky_relu_(self.norm1(inner, identity), SLOPE)

    def followed_by(self, following: nn.Linear, skipped: Tensor, inner: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``following`` of the block's output as what varies, ``[b, n, o]``, and the sum of biases, ``[o]``.

        Nothing lies between the two, so the maps are merged.
        The spectral norm iterates whenever a weight is read: each is read once a forward pass.
        """
        with full_precision(skipped):
            # A parametrised weight is a property, which type checkers take for a module.
            weight = following.weight @ cast(Tensor, self.linear1.weight)
            weight_skipped = following.weight @ cast(Tensor, self.shortcut.weight)
            bias = following.weight @ cast(Tensor, self.linear1.bias) + following.bias
        return nn.functional.linear(inner, weight) + nn.functional.linear(skipped, weight_skipped), bias


@contextmanager
def iterated_once(network: nn.Module) -> Iterator[None]:
    """Iterate every spectral norm of a network once, then never while the block runs: for the parts of one step.

    By itself a spectral norm iterates in every forward pass, so that the weights would differ from part to part, and
    the step with the number of parts. With a single part the numbers are the same to the bit.
    """
    norms = [module for module in network.modules() if hasattr(module, "_power_method")]
    holders = [module for module in network.modules() if isinstance(module, ParametrizationList)]
    with torch.no_grad():
        for holder in holders:
            if any(norm in norms for norm in holder):
                holder()
    for norm in norms:
        norm.eval()
    try:
        yield
    finally:
        for norm in norms:
            norm.train()


class Generator(nn.Module):
    """Refine the warped mesh: a convolution over three neighbours in file order, then three blocks of ElaIN."""

    def __init__(self, widths: tuple[int, ...], identity: int) -> None:
        super().__init__()
        first, second, third = widths
        self.lift = nn.Linear(9, first)
        self.linear1 = nn.Linear(first, first)
        self.block1 = ElaINBlock(first, identity)
        self.linear2 = nn.Linear(first, second)
        self.block2 = ElaINBlock(second, identity)
        self.linear3 = nn.Linear(second, third)
        self.block3 = ElaINBlock(third, identity)
        self.out = nn.Linear(third, 3)

    def forward(self, warped: Tensor, identity: Identity) -> Tensor:
        """Return ``[b, n, 3]`` for warped points ``[b, n, 3]`` and the target's features."""
        with full_precision(warped):
            features = self.lifted(warped, identity.masses)
        for block, following in ((self.block1, self.linear2), (self.block2, self.linear3)):
            hidden, bias = block.followed_by(following, *block(features, identity))
            with full_precision(warped):
                features = centred(hidden.to(warped.dtype), bias, identity.masses)
        active = self.block3(features, identity)
        with full_precision(warped):
            skipped, inner = (part.to(warped.dtype) for part in active)
            moved, bias = self.block3.followed_by(self.out, skipped, inner)
            return 2 * torch.tanh(moved + bias)

    def lifted(self, warped: Tensor, masses: Tensor | None = None) -> Centred:
        """Return the first two layers' output: one linear map of nine numbers, so that centring those centres it."""
        weight = self.linear1.weight @ self.lift.weight
        bias = self.linear1.weight @ self.lift.bias + self.linear1.bias
        window = neighbour_window(warped)
        mean = vertex_mean(window, masses)
        return with_deviation((window - mean) @ weight.t(), nn.functional.linear(mean, weight, bias), masses)


def neighbour_window(vertices: Tensor) -> Tensor:
    """Return ``[b, n, 9]``, each vertex between its neighbours in order, zeros at the ends: a convolution's input.

    The order is x of the three vertices, y, z: that of a convolution's weight ``[c, 3, 3]``, flattened.
    """
    padded = nn.functional.pad(vertices, (0, 0, 1, 1))
    return padded.unfold(1, 3, 1).flatten(2)
