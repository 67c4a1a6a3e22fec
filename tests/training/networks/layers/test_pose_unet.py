"""The avatar's pose encoder: every size of map, the sharing of its third rise, and maps that do not know each other."""

import pytest
import torch

from training.networks.layers.pose_unet import PoseUNet, normalised


@pytest.mark.parametrize("size", [16, 32, 64, 128])
def test_features_are_as_large_as_the_maps(size: int) -> None:
    network = PoseUNet(size=size, width=2, channels=3, normalisation="group")
    found = network(torch.rand(1, 3, size, size))
    assert found.shape == (1, 3, size, size)
    found.square().sum().backward()
    assert all(each.grad is not None and each.grad.any() for each in network.parameters())


def test_from_256_pixels_on_the_third_rise_serves_twice() -> None:
    networks = {size: PoseUNet(size=size, width=16, channels=16, normalisation="batch") for size in (128, 256)}
    assert [len(each.up) for each in networks.values()] == [3, 3]
    assert sum(each.numel() for each in networks[256].parameters()) == 2_601_280 - 262_144
    assert networks[256].eval()(torch.rand(1, 3, 256, 256)).shape == (1, 16, 256, 256)


def test_groups_do_not_know_the_batch() -> None:
    network, maps = PoseUNet(size=16, width=4, channels=2, normalisation="group"), torch.rand(3, 3, 16, 16)
    torch.testing.assert_close(network(maps)[:1], network(maps[:1]))


def test_what_happens_far_away_is_heard_everywhere() -> None:
    network, maps = PoseUNet(size=32, width=4, channels=2, normalisation="group"), torch.rand(1, 3, 32, 32)
    moved = maps.clone()
    moved[..., 0, 0] += 1
    assert (network(moved) - network(maps)).abs()[..., -1, -1].min() > 1e-6


@pytest.mark.parametrize(("channels", "groups"), [(12, 4), (6, 2), (3, 1)])
def test_rows_are_normalised_as_by_group_norm(channels: int, groups: int) -> None:
    ours, theirs = normalised(channels, "group").double(), torch.nn.GroupNorm(groups, channels).double()
    state = {"weight": torch.randn(channels), "bias": torch.randn(channels)}
    rows, upstream = torch.randn(2, 50, channels).double().unbind()
    gradients = []
    for norm in (ours, theirs):
        norm.load_state_dict(state)
        given = rows.clone().requires_grad_()
        found = norm(given)
        gradients.append((found, *torch.autograd.grad(found, [given, *norm.parameters()], upstream)))
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-9, atol=1e-9)
    assert ours(rows[:0]).shape == (0, channels)
