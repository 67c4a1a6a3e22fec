"""NPT written straight from its equations, in both variants: the oracle and the yardstick for the fast form."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tests.literal.dsffnet import LiteralEncoder
from tests.literal.norms import InstanceNorm, weigh
from training.networks.npt import NPT


class LiteralSPAdaIN(nn.Module):
    """``norm(h) * w(v) + b(v)`` on channels-first features ``[b, c, n]``."""

    def __init__(self, channels: int, normalised: bool) -> None:
        super().__init__()
        self.norm = InstanceNorm() if normalised else nn.Identity()
        self.scale, self.shift = nn.Conv1d(3, channels, 1), nn.Conv1d(3, channels, 1)

    def forward(self, hidden: Tensor, vertices: Tensor) -> Tensor:
        return self.norm(hidden) * self.scale(vertices) + self.shift(vertices)


class LiteralBlock(nn.Module):
    def __init__(self, width: int, normalised: bool = True) -> None:
        super().__init__()
        self.norm1, self.norm2 = LiteralSPAdaIN(width, normalised), LiteralSPAdaIN(width, normalised)
        self.norm_residual = LiteralSPAdaIN(width, normalised)
        self.linear1, self.linear2 = nn.Conv1d(width, width, 1), nn.Conv1d(width, width, 1)
        self.linear_residual = nn.Conv1d(width, width, 1)

    def forward(self, hidden: Tensor, vertices: Tensor) -> Tensor:
        first = self.linear1(torch.relu(self.norm1(hidden, vertices)))
        second = self.linear2(torch.relu(self.norm2(first, vertices)))
        return second + self.linear_residual(torch.relu(self.norm_residual(hidden, vertices)))


class LiteralDecoder(nn.Module):
    def __init__(self, width: int, normalised: bool) -> None:
        super().__init__()
        second, third = width // 2, width // 4
        self.lift, self.block1 = nn.Conv1d(width, width, 1), LiteralBlock(width, normalised)
        self.linear2, self.block2 = nn.Conv1d(width, second, 1), LiteralBlock(second)
        self.linear3, self.block3 = nn.Conv1d(second, third, 1), LiteralBlock(third)
        self.out = nn.Conv1d(third, 3, 1)

    def forward(self, mixed: Tensor, vertices: Tensor) -> Tensor:
        hidden = self.block1(self.lift(mixed), vertices)
        hidden = self.block2(self.linear2(hidden), vertices)
        hidden = self.block3(self.linear3(hidden), vertices)
        return 2 * torch.tanh(self.out(hidden))


class LiteralNPT(nn.Module):
    """The same network as `fast`, with a copy of its parameters (convolution weights have one dimension more)."""

    def __init__(self, fast: NPT) -> None:
        super().__init__()
        self.pooled, self.norm_weights = fast.variant == "maxpool", fast.norm_weights
        widths = [layer.out_features for layer in fast.encoder.linear_layers()]
        self.encoder = LiteralEncoder(widths)
        self.decoder = LiteralDecoder(widths[-1] + 3, normalised=not self.pooled)
        self.to(fast.decoder.lift.weight.dtype)
        own = self.state_dict()
        self.load_state_dict({name: value.reshape(own[name].shape) for name, value in fast.state_dict().items()})

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        weigh(self.encoder, self.norm_weights, source)
        weigh(self.decoder, self.norm_weights, target)
        vertices = target.transpose(1, 2)
        latent = self._latent(source.transpose(1, 2), vertices.shape[2])
        return self.decoder(torch.cat([latent, vertices], dim=1), vertices).transpose(1, 2)

    def _latent(self, source: Tensor, copies: int) -> Tensor:
        if self.pooled:
            return self.encoder(source).unsqueeze(2).repeat(1, 1, copies)
        return self.encoder.features(source)
