"""NPT, neural pose transfer by spatially adaptive instance normalisation, in its two published variants."""

from __future__ import annotations

from typing import Literal, cast

import torch
from torch import Tensor, nn

from training.networks.layers.input_checks import check_norm_weights, check_vertices, check_widths
from training.networks.layers.modulation import (
    affine_map,
    full_precision,
    homogeneous,
    modulated_relu,
    pose_probe,
    posed_map,
    with_zero_gradients,
)
from training.networks.layers.pose_encoder import PoseEncoder
from training.networks.layers.sampling import masses_by

WEIGHT_DEVIATION = 0.02
"""Standard deviation of the initial weights (NPT, released ``utils.weights_init``)."""


class NPT(nn.Module):
    """Transfer the pose of `source` to `target` (Wang et al., CVPR 2020), without the redundant work of its equations.

    A pose encoder (1x1 convolution, instance norm and ReLU three times) gives features ``z``; a decoder of 1x1
    convolutions and three residual blocks takes ``[z, v]`` of every target vertex ``v`` to ``2 tanh(...)``. Its blocks
    are modulated by the target: ``SPAdaIN(h, v) = IN(h) w(v) + b(v)`` with affine ``w`` and ``b``. Either variant has
    6,054,941 parameters at the default widths.

    Parameters
    ----------
    variant
        ``"maxpool"``: ``z`` is the maximum over the source's vertices, one vector a mesh, and the first block applies
        no instance norm. The output is equivariant to a permutation of the target's vertices, and invariant to one of
        the source's. ``"origin"``: vertex i of the target has the features of vertex i of the source, of which there
        must be as many; what the network learns then depends on how data pair vertices.
    encoder_widths
        Channels after each layer of the pose encoder; the last is the length of ``z``. The decoder's blocks have
        ``last + 3``, and a half and a quarter of that, rounded down.
    norm_weights
        How much vertices count in instance norms: ``"uniform"``, all the same, as published; ``"area"``, by the area
        around them, so that it matters less how densely vertices lie.

    Notes
    -----
    =====================================  ===========================================================
    parameter                              initial value
    =====================================  ===========================================================
    weight of any layer                    normal, mean 0, standard deviation 0.02
    bias of a layer with i inputs          uniform in +-1/sqrt(i) (PyTorch's Conv1d, left by the release)
    =====================================  ===========================================================

    What is not computed, and why the result is the same: ``z`` of "maxpool" is one vector a mesh, so that the first
    layer is affine in ``v``, and the first SPAdaIN quadratic; each residual block's two last layers are merged with the
    layer that follows; a bias before an instance norm cancels (its gradient is exactly zero). The encoder is DSFFNet's.

    Departures from the released code: any number of vertices (it repeats ``z`` 6,890 times), and no modules without
    effect (the decoder's own norms). It is trained as released by ``training=npt-paper``: Adam at 5e-5, an edge loss of
    weight 0.0005 against the target's edges, the three of a face summed.

    Under autocast only wide products use the lower precision. In bfloat16 an initial network's output then errs by
    1.6 % of its deviation over the vertices (rms), where the plain form errs by 17 to 23 %.

    A NaN or an infinity in a mesh makes all output vertices of its pair NaN, and of no other pair (see `shapes`).

    Examples
    --------
    >>> network = NPT(encoder_widths=(8, 16, 32))
    >>> network(source=torch.rand(2, 50, 3), target=torch.rand(2, 40, 3)).shape
    torch.Size([2, 40, 3])
    """

    def __init__(
        self,
        *,
        variant: Literal["maxpool", "origin"] = "maxpool",
        encoder_widths: tuple[int, int, int] = (64, 128, 1024),
        norm_weights: Literal["uniform", "area"] = "uniform",
    ) -> None:
        super().__init__()
        if variant not in ("maxpool", "origin"):
            raise ValueError(f"variant must be 'maxpool' or 'origin', got {variant!r}")
        check_widths(encoder_widths=encoder_widths)
        check_norm_weights(norm_weights)
        self.variant, self.norm_weights = variant, norm_weights
        self.encoder = PoseEncoder(tuple(encoder_widths))
        self.decoder = Decoder(encoder_widths[-1], pooled=variant == "maxpool")
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.normal_(layer.weight, std=WEIGHT_DEVIATION)

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        """Return the target ``[b, n_target, 3]`` in the pose of the source ``[b, n_source, 3]``.

        Both are in normalised coordinates (box centred, half its longest edge = 1) and in the dtype of the parameters.

        Raises
        ------
        ValueError
            If shapes or dtypes do not fit.
        """
        if self.variant == "origin" and source.shape != target.shape:
            raise ValueError(
                "variant 'origin' pairs the vertices of source and target, so their shapes must be equal: "
                f"got {list(source.shape)} and {list(target.shape)}. Variant 'maxpool' takes any numbers of vertices"
            )
        return self.decode(latent=self.encode(source), target=target)

    def encode(self, source: Tensor) -> Tensor:
        """Return ``z`` of ``[b, n_source, 3]``: ``[b, c]`` ("maxpool") or ``[b, n_source, c]``; it may be reused.

        Raises
        ------
        ValueError
            If shape or dtype does not fit.
        """
        check_vertices("source", source, self.decoder.lift.weight.dtype)
        encode = self.encoder if self.variant == "maxpool" else self.encoder.features
        return cast(Tensor, encode(source, masses_by(self.norm_weights, source)))

    def decode(self, *, latent: Tensor, target: Tensor) -> Tensor:
        """Return the target ``[b, n_target, 3]`` in the poses `latent` of `encode`.

        Raises
        ------
        ValueError
            If shapes or dtypes do not fit.
        """
        check_vertices("target", target, self.decoder.lift.weight.dtype)
        expected = [*target.shape[: 1 if self.variant == "maxpool" else 2], self.encoder.last.out_features]
        if list(latent.shape) != expected:
            raise ValueError(f"one pose a target: latent must be {expected}, got {list(latent.shape)}")
        unused = [layer.bias for layer in (*self.encoder.linear_layers(), *self.decoder.before_norm())]
        moved = self.decoder(latent, target, masses_by(self.norm_weights, target))
        return with_zero_gradients(moved, unused)


class SPAdaIN(nn.Module):
    """Spatially adaptive modulation (NPT, section 3.2): affine maps of a vertex to the scale and shift of channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = nn.Linear(3, channels)
        self.shift = nn.Linear(3, channels)

    def forward(self, meshes: int) -> tuple[Tensor, Tensor]:
        """Return the maps of scale and shift, ``[meshes, 4, c]`` each."""
        size = (meshes, -1, -1)
        return affine_map(self.scale).expand(size), affine_map(self.shift).expand(size)


class ResidualBlock(nn.Module):
    """SPAdaIN, ReLU and linear layer, twice, beside a branch with the three once; the two results are added."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1, self.norm2, self.norm_residual = SPAdaIN(width), SPAdaIN(width), SPAdaIN(width)
        self.linear1, self.linear2 = nn.Linear(width, width), nn.Linear(width, width)
        self.linear_residual = nn.Linear(width, width)

    def forward(self, hidden: Tensor, vertices: Tensor, masses: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return what the last layers of the two branches act on; these are merged with what follows (`followed`)."""
        meshes = vertices.shape[0]
        first = modulated_relu(hidden, vertices, *self.norm1(meshes), masses=masses)
        second = nn.functional.linear(first, self.linear1.weight)
        residual = modulated_relu(hidden, vertices, *self.norm_residual(meshes), masses=masses)
        return modulated_relu(second, vertices, *self.norm2(meshes), masses=masses), residual

    def followed(self, weight: Tensor, branches: tuple[Tensor, Tensor]) -> Tensor:
        """Return ``weight @ block``, less its constant: `weight` has fewer rows than columns, so merging is cheaper."""
        second, residual = branches
        moved = nn.functional.linear(second, weight @ self.linear2.weight)
        rows = torch.addmm(moved.flatten(0, 1), residual.flatten(0, 1), (weight @ self.linear_residual.weight).t())
        return rows.view_as(moved)


class PooledBlock(ResidualBlock):
    """The first block of "maxpool": without instance norms, its input is known as one affine map a mesh."""

    def forward(self, line: Tensor, vertices: Tensor, masses: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the same for ``hidden = vertices @ line``, `line` ``[b, 4, c]``; less constants, as a norm follows.

        There is no norm in it, and no use for masses.

        A feature may vary far less over the vertices than it is large, more than a 16-bit number can hold. So products
        act on what varies, and constants are added in full precision.
        """
        meshes = vertices.shape[0]
        with full_precision(vertices):
            residual = quadratic_relu(vertices, line, *self.norm_residual(meshes))
            residual = residual - _constant_part(residual)
            inner = quadratic_relu(vertices, line, *self.norm1(meshes))
            mean = _constant_part(inner)
            scale, shift = self.norm2(meshes)
            shift = shift + scale * self.linear1(mean)
            inner = inner - mean
        inner = nn.functional.linear(inner, self.linear1.weight)  # one name for all, so that three arrays live at most
        inner = modulated_relu(inner, vertices, scale, shift, normalised=False)
        return inner - _constant_part(inner), residual


def _constant_part(features: Tensor) -> Tensor:
    """Return the mean over the vertices, ``[b, 1, c]``; added again or cancelled by a norm, it needs no derivative."""
    return features.detach().mean(dim=1, keepdim=True)


def quadratic_relu(vertices: Tensor, line: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """Return ``relu(hidden * sigma + mu)`` where hidden, sigma and mu are `vertices` times ``[b, 4, c]`` maps."""
    monomials = (vertices.unsqueeze(3) * vertices.unsqueeze(2)).flatten(2)
    coefficients = scale.unsqueeze(2) * line.unsqueeze(1) + nn.functional.pad(shift.unsqueeze(1), (0, 0, 0, 0, 3, 0))
    return torch.relu_(monomials @ coefficients.flatten(1, 2))


class Decoder(nn.Module):
    """Three residual blocks, with linear layers before, between and after."""

    def __init__(self, latent: int, *, pooled: bool) -> None:
        super().__init__()
        width = latent + 3
        first, second, third = width, width // 2, width // 4
        self.lift = nn.Linear(width, first)
        self.block1 = PooledBlock(first) if pooled else ResidualBlock(first)
        self.linear2 = nn.Linear(first, second)
        self.block2 = ResidualBlock(second)
        self.linear3 = nn.Linear(second, third)
        self.block3 = ResidualBlock(third)
        self.out = nn.Linear(third, 3)

    def before_norm(self) -> list[nn.Linear]:
        """Return the layers whose biases only shift what an instance norm centres again."""
        normed = [self.linear2, self.linear3, self.block2.linear1, self.block3.linear1]
        ends = [layer for block in (self.block1, self.block2) for layer in (block.linear2, block.linear_residual)]
        return [*normed, *ends, *([] if isinstance(self.block1, PooledBlock) else [self.lift, self.block1.linear1])]

    def forward(self, latent: Tensor, target: Tensor, masses: Tensor | None) -> Tensor:
        """Return ``[b, n, 3]`` for the latent, ``[b, c]`` or ``[b, n, c]``, and ``[b, n, 3]`` of these masses."""
        vertices = homogeneous(target)
        branches = self.block1(self._lifted(latent, target), vertices, masses)
        branches = self.block2(self.block1.followed(self.linear2.weight, branches), vertices, masses)
        branches = self.block3(self.block2.followed(self.linear3.weight, branches), vertices, masses)
        with full_precision(target):
            inner = self.block3.linear2.bias + self.block3.linear_residual.bias
            moved = self.block3.followed(self.out.weight, branches)
            return 2 * torch.tanh(moved + (self.out.weight @ inner + self.out.bias))

    def _lifted(self, latent: Tensor, target: Tensor) -> Tensor:
        """Return the first layer of ``[z, v]``: as a map of ``v`` a mesh where z is a mesh's, else its features."""
        if isinstance(self.block1, PooledBlock):
            with full_precision(target):
                return posed_map(self.lift, pose_probe(latent))
        pose, position = self.lift.weight[:, :-3], self.lift.weight[:, -3:]
        with full_precision(target):
            moved = target @ position.t()
        return torch.addmm(moved.flatten(0, 1), latent.flatten(0, 1), pose.t()).view_as(moved)
