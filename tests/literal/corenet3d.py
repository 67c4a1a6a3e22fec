"""3D-CoreNet written straight from its equations, channels-first: the oracle and the yardstick for the fast form.

Modules bear the names of the released files, so that its two parts' ``state_dict`` are what those files hold.
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu
from torch.nn.utils import spectral_norm

from tests.literal.norms import InstanceNorm, OverVertices, weigh
from training.networks.corenet3d import CoreNet3D
from training.networks.released_weights import released_names


def scaled(features: Tensor) -> Tensor:
    return features / (torch.norm(features, 2, 1, keepdim=True) + sys.float_info.epsilon)


class LiteralFeatures(nn.Module):
    def __init__(self, widths: list[int]) -> None:
        super().__init__()
        first, second, third = widths
        self.layer1, self.layer2 = nn.Conv1d(3, first, 1), nn.Conv1d(first, second, 1)
        self.layer3, self.norm = nn.Conv1d(second, third, 1), InstanceNorm()

    def forward(self, vertices: Tensor) -> Tensor:
        hidden = leaky_relu(self.norm(self.layer1(vertices)), 0.2)
        hidden = leaky_relu(self.norm(self.layer2(hidden)), 0.2)
        return self.norm(self.layer3(hidden))


class LiteralResidualBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2, self.prelu = nn.Conv1d(width, width, 1), nn.Conv1d(width, width, 1), nn.PReLU()
        self.norm = InstanceNorm()

    def forward(self, features: Tensor) -> Tensor:
        inner = self.norm(self.conv2(self.prelu(self.norm(self.conv1(features)))))
        return self.prelu(inner + features)


class LiteralCorrespondence(nn.Module):
    def __init__(self, widths: list[int], centre: bool, norm_weights: str) -> None:
        super().__init__()
        self.centre, self.norm_weights = centre, norm_weights
        self.adaptive_feature = LiteralFeatures(widths)
        self.layer = nn.Sequential(*(LiteralResidualBlock(widths[-1]) for _ in range(4)))
        self.theta, self.phi = nn.Conv1d(widths[-1], widths[-1], 1), nn.Conv1d(widths[-1], widths[-1], 1)

    def described(self, vertices: Tensor) -> Tensor:
        features = self.adaptive_feature(vertices)
        return self.layer(scaled(features - features.mean(1, keepdim=True) if self.centre else features))

    def forward(self, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return identity features ``[b, c, n]``, warped points ``[b, n, 3]`` and the row-normalised transport."""
        norm = self.adaptive_feature.norm
        weigh(self, self.norm_weights, target.transpose(1, 2))
        identity, rows = self.described(target), norm.weights(target)
        weigh(self, self.norm_weights, source.transpose(1, 2))
        theta, phi = scaled(self.theta(identity)), scaled(self.phi(self.described(source)))
        transport = literal_transport(theta.transpose(1, 2) @ phi, rows.mT, norm.weights(source).mT)
        return identity, transport @ source.transpose(1, 2), transport


def literal_transport(cosine: Tensor, targets: Tensor | float, sources: Tensor | float) -> Tensor:
    """Return the whole transport after five iterations, divided by its rows' sums, for cosines ``[b, n, m]``.

    Its marginals are ``[b, n, 1]`` and ``[b, m, 1]``, or one number for all.
    """
    kernel = torch.exp(-(1.0 - cosine) / 0.03)
    left = torch.ones_like(cosine[:, :, :1]) * targets
    for _ in range(5):
        right = sources / (kernel.transpose(1, 2) @ left + 1e-8)
        left = targets / (kernel @ right + 1e-8)
    transport = left * kernel * right.transpose(1, 2)
    return transport / transport.sum(dim=2, keepdim=True)


class LiteralElaIN(OverVertices):
    def __init__(self, width: int, identity: int) -> None:
        super().__init__()
        self.mlp_same = nn.Conv1d(identity, width, 1)
        self.mlp_gamma, self.mlp_beta = nn.Conv1d(width, width, 1), nn.Conv1d(width, width, 1)
        self.mlp_weight = nn.Conv1d(2 * width, width, 1)

    def forward(self, hidden: Tensor, identity: Tensor) -> Tensor:
        side = self.mlp_same(identity)
        mean, unbiased = self.mean(hidden), hidden.shape[2] / (hidden.shape[2] - 1)
        deviation = torch.sqrt(unbiased * self.mean((hidden - mean).square()) + 1e-5)
        weight = self.mlp_weight(torch.cat([self.mean(side), mean], dim=1))
        gamma = self.mlp_gamma(side) * weight + deviation * (1 - weight)
        beta = self.mlp_beta(side) * weight + mean * (1 - weight)
        return (hidden - mean) / deviation * (1 + gamma) + beta


class LiteralElaINBlock(nn.Module):
    def __init__(self, width: int, identity: int) -> None:
        super().__init__()
        self.conv_0, self.conv_1 = (spectral_norm(nn.Conv1d(width, width, 1)) for _ in range(2))
        self.conv_s = spectral_norm(nn.Conv1d(width, width, 1, bias=False))
        self.norm_0, self.norm_1, self.norm_s = (LiteralElaIN(width, identity) for _ in range(3))

    def forward(self, hidden: Tensor, identity: Tensor) -> Tensor:
        shortcut = self.conv_s(leaky_relu(self.norm_s(hidden, identity), 0.2))
        inner = self.conv_0(leaky_relu(self.norm_0(hidden, identity), 0.2))
        return shortcut + self.conv_1(leaky_relu(self.norm_1(inner, identity), 0.2))


class LiteralGenerator(nn.Module):
    def __init__(self, widths: list[int], identity: int) -> None:
        super().__init__()
        first, second, third = widths
        self.fc, self.conv1 = nn.Conv1d(3, first, 3, padding=1), nn.Conv1d(first, first, 1)
        self.conv2, self.conv3 = nn.Conv1d(first, second, 1), nn.Conv1d(second, third, 1)
        self.conv4 = nn.Conv1d(third, 3, 1)
        self.elain_block1 = LiteralElaINBlock(first, identity)
        self.elain_block2 = LiteralElaINBlock(second, identity)
        self.elain_block3 = LiteralElaINBlock(third, identity)

    def forward(self, identity: Tensor, warped: Tensor) -> Tensor:
        hidden = self.elain_block1(self.conv1(self.fc(warped.transpose(1, 2))), identity)
        hidden = self.elain_block2(self.conv2(hidden), identity)
        hidden = self.elain_block3(self.conv3(hidden), identity)
        return 2 * torch.tanh(self.conv4(hidden))


class LiteralCoreNet3D(nn.Module):
    """The same network as `fast`, with a copy of its parameters and buffers under the released names."""

    def __init__(self, fast: CoreNet3D) -> None:
        super().__init__()
        features, generator = fast.features, fast.generator
        widths = [layer.out_features for layer in features.layers]
        channels = [layer.out_features for layer in (generator.lift, generator.linear2, generator.linear3)]
        self.correspondence = LiteralCorrespondence(widths, features.centre, fast.norm_weights)
        self.generator = LiteralGenerator(channels, widths[-1])
        self.to(fast.theta.weight.dtype)
        values = fast.state_dict()
        for part in ("correspondence", "generator"):
            own = self.get_submodule(part).state_dict()
            renamed = {name: values.pop(mine).reshape(own[name].shape) for mine, name in released_names(part).items()}
            self.get_submodule(part).load_state_dict(renamed)
        assert not values, f"without a released name: {list(values)}"
        self.train(fast.training)

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        return self.with_correspondence(source=source, target=target)[0]

    def with_correspondence(self, *, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        identity, warped, transport = self.correspondence(source.transpose(1, 2), target.transpose(1, 2))
        weigh(self.generator, self.correspondence.norm_weights, target)
        return self.generator(identity, warped).transpose(1, 2), warped, transport
