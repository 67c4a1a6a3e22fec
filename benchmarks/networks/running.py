"""What the benchmarks of networks run, the same for every form and on every device, and how results differ."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from training.networks.execution import Precision, autocast, precision, products
from training.objectives.losses import transfer_loss


class Meshes(NamedTuple):
    """Source, target and truth ``[b, n, 3]`` and edges ``[3 n, 2]``, all at random."""

    source: Tensor
    target: Tensor
    truth: Tensor
    edges: Tensor


def random_meshes(batch: int, vertices: int, device: torch.device) -> Meshes:
    """Return the same meshes on every device."""
    random = torch.Generator().manual_seed(1)
    parts = (torch.rand(batch, vertices, 3, generator=random) * 2 - 1 for _ in range(3))
    edges = torch.randint(vertices, (3 * vertices, 2), generator=random)
    return Meshes(*(part.to(device) for part in (*parts, edges)))


@torch.no_grad()
def with_every_branch(network: nn.Module) -> nn.Module:
    """Let the mixed branches of FFAdaIN take part: alpha and beta begin at zero, which would hide errors in them."""
    for name, parameter in network.named_parameters():
        if name.endswith((".alpha", ".beta")):
            parameter.fill_(0.4)
    return network


@torch.no_grad()
def forward(network: nn.Module, how: Precision, meshes: Meshes) -> Tensor:
    """Run one inference."""
    with precision(how, meshes.source.device):
        return network(source=meshes.source, target=meshes.target)  # type: ignore[no-any-return]


def backward(network: nn.Module, how: Precision, meshes: Meshes) -> None:
    """Run forward, both losses and backward; the gradients are left in the network."""
    with products(how):
        with autocast(how, meshes.source.device):
            prediction = network(source=meshes.source, target=meshes.target)
        # the literal form's output is bfloat16 under autocast
        transfer_loss(prediction.float(), truth=meshes.truth, target=meshes.target, edges=meshes.edges)[0].backward()


def step(network: nn.Module, how: Precision, optimiser: torch.optim.Optimizer, meshes: Meshes) -> None:
    """Run one training step; it leaves no gradients, so that they count as its memory, not as held before."""
    backward(network, how, meshes)
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)


def gradient(network: nn.Module, how: Precision, meshes: Meshes) -> dict[str, Tensor]:
    """Return the gradient of every parameter by name, flat and on the CPU, and clear them."""
    backward(network, how, meshes)
    found = {name: own.grad.flatten().cpu() for name, own in network.named_parameters() if own.grad is not None}
    network.zero_grad(set_to_none=True)
    return found


def largest(one: Tensor, other: Tensor) -> float:
    """Return the largest difference between two outputs."""
    return float((one.cpu() - other.cpu()).abs().max())


def mean_square(one: Tensor, other: Tensor) -> float:
    """Return the mean squared difference over vertices and coordinates: PMD."""
    return float((one.cpu() - other.cpu()).square().mean())


def relative(one: dict[str, Tensor], other: dict[str, Tensor]) -> float:
    """Return the length of the difference of two gradients over the second's; not a number where names differ."""
    if one.keys() != other.keys():
        return float("nan")
    left, right = (torch.cat([parts[name] for name in other]) for parts in (one, other))
    return float((left - right).norm() / right.norm())
