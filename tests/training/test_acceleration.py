"""How a network is run does not change what it computes, beyond the rounding that was asked for."""

import pytest
import torch
from torch import nn

from training.acceleration import GraphedTransfer, precision
from training.networks import build_network

SMALL: dict[str, dict[str, object]] = {
    "dsffnet": {"encoder_widths": (16, 32, 64), "decoder_widths": (32, 64, 32)},
    "npt": {"encoder_widths": (16, 32, 61)},
    "corenet3d": {"feature_widths": (16, 16, 32), "generator_widths": (64, 32, 16)},
}
CPU = torch.device("cpu")


@pytest.fixture(params=sorted(SMALL))
def network(request: pytest.FixtureRequest) -> nn.Module:
    torch.manual_seed(0)
    return build_network(request.param, **SMALL[request.param]).eval()


def pair() -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    return {"source": torch.rand(2, 90, 3) * 2 - 1, "target": torch.rand(2, 70, 3) * 2 - 1}


@torch.no_grad()
def test_a_graphed_network_gives_what_the_network_gives(network: nn.Module) -> None:
    assert torch.equal(GraphedTransfer(network)(**pair()), network(**pair()))


@torch.no_grad()
def test_bfloat16_stays_close_and_gives_float32(network: nn.Module) -> None:
    exact = network(**pair())
    rounded = GraphedTransfer(network, precision="bfloat16")(**pair())
    assert rounded.dtype == torch.float32 and not torch.equal(rounded, exact)
    assert (rounded - exact).square().mean().sqrt() < 0.05 * exact.std()


def test_the_precision_before_is_restored_also_after_an_error() -> None:
    before = torch.get_float32_matmul_precision()
    with pytest.raises(RuntimeError, match="stop"), precision("tf32", CPU):
        assert torch.get_float32_matmul_precision() == "high"
        raise RuntimeError("stop")
    assert torch.get_float32_matmul_precision() == before
    with precision("bfloat16", CPU):
        assert torch.is_autocast_enabled("cpu")
    assert not torch.is_autocast_enabled("cpu")


def test_what_does_not_bear_tf32_is_shielded_from_it() -> None:
    from training.networks.modulation import full_precision

    with precision("tf32", CPU):
        with full_precision(torch.zeros(1)):
            assert torch.get_float32_matmul_precision() == "highest"
        assert torch.get_float32_matmul_precision() == "high" and torch.backends.cudnn.allow_tf32
    with precision("float32", CPU):
        assert not torch.backends.cudnn.allow_tf32


def test_the_constants_taken_before_rounding_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any constants in the first two blocks: output and every gradient are those without, in float64."""
    from training.networks import dsffnet

    torch.manual_seed(0)
    network = build_network("dsffnet", **SMALL["dsffnet"]).double()
    meshes = {name: mesh.double().requires_grad_() for name, mesh in pair().items()}

    def result() -> list[torch.Tensor]:
        network.zero_grad()
        output = network(**meshes)
        gradients = torch.autograd.grad(output.square().sum(), [*network.parameters(), *meshes.values()])
        return [output.detach(), *gradients]

    expected, calls = result(), [0]

    def shifted(features: torch.Tensor) -> torch.Tensor:
        calls[0] += 1
        constants = torch.randn(features.shape[0], 1, features.shape[2], dtype=features.dtype)
        return features - constants if calls[0] <= 4 else features

    monkeypatch.setattr(dsffnet, "centred_for_autocast", shifted)
    found = result()
    assert calls[0] == 6
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-8)


def test_features_far_from_zero_keep_their_differences_under_autocast() -> None:
    from training.networks.rounding import centred_for_autocast

    torch.manual_seed(0)
    features = (torch.rand(2, 64, 5) + 1000).requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        rounded = centred_for_autocast(features)
    assert rounded.dtype == torch.bfloat16 and centred_for_autocast(features) is features
    spread = features - features.mean(dim=1, keepdim=True)
    assert (rounded.float() - rounded.float().mean(dim=1, keepdim=True) - spread).abs().max() < 0.005
    (rounded.float() * torch.arange(5)).sum().backward()
    assert torch.equal(features.grad, torch.arange(5.0).expand(2, 64, 5))


@torch.no_grad()
def test_a_broken_coordinate_shows_in_its_own_mesh_only(network: nn.Module) -> None:
    broken = pair()
    broken["target"][1, 3, 0] = torch.nan
    output = network(**broken)
    assert torch.isfinite(output[0]).all() and torch.isnan(output[1]).any()


@pytest.mark.gpu
@torch.no_grad()
def test_tf32_stays_close(network: nn.Module) -> None:
    network = network.cuda()
    meshes = {name: mesh.cuda() for name, mesh in pair().items()}
    exact = network(**meshes)
    with precision("tf32", torch.device("cuda")):
        assert (network(**meshes) - exact).square().mean() < 1e-6


@pytest.mark.gpu
@torch.no_grad()
def test_graphs_on_a_gpu_give_what_the_network_gives_for_changing_inputs_and_shapes(network: nn.Module) -> None:
    network = network.cuda()
    graphed = GraphedTransfer(network, kept=2)
    for vertices in (70, 70, 50, 30, 70):
        torch.manual_seed(vertices)
        source, target = (torch.rand(2, count, 3, device="cuda") for count in (90, vertices))
        assert torch.allclose(graphed(source=source, target=target), network(source=source, target=target), atol=1e-5)
