"""3D-CoreNet: pose transfer by correspondence learning and mesh refinement (Song et al., NeurIPS 2021)."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from typing import Literal, cast

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized

from training.networks.layers.elain import SLOPE, Generator, Identity, iterated_once
from training.networks.layers.input_checks import check_norm_weights, check_pair, check_widths
from training.networks.layers.modulation import VARIANCE_FLOOR, full_precision, vertex_mean, with_zero_gradients
from training.networks.layers.optimal_transport import warp
from training.networks.layers.sampling import masses_by

INITIAL_GAIN = 0.02
"""Gain of the initial Xavier normal weights (released code)."""

RESIDUAL_BLOCKS = 4
"""Residual blocks after the feature layers (released code)."""


class CoreNet3D(nn.Module):
    """Transfer the pose of `source` to `target`, with correspondence learning and refinement by ElaIN.

    Per-vertex features of both meshes (`VertexFeatures`, shared) give cosine similarities, these an optimal transport
    (`correspondence`), this a warped mesh: the source's vertices in the target's order. The `Generator` refines it,
    conditioned on the target's features. Output ``2 tanh(...)``. The default widths give 24,461,447 parameters.

    The order of the source's vertices has no effect. That of the target's has: the generator's first convolution is
    three vertices wide, so a vertex sees its neighbours *in the file's order*. The released code shuffles the vertices
    of every training and test mesh, so that its neighbours are chance ones; train and evaluate alike.

    A NaN or an infinity in a mesh makes all output vertices of its pair NaN, and of no other pair (see `shapes`).

    Parameters
    ----------
    feature_widths
        Channels after each feature layer; the last is also that of the residual blocks and of the identity feature.
    generator_widths
        Channels of the generator's three blocks.
    centre_features
        True subtracts from a vertex's feature its mean over the channels before it is scaled to unit length. Some
        accounts of the method have this; the released code, and so the weights trained with it, do not.
    norm_weights
        How much vertices count in instance norms, in ElaIN's means and deviations and in the optimal transport:
        ``"uniform"``, all the same, as published; ``"area"``, by the area around them, so that it matters less how
        densely vertices lie.

    Notes
    -----
    =======================================  ======================================================================
    parameter                                initial value
    =======================================  ======================================================================
    weight, i inputs and o outputs           normal, deviation 0.02 sqrt(2 / (i + o)); i = 9, o = 3c for the lift
    weight under a spectral norm             uniform in +-1/sqrt(i): released code means the above, but sets a copy
    bias                                     0
    slope of a residual block's PReLU        0.25
    singular vectors of the spectral norm    after 15 power iterations (PyTorch); random in the released code
    =======================================  ======================================================================

    Trained with Adam, betas (0, 0.9), eps 1e-3, rate 1e-4 for 100 epochs, then falling to zero over another 100, with
    1000 times the mean squared coordinate error plus 0.5 times the edge loss of NPT (released code).

    What is not computed, and why the result is the same, stands in `correspondence` and `elain`; besides, the
    generator's first two layers are one map, a block's last is merged with the layer after it, and a bias before an
    instance norm cancels (its gradient is exactly zero).

    Under autocast only the generator's wide products use the lower precision: the temperature of the transport would
    magnify an error of a cosine by 33.

    Memory: the matrix K between n and m vertices is held once for the pair at work if it has at most 8,192^2 elements
    (256 MiB), else not at all; at 28,920 vertices each, where it would take 3.1 GiB, its blocks are computed anew in
    every pass, forward and backward, and inference adds 1.2 GiB in all (42 s on one core). Compiled and exported
    forms hold it twice: 6.2 GiB a pair there, and a memory error of PyTorch's where there is less.

    Examples
    --------
    >>> network = CoreNet3D(feature_widths=(8, 16, 32), generator_widths=(32, 16, 8))
    >>> network(source=torch.rand(2, 50, 3), target=torch.rand(2, 40, 3)).shape
    torch.Size([2, 40, 3])
    """

    def __init__(
        self,
        *,
        feature_widths: tuple[int, int, int] = (64, 128, 256),
        generator_widths: tuple[int, int, int] = (1024, 512, 256),
        centre_features: bool = False,
        norm_weights: Literal["uniform", "area"] = "uniform",
    ) -> None:
        super().__init__()
        check_widths(feature_widths=feature_widths, generator_widths=generator_widths)
        check_norm_weights(norm_weights)
        self.norm_weights = norm_weights
        width = feature_widths[-1]
        self.features = VertexFeatures(tuple(feature_widths), centre_features)
        self.theta, self.phi = nn.Linear(width, width), nn.Linear(width, width)
        self.generator = Generator(tuple(generator_widths), width)
        _initialise(self)

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        """Return the target ``[b, n_target, 3]`` in the pose of the source ``[b, n_source, 3]``.

        Both are in normalised coordinates (box centred, half its longest edge = 1) and in the dtype of the parameters.

        Raises
        ------
        ValueError
            If shapes or dtypes do not fit.
        """
        identity, theta, phi, masses = self._described(source, target)
        with full_precision(source):
            warped = warp(theta, phi, source, identity.masses, masses)
        return with_zero_gradients(self.generator(warped, identity), self.features.dead_biases())

    def accumulation(self) -> AbstractContextManager[None]:
        """Iterate the spectral norms once, then never while the block runs: for the parts of one training step."""
        return iterated_once(self)

    def _described(self, source: Tensor, target: Tensor) -> tuple[Identity, Tensor, Tensor, Tensor | None]:
        """Return the target's features, both meshes' features of unit length, and the masses of the source."""
        check_pair(source, target, self.theta.weight.dtype)
        with full_precision(source):
            targets, sources = (masses_by(self.norm_weights, mesh) for mesh in (target, source))
            identity = self.features(target, targets)
            theta, phi = self.theta(identity), self.phi(self.features(source, sources))
            return Identity.of(identity, targets), unit_length(theta), unit_length(phi), sources


class VertexFeatures(nn.Module):
    """Features of each vertex in its mesh: three layers, then residual blocks."""

    def __init__(self, widths: tuple[int, ...], centre: bool) -> None:
        super().__init__()
        self.centre = centre
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in zip((3, *widths), widths, strict=False))
        self.blocks = nn.ModuleList(ResidualBlock(widths[-1]) for _ in range(RESIDUAL_BLOCKS))

    def dead_biases(self) -> list[Tensor]:
        """Return the biases that the norm after their layer cancels."""
        inner = [layer for block in self.blocks for layer in (block.linear1, block.linear2)]
        return [cast(nn.Linear, layer).bias for layer in (*self.layers, *inner)]

    def forward(self, vertices: Tensor, masses: Tensor | None) -> Tensor:
        """Return ``[b, n, widths[-1]]`` for ``[b, n, 3]`` of masses ``[b, n, 1]``."""
        first, *others = (cast(nn.Linear, layer) for layer in self.layers)
        hidden = _normed_linear(first, vertices, masses)
        for layer in others:
            hidden = _normed_linear(layer, nn.functional.leaky_relu(hidden, SLOPE), masses)
        hidden = unit_length(hidden - hidden.mean(dim=2, keepdim=True) if self.centre else hidden)
        for block in self.blocks:
            hidden = block(hidden, masses)
        return hidden


class ResidualBlock(nn.Module):
    """Linear layer, instance norm, PReLU, linear layer, instance norm; sum with the input; the same PReLU."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear1, self.linear2 = nn.Linear(width, width), nn.Linear(width, width)
        self.activation = nn.PReLU()

    def forward(self, features: Tensor, masses: Tensor | None) -> Tensor:
        """Return ``[b, n, c]`` for ``[b, n, c]``."""
        inner = self.activation(_normed_linear(self.linear1, features, masses))
        return cast(Tensor, self.activation(features + _normed_linear(self.linear2, inner, masses)))


def unit_length(features: Tensor) -> Tensor:
    """Scale features ``[b, n, c]`` to unit length over the channels; zeros stay zeros."""
    return features / (torch.linalg.vector_norm(features, dim=2, keepdim=True) + sys.float_info.epsilon)


def _normed_linear(layer: nn.Linear, features: Tensor, masses: Tensor | None) -> Tensor:
    """Return the instance norm (biased variance) of the layer's output, which its bias does not change."""
    hidden = nn.functional.linear(features, layer.weight)
    hidden = hidden - vertex_mean(hidden, masses)
    return hidden * torch.rsqrt(vertex_mean(hidden.square(), masses) + VARIANCE_FLOOR)


def _initialise(network: CoreNet3D) -> None:
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
            if not is_parametrized(layer, "weight"):
                nn.init.xavier_normal_(layer.weight, INITIAL_GAIN)
    lift = network.generator.lift
    fans = 9 + 3 * lift.out_features  # as PyTorch counts those of a convolution: every place of the kernel has outputs
    nn.init.normal_(lift.weight, 0.0, INITIAL_GAIN * (2 / fans) ** 0.5)
