"""DSFFNet written straight from its equations: the oracle and the yardstick for the fast form."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tests.literal.norms import InstanceNorm, weigh
from training.networks.dsffnet import DSFFNet
from training.networks.layers.modulation import FFAdaIN


class LiteralNorm(nn.Module):
    """FFAdaIN on channels-first features ``[b, c, n]``, with its 1x1 convolutions of the concatenated feature."""

    def __init__(self, channels: int, latent: int, fusion: bool, target_side: bool) -> None:
        super().__init__()
        self.fusion, self.target_side = fusion, target_side
        self.norm = InstanceNorm()
        if target_side:
            self.identity_scale, self.identity_shift = nn.Conv1d(3, channels, 1), nn.Conv1d(3, channels, 1)
        if fusion:
            self.mixed_scale = nn.Conv1d(latent + 3, channels, 1)
            self.mixed_shift = nn.Conv1d(latent + 3, channels, 1)
        if fusion and target_side:
            self.alpha, self.beta = nn.Parameter(torch.zeros(1)), nn.Parameter(torch.zeros(1))

    def forward(self, hidden: Tensor, vertices: Tensor, mixed: Tensor) -> Tensor:
        if not self.fusion:
            return self.norm(hidden) * self.identity_scale(vertices) + self.identity_shift(vertices)
        if not self.target_side:
            return self.norm(hidden) * self.mixed_scale(mixed) + self.mixed_shift(mixed)
        sigma = self.alpha * self.mixed_scale(mixed) + (1 - self.alpha) * self.identity_scale(vertices)
        mu = self.beta * self.mixed_shift(mixed) + (1 - self.beta) * self.identity_shift(vertices)
        return self.norm(hidden) * sigma + mu


class LiteralBlock(nn.Module):
    def __init__(self, width: int, latent: int, first_fusion: bool, target_side: bool) -> None:
        super().__init__()
        self.norm1 = LiteralNorm(width, latent, first_fusion, target_side)
        self.norm2 = LiteralNorm(width, latent, True, target_side)
        self.linear1, self.linear2 = nn.Conv1d(width, width, 1), nn.Conv1d(width, width, 1)

    def forward(self, hidden: Tensor, vertices: Tensor, mixed: Tensor) -> Tensor:
        first = self.linear1(torch.relu(self.norm1(hidden, vertices, mixed)))
        second = self.linear2(torch.relu(self.norm2(first, vertices, mixed)))
        return first + second


class LiteralEncoder(nn.Module):
    def __init__(self, widths: list[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Conv1d(i, o, 1) for i, o in zip([3, *widths], widths, strict=False))
        self.norms = nn.ModuleList(InstanceNorm() for _ in widths)

    def features(self, source: Tensor) -> Tensor:
        for layer, norm in zip(self.layers, self.norms, strict=True):
            source = torch.relu(norm(layer(source)))
        return source

    def forward(self, source: Tensor) -> Tensor:
        return self.features(source).max(dim=2).values


class LiteralDecoder(nn.Module):
    def __init__(self, widths: list[int], latent: int, first_fusion: bool, target_side: bool) -> None:
        super().__init__()
        first, second, third = widths
        self.lift, self.block1 = nn.Conv1d(3, first, 1), LiteralBlock(first, latent, first_fusion, target_side)
        self.linear2, self.block2 = nn.Conv1d(first, second, 1), LiteralBlock(second, latent, first_fusion, target_side)
        self.linear3, self.block3 = nn.Conv1d(second, third, 1), LiteralBlock(third, latent, first_fusion, target_side)
        self.out = nn.Conv1d(third, 3, 1)

    def forward(self, latent: Tensor, vertices: Tensor) -> Tensor:
        mixed = torch.cat([latent.unsqueeze(2).expand(-1, -1, vertices.shape[2]), vertices], dim=1)
        hidden = self.block1(self.lift(vertices), vertices, mixed)
        hidden = self.block2(self.linear2(hidden), vertices, mixed)
        hidden = self.block3(self.linear3(hidden), vertices, mixed)
        return 2 * torch.tanh(self.out(hidden))


class LiteralDSFFNet(nn.Module):
    """The same network as `fast`, with a copy of its parameters (convolution weights have one dimension more)."""

    def __init__(self, fast: DSFFNet) -> None:
        super().__init__()
        self.norm_weights = fast.norm_weights
        decoder = fast.decoder
        first = decoder.block1.norm1
        assert isinstance(first, FFAdaIN)
        widths = [layer.out_features for layer in fast.encoder.linear_layers()]
        channels = [block.linear1.in_features for block in (decoder.block1, decoder.block2, decoder.block3)]
        self.encoder = LiteralEncoder(widths)
        self.decoder = LiteralDecoder(channels, widths[-1], first.fusion, first.target_side)
        self.to(decoder.lift.weight.dtype)
        own = self.state_dict()
        self.load_state_dict({name: value.reshape(own[name].shape) for name, value in fast.state_dict().items()})

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        weigh(self.encoder, self.norm_weights, source)
        weigh(self.decoder, self.norm_weights, target)
        latent = self.encoder(source.transpose(1, 2))
        return self.decoder(latent, target.transpose(1, 2)).transpose(1, 2)
