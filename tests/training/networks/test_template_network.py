"""The occupancy network has the paper's parameters, starts as a ball, and hears the pose."""

import pytest
import torch

from training.networks.template import OccupancyTemplate


@pytest.mark.parametrize(("width", "parameters"), [(256, 465_708), (128, 118_444)])
def test_parameters(width: int, parameters: int) -> None:
    assert sum(each.numel() for each in OccupancyTemplate(width=width).parameters()) == parameters


def test_it_starts_as_about_a_ball() -> None:
    torch.manual_seed(0)
    network = OccupancyTemplate(centre=(1.0, 2.0, 3.0), radius=0.5)
    directions = torch.nn.functional.normalize(torch.randn(1, 500, 3), dim=2)
    inner, outer = (network(network.centre + radius * directions, torch.zeros(1, 69)) for radius in (0.25, 1.0))
    assert (inner > 0).all() and (outer < 0).all()


def test_it_hears_the_pose_and_every_parameter_learns() -> None:
    network, points = OccupancyTemplate(condition=6, width=16), torch.rand(2, 5, 3)
    logits = network(points, torch.randn(2, 6))
    assert logits.shape == (2, 5) and not torch.equal(network(points, torch.zeros(2, 6)), logits)
    logits.sum().backward()
    assert all(each.grad is not None and each.grad.abs().sum() > 0 for each in network.parameters())
