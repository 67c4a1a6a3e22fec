"""DSFFNet against its equations. To write the golden output: ``python tests/training/networks/test_dsffnet.py
--regenerate``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from tests.literal.dsffnet import LiteralDSFFNet
from tests.support.one_rank import two_backward_passes
from training.networks import NETWORKS, build_network
from training.networks.dsffnet import DSFFNet
from training.networks.layers import modulation
from training.networks.layers import pose_encoder as encoder_module
from training.networks.layers.modulation import modulated_relu
from training.networks.layers.pose_encoder import deviation_after

GOLDEN = Path(__file__).parents[2] / "golden" / "dsffnet_output.json"
VARIANTS = [{}, {"feature_fusion": False}, {"target_side": False}]
NARROW = {"encoder_widths": (8, 12, 20), "decoder_widths": (10, 24, 14)}


def _network(dtype: torch.dtype = torch.float64, seed: int = 0, **options) -> DSFFNet:
    torch.manual_seed(seed)
    network = DSFFNet(**{**NARROW, **options}).to(dtype)
    for name, parameter in network.named_parameters():
        if name.endswith(("alpha", "beta")):
            nn.init.uniform_(parameter, -1, 1)
    return network


def _mesh(vertices: int, dtype: torch.dtype = torch.float64, batch: int = 2, seed: int = 1) -> Tensor:
    return torch.rand(batch, vertices, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) * 2 - 1


def _gradients(network: nn.Module, source: Tensor, target: Tensor) -> dict[str, Tensor]:
    """Return the output and all gradients of a random functional of it."""
    source, target = source.clone().requires_grad_(), target.clone().requires_grad_()
    output = network(source=source, target=target)
    weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(5), dtype=output.dtype)
    (output * weights.to(output.device)).sum().backward()
    found = {name: parameter.grad.flatten() for name, parameter in network.named_parameters()}
    return {"output": output.detach(), "source": source.grad, "target": target.grad, **found}


def test_parameter_count_is_the_papers() -> None:
    network = DSFFNet()
    assert sum(parameter.numel() for parameter in network.parameters()) == 9_371_023
    assert sum("alpha" in name for name in network.state_dict()) == 6


@pytest.mark.parametrize("options", VARIANTS, ids=str)
@pytest.mark.parametrize("decoder_widths", [(10, 24, 14), (24, 10, 24), (12, 12, 12)], ids=str)
def test_output_and_every_gradient_equal_the_equations(options: dict, decoder_widths: tuple) -> None:
    network = _network(decoder_widths=decoder_widths, **options)
    source, target = _mesh(33), _mesh(27, seed=2)
    fast, literal = (_gradients(n, source, target) for n in (network, LiteralDSFFNet(network)))
    assert fast.keys() == literal.keys()
    for name, value in literal.items():
        torch.testing.assert_close(
            fast[name], value, rtol=1e-9, atol=1e-9, msg=lambda text, name=name: f"{name}: {text}"
        )
    assert fast["source"].abs().max() > 1e-6  # else this test would say nothing about the encoder


@pytest.mark.parametrize("options", VARIANTS, ids=str)
def test_float32_output_is_as_exact_as_the_equations_in_float32(options: dict) -> None:
    network = _network(torch.float32, encoder_widths=(64, 128, 256), decoder_widths=(64, 256, 64), **options)
    inputs = {"source": _mesh(300, torch.float32), "target": _mesh(200, torch.float32, seed=2)}
    with torch.no_grad():
        fast, literal = network(**inputs), LiteralDSFFNet(network)(**inputs)
        exact = network.double()(**{name: mesh.double() for name, mesh in inputs.items()})
    assert (fast - exact).abs().max() < 1e-5
    assert (fast - exact).abs().max() < 2 * (literal - exact).abs().max()


def test_chunks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    network, source, target = _network(), _mesh(33), _mesh(27, seed=2)
    whole = _gradients(network, source, target)
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 100)
    monkeypatch.setattr(encoder_module, "ARGMAX_ELEMENTS", 200)
    network.zero_grad()
    parts = _gradients(network, source, target)
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value, rtol=1e-10, atol=1e-10)


def test_modulated_relu_has_the_derivative_of_its_equation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 30)
    torch.manual_seed(0)
    shapes = [(2, 9, 5), (2, 9, 4), (2, 4, 5), (2, 4, 5)]
    inputs = [torch.randn(shape, dtype=torch.float64, requires_grad=True) for shape in shapes]
    assert torch.autograd.gradcheck(modulated_relu, inputs)
    hidden, vertices, scale, shift = inputs
    normal = nn.functional.instance_norm(hidden.transpose(1, 2)).transpose(1, 2)
    expected = torch.relu(normal * (vertices @ scale) + vertices @ shift)
    torch.testing.assert_close(modulated_relu(*inputs), expected, rtol=1e-12, atol=1e-12)


def test_deviation_after_has_the_derivative_of_its_equation() -> None:
    torch.manual_seed(0)
    weight = torch.randn(6, 4, dtype=torch.float64, requires_grad=True)
    centred = torch.randn(2, 9, 4, dtype=torch.float64)
    centred = (centred - centred.mean(dim=1, keepdim=True)).requires_grad_()
    assert torch.autograd.gradcheck(deviation_after, (weight, centred))
    variance = (centred @ weight.t()).var(dim=1, correction=0)
    torch.testing.assert_close(deviation_after(weight, centred), torch.rsqrt(variance + 1e-5))


def test_a_mean_far_above_the_deviation_does_not_spoil_the_norm() -> None:
    torch.manual_seed(0)
    hidden = torch.randn(1, 500, 8) + 1e4  # neighbouring float32 numbers are 1e-3 apart there
    ones, zeros = torch.zeros(1, 4, 8), torch.zeros(1, 4, 8)
    ones[:, 3] = 1
    vertices = modulation.homogeneous(torch.rand(1, 500, 3))
    exact = modulated_relu(hidden.double(), vertices.double(), ones.double(), zeros.double())
    torch.testing.assert_close(modulated_relu(hidden, vertices, ones, zeros).double(), exact, rtol=0, atol=1e-3)


def test_a_channel_of_tiny_variance_keeps_its_scale() -> None:
    torch.manual_seed(0)
    common = torch.randn(1, 400, 1) * 100
    features = torch.cat([common + 1e-1 * torch.randn(1, 400, 1), common], dim=2)
    features = features - features.mean(dim=1, keepdim=True)
    weight = torch.tensor([[1.0, -1.0]])
    exact = deviation_after(weight.double(), features.double())
    torch.testing.assert_close(deviation_after(weight, features).double(), exact, rtol=1e-5, atol=0)


def test_target_permutation_permutes_the_output_and_source_permutation_changes_nothing() -> None:
    network, source, target = _network(), _mesh(30), _mesh(25, seed=2)
    order, other = torch.randperm(25), torch.randperm(30)
    output = network(source=source, target=target)
    torch.testing.assert_close(network(source=source, target=target[:, order]), output[:, order], rtol=0, atol=1e-12)
    torch.testing.assert_close(network(source=source[:, other], target=target), output, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("source", "target"), [(2, 7), (40, 2), (5, 60)])
def test_any_numbers_of_vertices(source: int, target: int) -> None:
    network = _network()
    inputs = {"source": _mesh(source), "target": _mesh(target, seed=2)}
    torch.testing.assert_close(network(**inputs), LiteralDSFFNet(network)(**inputs), rtol=1e-9, atol=1e-9)


def test_a_single_vertex_is_moved_somewhere_finite() -> None:
    output = _network()(source=_mesh(1), target=_mesh(1))
    assert output.shape == (2, 1, 3) and torch.isfinite(output).all()


def test_meshes_of_a_batch_do_not_mix() -> None:
    network, source, target = _network(), _mesh(30), _mesh(25, seed=2)
    together = network(source=source, target=target)
    alone = network(source=source[1:], target=target[1:])
    torch.testing.assert_close(together[1:], alone, rtol=0, atol=1e-12)


def test_a_pose_encoded_once_serves_many_targets() -> None:
    network, source = _network(), _mesh(30)
    latent = network.encode(source)
    assert latent.shape == (2, 20)
    for seed in (2, 3):
        target = _mesh(25, seed=seed)
        assert torch.equal(network.decode(latent=latent, target=target), network(source=source, target=target))


@pytest.mark.parametrize("options", VARIANTS, ids=str)
def test_every_parameter_receives_a_gradient_and_dead_biases_receive_zero(options: dict) -> None:
    network = _network(**options)
    network(source=_mesh(30), target=_mesh(25, seed=2)).square().sum().backward()
    missing = [name for name, parameter in network.named_parameters() if parameter.grad is None]
    assert missing == []
    for name in ("encoder.layers.1.bias", "decoder.lift.bias", "decoder.block2.linear2.bias", "decoder.linear3.bias"):
        assert torch.count_nonzero(network.get_parameter(name).grad) == 0
    assert torch.count_nonzero(network.get_parameter("decoder.block3.linear1.bias").grad) > 0


def test_distributed_data_parallel_needs_no_search_for_unused_parameters() -> None:
    two_backward_passes(_network(), {"source": _mesh(30), "target": _mesh(25, seed=2)})


def test_under_autocast_the_result_stays_close_and_float32() -> None:
    network = _network(torch.float32, encoder_widths=(64, 128, 256), decoder_widths=(64, 256, 64))
    inputs = {"source": _mesh(200, torch.float32), "target": _mesh(150, torch.float32, seed=2)}
    with torch.no_grad():
        full = network(**inputs)
        with torch.autocast("cpu", torch.bfloat16):
            half = network(**inputs)
    assert half.dtype == torch.float32
    error = (half - full).square().mean().sqrt() / full.std()
    assert 0 < error < 0.02


def test_export_gives_the_same_output_for_other_vertex_numbers() -> None:
    network = _network(torch.float32)
    example = {"source": _mesh(30, torch.float32), "target": _mesh(25, torch.float32, seed=2)}
    free = {name: {1: torch.export.Dim(f"{name}_vertices", min=2, max=10_000)} for name in example}
    with torch.no_grad():
        exported = torch.export.export(network, (), example, dynamic_shapes=free).module()
        other = {"source": _mesh(41, torch.float32), "target": _mesh(17, torch.float32, seed=2)}
        torch.testing.assert_close(exported(**other), network(**other), rtol=0, atol=1e-5)


@pytest.mark.gpu
def test_a_gpu_gives_the_same_gradients_every_time_and_those_of_the_cpu() -> None:
    network, source, target = _network(), _mesh(300), _mesh(200, seed=2)
    expected = _gradients(network, source, target)
    network.cuda()
    found = []
    for _ in range(2):
        network.zero_grad()
        found.append(_gradients(network, source.cuda(), target.cuda()))
    for name, value in expected.items():
        assert torch.equal(found[0][name], found[1][name]), name
        torch.testing.assert_close(found[0][name].cpu(), value, rtol=1e-8, atol=1e-8)


def test_adaptive_coefficients_by_name() -> None:
    network = _network(feature_fusion=False)
    found = network.adaptive_coefficients()
    assert sorted(found) == [f"block{i}.norm2.{which}" for i in (1, 2, 3) for which in ("alpha", "beta")]
    assert found["block2.norm2.beta"] == network.decoder.block2.norm2.beta.item()
    assert set(DSFFNet(**NARROW).adaptive_coefficients().values()) == {0.0}


def test_safetensors_round_trip(tmp_path: Path) -> None:
    network, other = _network(), _network(seed=9)
    inputs = {"source": _mesh(30), "target": _mesh(25, seed=2)}
    assert not torch.equal(network(**inputs), other(**inputs))
    save_file(network.state_dict(), tmp_path / "weights.safetensors")
    other.load_state_dict(load_file(tmp_path / "weights.safetensors"))
    assert torch.equal(network(**inputs), other(**inputs))


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (torch.zeros(2, 3, 30), torch.zeros(2, 25, 3), r"source must be .*\[batch, vertex, 3\].*\[2, 3, 30\]"),
        (torch.zeros(2, 30, 3), torch.zeros(25, 3), r"target must be .*\[25, 3\]"),
        (torch.zeros(2, 0, 3), torch.zeros(2, 25, 3), r"source must be .*\[2, 0, 3\]"),
        (torch.zeros(2, 30, 3), torch.zeros(3, 25, 3), r"latent must be \[3, 20\], got \[2, 20\]"),
        (torch.zeros(2, 30, 3), torch.zeros(2, 25, 3).double(), r"torch.float32 tensor.*got torch.float64"),
    ],
)
def test_errors_carry_the_shapes(source: Tensor, target: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _network(torch.float32)(source=source, target=target)


@pytest.mark.parametrize(
    "options",
    [{"encoder_widths": (8, 8)}, {"decoder_widths": (8, 0, 8)}, {"feature_fusion": False, "target_side": False}],
    ids=str,
)
def test_impossible_options_are_refused(options: dict) -> None:
    with pytest.raises(ValueError, match=r"widths must be three positive|choose one"):
        DSFFNet(**options)


def test_registry_builds_by_name_and_suggests_the_nearest() -> None:
    assert isinstance(build_network("dsffnet", **NARROW), NETWORKS["dsffnet"])
    with pytest.raises(ValueError, match=r"unknown network 'dsfnet'; did you mean 'dsffnet'\?"):
        build_network("dsfnet")


def _golden_output() -> Tensor:
    """Return the output of a network whose weights are sines, so that no random generator has a part in it."""
    network = _network()
    with torch.no_grad():
        for index, parameter in enumerate(network.parameters()):
            wave = torch.sin(torch.arange(1, parameter.numel() + 1, dtype=torch.float64) * (1.7 + index))
            parameter.copy_(wave.view_as(parameter) / parameter.shape[-1] ** 0.5)
        corner = torch.arange(36, dtype=torch.float64)
        return network(source=torch.cos(corner * 2.3).view(1, 12, 3), target=torch.cos(corner[:24] * 1.1).view(1, 8, 3))


def test_golden_output() -> None:
    expected = torch.tensor(json.loads(GOLDEN.read_text())["output"], dtype=torch.float64)
    torch.testing.assert_close(_golden_output(), expected, rtol=0, atol=1e-9)


if __name__ == "__main__" and sys.argv[1:] == ["--regenerate"]:
    command = "python tests/training/networks/test_dsffnet.py --regenerate"
    GOLDEN.write_text(json.dumps({"regenerate": command, "output": _golden_output().tolist()}, indent=1) + "\n")
