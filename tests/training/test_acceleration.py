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


@pytest.mark.gpu
@torch.no_grad()
def test_graphs_on_a_gpu_give_what_the_network_gives_for_changing_inputs_and_shapes(network: nn.Module) -> None:
    network = network.cuda()
    graphed = GraphedTransfer(network, kept=2)
    for vertices in (70, 70, 50, 30, 70):
        torch.manual_seed(vertices)
        source, target = (torch.rand(2, count, 3, device="cuda") for count in (90, vertices))
        assert torch.allclose(graphed(source=source, target=target), network(source=source, target=target), atol=1e-5)
