"""How a network is run does not change what it computes, beyond the rounding that was asked for.

With torch and pytest alone: ``pytest --noconftest -m gpu tests/training/networks/execution/test_execution.py``.
"""

import gc
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor, nn

from datagen.common.errors import CompilerError
from tests.support.ranks.one_rank import two_backward_passes
from training.networks import NETWORKS, execution
from training.networks.execution import GraphedTransfer, compiled, precision

SMALL: dict[str, dict[str, object]] = {
    "dsffnet": {"encoder_widths": (16, 32, 64), "decoder_widths": (32, 64, 32)},
    "npt": {"encoder_widths": (16, 32, 61)},
    "corenet3d": {"feature_widths": (16, 16, 32), "generator_widths": (64, 32, 16)},
}
CPU = torch.device("cpu")


@pytest.fixture(params=sorted(SMALL))
def network(request: pytest.FixtureRequest) -> nn.Module:
    torch.manual_seed(0)
    return NETWORKS[request.param](**SMALL[request.param]).eval()


def pair() -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    return {"source": torch.rand(2, 90, 3) * 2 - 1, "target": torch.rand(2, 70, 3) * 2 - 1}


@torch.no_grad()
def test_a_graphed_network_gives_what_the_network_gives(network: nn.Module) -> None:
    assert torch.equal(GraphedTransfer(network)(**pair()), network(**pair()))


@torch.no_grad()
def test_the_surrounding_autocast_has_no_effect() -> None:
    """Not even the weights that it has rounded and keeps, when they change afterwards."""
    torch.manual_seed(0)
    network = NETWORKS["dsffnet"](**SMALL["dsffnet"]).eval()
    exact, rounded = (GraphedTransfer(network, precision=name) for name in ("float32", "bfloat16"))
    expected = exact(**pair()), rounded(**pair())
    with torch.autocast("cpu", torch.bfloat16):
        network(**pair())
        assert torch.equal(exact(**pair()), expected[0]) and torch.equal(rounded(**pair()), expected[1])
        for parameter in network.parameters():
            parameter.mul_(1.5)
        changed = exact(**pair()), rounded(**pair())
    assert torch.equal(changed[0], exact(**pair())) and torch.equal(changed[1], rounded(**pair()))
    assert not torch.equal(changed[1], expected[1])


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
    from training.networks.layers.modulation import full_precision

    with precision("tf32", CPU):
        with full_precision(torch.zeros(1)):
            assert torch.get_float32_matmul_precision() == "highest"
        assert torch.get_float32_matmul_precision() == "high" and torch.backends.cudnn.allow_tf32
    with precision("float32", CPU):
        assert not torch.backends.cudnn.allow_tf32


def test_the_constants_taken_before_rounding_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any constants in the first two blocks: output and every gradient are those without, in float64."""
    from training.networks import dsffnet
    from training.networks.layers import modulation

    torch.manual_seed(0)
    network = NETWORKS["dsffnet"](**SMALL["dsffnet"]).double()
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
        return features - constants if calls[0] <= 5 else features

    for module in (dsffnet, modulation):
        monkeypatch.setattr(module, "centred_for_autocast", shifted)
    found = result()
    assert calls[0] == 7
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-8)


def test_features_far_from_zero_keep_their_differences_under_autocast() -> None:
    from training.networks.layers.modulation import centred_for_autocast

    torch.manual_seed(0)
    features = (torch.rand(2, 64, 5) + 1000).requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        rounded = centred_for_autocast(features)
    assert rounded.dtype == torch.bfloat16 and centred_for_autocast(features) is features
    spread = features - features.mean(dim=1, keepdim=True)
    assert (rounded.float() - rounded.float().mean(dim=1, keepdim=True) - spread).abs().max() < 0.005
    (rounded.float() * torch.arange(5)).sum().backward()
    assert torch.equal(features.grad, torch.arange(5.0).expand(2, 64, 5))


@pytest.mark.gpu
@torch.no_grad()
def test_tf32_stays_close(network: nn.Module) -> None:
    network = network.cuda()
    meshes = {name: mesh.cuda() for name, mesh in pair().items()}
    exact = network(**meshes)
    with precision("tf32", torch.device("cuda")):
        assert (network(**meshes) - exact).square().mean() < 1e-6


def test_a_pair_on_two_devices_is_refused() -> None:
    source, target = (SimpleNamespace(device=torch.device(name)) for name in ("cuda:0", "cpu"))
    with pytest.raises(ValueError, match="source is on cuda:0, target on cpu"):
        GraphedTransfer(nn.Identity())(source=source, target=target)


@pytest.mark.parametrize(
    ("device", "variable", "message"),
    [
        ("cpu", "CXX", r"needs a C\+\+ compiler on cpu, and there is no no-such-compiler here.*training.compile=false"),
        ("cuda", "CC", r"needs a C compiler on cuda, and there is no no-such-compiler here.*name yours in CC"),
    ],
)
def test_a_missing_compiler_is_said(device: str, variable: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setenv(variable, "no-such-compiler --flag")
    with pytest.raises(CompilerError, match=message):
        compiled(nn.Linear(3, 3), torch.device(device))


def test_a_missing_triton_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(CompilerError, match="pip install triton"):
        compiled(nn.Linear(3, 3), torch.device("cuda"))


def test_a_compiled_network_has_the_names_and_the_memory_of_the_original(network: nn.Module) -> None:
    twin = compiled(network, CPU)
    assert list(twin.state_dict()) == list(network.state_dict()) and type(twin) is type(network)
    assert all(mine is theirs for mine, theirs in zip(twin.parameters(), network.parameters(), strict=True))
    network.load_state_dict({name: torch.full_like(value, 0.25) for name, value in network.state_dict().items()})
    assert all((value == 0.25).all() for value in twin.state_dict().values())
    assert network._compiled_call_impl is None and twin._compiled_call_impl is not None


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("norm_weights", ["uniform", "area"])
def test_a_compiled_network_learns_as_the_original_for_any_vertex_counts(norm_weights: str) -> None:
    """Three counts: the first fixed, the second for any, the third with the kernels of the second."""
    torch._dynamo.reset()
    torch.manual_seed(0)
    network = NETWORKS["dsffnet"](**SMALL["dsffnet"], norm_weights=norm_weights)
    for name, parameter in network.named_parameters():
        if name.endswith(("alpha", "beta")):  # zero at first, when the pose has no effect
            nn.init.uniform_(parameter, -1, 1)
    twin = compiled(network, CPU)
    for source, target in ((90, 70), (100, 80), (95, 75)):
        meshes = {"source": torch.rand(2, source, 3) * 2 - 1, "target": torch.rand(2, target, 3) * 2 - 1}
        found = []
        for form in (network, twin):
            network.zero_grad()
            output = form(**meshes)
            output.square().sum().backward()
            found.append([output.detach(), *(parameter.grad.clone() for parameter in network.parameters())])
        scale = torch.cat([gradient.flatten() for gradient in found[0][1:]]).norm()
        for one, other in zip(*found, strict=True):
            error = one - other
            assert error.abs().max() < 1e-4 * (1 + other.abs().max()) and error.norm() < 1e-5 * scale
    two_backward_passes(twin, meshes)


@pytest.mark.slow
@pytest.mark.timeout(900)
@torch.no_grad()
def test_a_compiled_network_rounds_where_it_is_told() -> None:
    torch._dynamo.reset()
    torch.manual_seed(0)
    network = NETWORKS["dsffnet"](**SMALL["dsffnet"]).eval()
    exact, rounded = network(**pair()), GraphedTransfer(compiled(network, CPU), precision="bfloat16")(**pair())
    assert rounded.dtype == torch.float32
    assert 1e-4 < (rounded - exact).square().mean().sqrt() / exact.std() < 0.05


def on_gpu(seed: int, target: int = 70) -> dict[str, Tensor]:
    torch.manual_seed(seed)
    return {"source": torch.rand(1, 90, 3).cuda() * 2 - 1, "target": torch.rand(1, target, 3).cuda() * 2 - 1}


def in_precision(network: nn.Module, name: execution.Precision, seed: int) -> Tensor:
    with precision(name, torch.device("cuda")):
        return network(**on_gpu(seed))


@pytest.mark.gpu
def test_single_pairs_are_called_first_then_recorded_and_batches_and_training_never(network: nn.Module) -> None:
    network, recorded = network.cuda(), []
    graphed = GraphedTransfer(network)
    for seed in range(3):
        graphed(**{name: mesh.expand(2, -1, -1) for name, mesh in on_gpu(seed).items()})
        network.train()
        graphed(**on_gpu(seed))
        network.eval()
        recorded.append(graphed.recorded)
        graphed(**on_gpu(seed))
    assert recorded == [0, 0, 1] and GraphedTransfer(network, precision="tf32").recorded == 1, "of the network"
    GraphedTransfer(network, precision="tf32")(**on_gpu(0))
    assert graphed.recorded == 1, "a precision has graphs of its own"


@pytest.mark.gpu
def test_the_latest_shapes_are_kept_and_graphs_go_with_their_network() -> None:
    network = NETWORKS["dsffnet"](**SMALL["dsffnet"]).eval().cuda()
    for seed in range(2):  # what cuBLAS keeps for the streams stays
        GraphedTransfer(network)(**on_gpu(seed, 30))
    del network
    gc.collect()
    before = torch.cuda.memory_allocated()
    network = NETWORKS["dsffnet"](**SMALL["dsffnet"]).eval().cuda()
    graphed = GraphedTransfer(network, kept=2)
    for vertices in (40, 60, 40, 80, 40, 60):
        for seed in range(2):
            graphed(**on_gpu(seed, vertices))
        assert graphed.recorded <= 2
    del network, graphed
    gc.collect()
    assert torch.cuda.memory_allocated() - before < 2**20


@pytest.mark.gpu
@torch.no_grad()
def test_threads_wait_for_each_other() -> None:
    network = NETWORKS["dsffnet"](**SMALL["dsffnet"]).eval().cuda()
    graphed, inputs = GraphedTransfer(network), [on_gpu(seed) for seed in range(12)]
    expected = [network(**meshes) for meshes in inputs]
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(lambda meshes: graphed(**meshes), inputs))
    assert graphed.recorded == 1
    assert all(torch.allclose(one, other, atol=1e-5) for one, other in zip(found, expected, strict=True))


@pytest.mark.gpu
@torch.no_grad()
def test_graphs_on_a_gpu_give_what_the_network_gives_for_changing_inputs_and_shapes(network: nn.Module) -> None:
    network = network.cuda()
    graphed = GraphedTransfer(network, kept=2)
    for seed, vertices in enumerate((70, 70, 70, 50, 50, 30, 30, 70, 70, 70)):
        meshes = on_gpu(seed, vertices)
        assert torch.allclose(graphed(**meshes), network(**meshes), atol=1e-5)
    assert graphed.recorded


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["float32", "bfloat16"])
@torch.no_grad()
def test_a_graph_sees_weights_that_change_in_place_and_weights_that_are_replaced(
    network: nn.Module, name: execution.Precision
) -> None:
    network = network.cuda()
    graphed = GraphedTransfer(network, precision=name)

    def check() -> Tensor:
        outputs = [graphed(**on_gpu(seed)) for seed in range(4)]
        assert graphed.recorded
        for seed, output in enumerate(outputs):
            assert torch.allclose(output, in_precision(network, name, seed), atol=1e-5 if name == "float32" else 1e-3)
        return outputs[0]

    first = check()
    for parameter in network.parameters():
        parameter.mul_(1.2)
    second = check()
    network.load_state_dict({key: value * 0.8 for key, value in network.state_dict().items()}, assign=True)
    assert not torch.allclose(first, second, atol=1e-4) and not torch.allclose(second, check(), atol=1e-4)


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["float32", "bfloat16"])
@torch.no_grad()
def test_a_graph_recorded_or_replayed_under_autocast_computes_in_its_own_precision(
    network: nn.Module, name: execution.Precision
) -> None:
    network = network.cuda()
    graphed = GraphedTransfer(network, precision=name)
    expected = [in_precision(network, name, seed) for seed in range(5)]
    close = 1e-5 if name == "float32" else 1e-3
    with torch.autocast("cuda", torch.bfloat16):
        network(**on_gpu(9))  # autocast keeps rounded weights from here to the end of the block
        inside = [graphed(**on_gpu(seed)) for seed in range(3)]
    assert graphed.recorded
    outside = [graphed(**on_gpu(seed)) for seed in range(3, 5)]
    for found, known in zip(inside + outside, expected, strict=True):
        assert torch.allclose(found, known, atol=close)


@pytest.mark.gpu
@pytest.mark.slow
@torch.no_grad()
def test_a_compiled_network_is_replayed_on_a_gpu() -> None:
    torch._dynamo.reset()
    torch.manual_seed(0)
    network = NETWORKS["dsffnet"](**SMALL["dsffnet"]).eval().cuda()
    twin = compiled(network, torch.device("cuda"))
    graphed = GraphedTransfer(twin)
    for seed in range(4):
        assert torch.allclose(graphed(**on_gpu(seed)), network(**on_gpu(seed)), atol=1e-5)
    assert graphed.recorded


def test_inference_in_bfloat16_is_that_of_training_up_to_rounding() -> None:
    """Without gradients features pass rounded from product to product, and memory is used again."""
    torch.manual_seed(0)
    network = NETWORKS["dsffnet"](encoder_widths=(16, 32, 64), decoder_widths=(32, 128, 32))
    meshes = {name: torch.rand(2, 12 * mesh.shape[1], 3) * 2 - 1 for name, mesh in pair().items()}
    with torch.autocast("cpu", torch.bfloat16):
        trained = network(**meshes)
        with torch.no_grad():
            inferred = network(**meshes)
            again = network(**meshes)
    with torch.no_grad():
        exact = network(**meshes)
    assert torch.equal(inferred, again)
    error, rounding = (inferred - trained).square().mean().sqrt(), (trained - exact).square().mean().sqrt()
    assert error <= 0.1 * rounding and 0 < rounding < 0.02
