"""DSFFNet, the dual-side feature fusion network for 3-D pose transfer, with its ablations."""

from __future__ import annotations

from typing import Literal, cast

import torch
from torch import Tensor, nn

from training.networks.layers.input_checks import check_norm_weights, check_vertices, check_widths
from training.networks.layers.modulation import (
    FFAdaIN,
    centred_for_autocast,
    full_precision,
    homogeneous,
    modulated_relu,
    pose_probe,
    rounded_modulated_relu,
    with_zero_gradients,
)
from training.networks.layers.pose_encoder import PoseEncoder, centred_features, normalised_linear
from training.networks.layers.sampling import masses_by


class DSFFNet(nn.Module):
    """Transfer the pose of `source` to `target` (DSFFNet, section 3), without the redundant work of its equations.

    A pose encoder (1x1 convolution, instance norm and ReLU three times, then the maximum over vertices) gives one
    vector ``z`` a mesh; a decoder of 1x1 convolutions and three residual blocks moves the target's vertices, modulated
    by `FFAdaIN`. The output is ``2 tanh(...)``, in the target's vertex order; it is equivariant to a permutation of the
    target's vertices and invariant to one of the source's. The default widths give 9,371,023 parameters.

    Parameters
    ----------
    encoder_widths
        Channels after each layer of the pose encoder; the last is the length of ``z``.
    decoder_widths
        Channels of the three residual blocks.
    feature_fusion
        False is the ablation "w/o FFAdaIN": the first FFAdaIN of every block keeps its identity branch only (SPAdaIN).
    target_side
        False is the ablation "w/o side target": every FFAdaIN keeps its mixed branch only.
    initial_mixing
        Initial alpha and beta of every FFAdaIN: 0 is the paper's.
    norm_weights
        How much vertices count in instance norms: ``"uniform"``, all the same, as in the paper; ``"area"``, by the area
        around them, so that it matters less how densely vertices lie.

    Notes
    -----
    =====================================  ==============================================
    parameter                              initial value
    =====================================  ==============================================
    weight, bias of a layer with i inputs  uniform in +-1/sqrt(i) (PyTorch's Conv1d, used by the released code)
    alpha, beta of FFAdaIN                 `initial_mixing`; at 0 the target's side alone modulates at first
    =====================================  ==============================================

    What is not computed, and why the result is the same: the covariance of a layer's inputs gives the variance of its
    outputs; the encoder's last layer is needed only where it is largest; the decoder's first layer and first FFAdaIN
    together are a quadratic function of the coordinates; the second convolution of a block that narrows is merged with
    the next one; a bias before an instance norm cancels (its gradient is exactly zero).

    Under autocast only the decoder's wide products use the lower precision, and the encoder's search for the largest.

    A NaN or an infinity in a mesh makes all output vertices of its pair NaN, and of no other pair (see `shapes`).

    Examples
    --------
    >>> network = DSFFNet(encoder_widths=(8, 16, 32), decoder_widths=(16, 32, 16))
    >>> network(source=torch.rand(2, 50, 3), target=torch.rand(2, 40, 3)).shape
    torch.Size([2, 40, 3])
    """

    def __init__(
        self,
        *,
        encoder_widths: tuple[int, int, int] = (64, 128, 1024),
        decoder_widths: tuple[int, int, int] = (256, 1024, 256),
        feature_fusion: bool = True,
        target_side: bool = True,
        initial_mixing: float = 0.0,
        norm_weights: Literal["uniform", "area"] = "uniform",
    ) -> None:
        super().__init__()
        check_widths(encoder_widths=encoder_widths, decoder_widths=decoder_widths)
        _check_sides(feature_fusion, target_side)
        check_norm_weights(norm_weights)
        self.norm_weights = norm_weights
        self.encoder = PoseEncoder(tuple(encoder_widths))
        self.decoder = Decoder(tuple(decoder_widths), encoder_widths[-1], feature_fusion, target_side)
        for name, parameter in self.named_parameters():
            if name.endswith((".alpha", ".beta")):
                nn.init.constant_(parameter, initial_mixing)

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        """Return the target ``[b, n_target, 3]`` in the pose of the source ``[b, n_source, 3]``.

        Both are in normalised coordinates (box centred, half its longest edge = 1) and in the dtype of the parameters.

        Raises
        ------
        ValueError
            If shapes or dtypes do not fit.
        """
        return self.decode(latent=self.encode(source), target=target)

    def encode(self, source: Tensor) -> Tensor:
        """Return the pose vectors ``z``, ``[b, encoder_widths[-1]]``, of ``[b, n_source, 3]``; they may be reused.

        Raises
        ------
        ValueError
            If shape or dtype does not fit.
        """
        check_vertices("source", source, self.decoder.lift.weight.dtype)
        return cast(Tensor, self.encoder(source, masses_by(self.norm_weights, source)))

    def decode(self, *, latent: Tensor, target: Tensor) -> Tensor:
        """Return the target ``[b, n_target, 3]`` in the poses `latent` of `encode`.

        Raises
        ------
        ValueError
            If shapes or dtypes do not fit.
        """
        check_vertices("target", target, self.decoder.lift.weight.dtype)
        expected = [target.shape[0], self.encoder.last.out_features]
        if list(latent.shape) != expected:
            raise ValueError(f"one pose a target: latent must be {expected}, got {list(latent.shape)}")
        unused = [layer.bias for layer in (*self.encoder.linear_layers(), *self.decoder.before_norm())]
        moved = self.decoder(latent, target, masses_by(self.norm_weights, target))
        return with_zero_gradients(moved, unused)

    def adaptive_coefficients(self) -> dict[str, float]:
        """Return alpha (of scales) and beta (of shifts) of every FFAdaIN by name: the weight of the mixed branch."""
        return {
            name.removeprefix("decoder."): parameter.item()
            for name, parameter in self.named_parameters()
            if name.endswith((".alpha", ".beta"))
        }


class ResidualBlock(nn.Module):
    """FFAdaIN, ReLU and linear layer, twice; the two results are added.

    Under autocast the result is right but for a constant in each channel, which the norm that follows takes away.
    """

    def __init__(self, width: int, latent: int, feature_fusion: bool, target_side: bool) -> None:
        super().__init__()
        self.norm1 = FFAdaIN(channels=width, latent=latent, fusion=feature_fusion, target_side=target_side)
        self.norm2 = FFAdaIN(channels=width, latent=latent, target_side=target_side)
        self.linear1 = nn.Linear(width, width)
        self.linear2 = nn.Linear(width, width)

    def forward(self, active: Tensor, vertices: Tensor, probe: Tensor, masses: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return, after the first FFAdaIN and ReLU, the first summand without bias and what the second layer acts on.

        The rest is left to what follows the block, which has cheaper ways of doing it (see `joined`). Without
        gradients, the place of `active` in memory is used again.
        """
        active = centred_for_autocast(active)
        first = nn.functional.linear(active, self.linear1.weight)
        return first, rounded_modulated_relu(first, vertices, *self.norm2(probe), room=active, masses=masses)


class Decoder(nn.Module):
    """Three residual blocks on the target's vertices, with linear layers before, between and after."""

    def __init__(self, widths: tuple[int, ...], latent: int, feature_fusion: bool, target_side: bool) -> None:
        super().__init__()
        first, second, third = widths
        self.lift = nn.Linear(3, first)
        self.block1 = ResidualBlock(first, latent, feature_fusion, target_side)
        self.linear2 = nn.Linear(first, second)
        self.block2 = ResidualBlock(second, latent, feature_fusion, target_side)
        self.linear3 = nn.Linear(second, third)
        self.block3 = ResidualBlock(third, latent, feature_fusion, target_side)
        self.out = nn.Linear(third, 3)

    def before_norm(self) -> list[nn.Linear]:
        """Return the layers whose biases only shift what an instance norm centres again."""
        blocks = (self.block1, self.block2)
        inner = [layer for block in blocks for layer in (block.linear1, block.linear2)]
        return [self.lift, *inner, self.linear2, self.linear3]

    def forward(self, latent: Tensor, target: Tensor, masses: Tensor | None) -> Tensor:
        """Return ``[b, n, 3]`` for ``[b, latent]``, ``[b, n, 3]`` and the vertices' masses ``[b, n, 1]`` or None."""
        vertices = homogeneous(target)
        with full_precision(target):
            probe = pose_probe(latent)
            active = self.lifted(target, vertices, probe, masses)
        for block, following, norm in (
            (self.block1, self.linear2, self.block2.norm1),
            (self.block2, self.linear3, self.block3.norm1),
        ):
            first, second = block(active, vertices, probe, masses)
            modulate = rounded_modulated_relu if norm is self.block2.norm1 else modulated_relu
            merged = joined(first, second, block.linear2.weight, following.weight)
            active = modulate(merged, vertices, *norm(probe), room=merged, masses=masses)
            del merged
        with full_precision(target):  # rounding in the last block, the cheapest, would show in the output as it is
            first, second = self.block3(active, vertices, probe, masses)
            return 2 * torch.tanh(self._lowered(first, second))

    def lifted(self, target: Tensor, vertices: Tensor, probe: Tensor, masses: Tensor | None = None) -> Tensor:
        """Return the first layer, FFAdaIN and ReLU: ``IN(h) sigma + mu`` is quadratic in the coordinates."""
        scale, shift = self.block1.norm1(probe)
        centred = centred_features(target, masses)
        line = normalised_linear(self.lift.weight, centred, masses)
        monomials = (centred.unsqueeze(3) * vertices.unsqueeze(2)).flatten(2)
        coefficients = (line.unsqueeze(2) * scale.unsqueeze(1)).flatten(1, 2)
        if torch.compiler.is_compiling():  # Inductor lays vertices into the concatenation, with one mesh's strides
            return torch.relu(torch.baddbmm(vertices @ shift, monomials, coefficients))
        return torch.relu(torch.cat([monomials, vertices], dim=2) @ torch.cat([coefficients, shift], dim=1))

    def _lowered(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the end of the last block and the last layer; here no norm follows, and biases count."""
        inner = self.block3.linear1.bias + self.block3.linear2.bias
        moved = joined(first, second, self.block3.linear2.weight, self.out.weight)
        return moved + (self.out.weight @ inner + self.out.bias)


def joined(first: Tensor, second: Tensor, weight: Tensor, following: Tensor) -> Tensor:
    """Return ``following @ (first + weight @ second)``; if it narrows, merging the two matrices is cheaper."""
    if following.shape[0] < following.shape[1]:
        return _sum_with(nn.functional.linear(first, following), second, following @ weight)
    return nn.functional.linear(_sum_with(first, second, weight), following)


def _sum_with(first: Tensor, second: Tensor, weight: Tensor) -> Tensor:
    rows = torch.addmm(first.flatten(0, 1), second.flatten(0, 1), weight.t())
    return rows.view(*first.shape[:2], weight.shape[0])


def _check_sides(feature_fusion: bool, target_side: bool) -> None:
    if not feature_fusion and not target_side:
        raise ValueError(
            "feature_fusion=False keeps only the target's side, which target_side=False removes: choose one"
        )
