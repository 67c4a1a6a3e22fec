"""NPT against its equations, in both variants."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from tests.literal.npt import LiteralNPT
from tests.support.one_rank import two_backward_passes
from training.inference.predict import network_from
from training.networks import NETWORKS, build_network
from training.networks.layers import modulation
from training.networks.layers.modulation import homogeneous, modulated_relu
from training.networks.npt import NPT, quadratic_relu
from training.recipes.training import NETWORK_NAMES, DsffnetRecipe, NptRecipe, TrainingRecipe

VARIANTS = ["maxpool", "origin"]
NARROW = (8, 12, 20)


def _network(variant: str, dtype: torch.dtype = torch.float64, seed: int = 0, widths: tuple = NARROW) -> NPT:
    """Weights larger than the initial ones, so that every part of the network has an effect worth comparing."""
    torch.manual_seed(seed)
    network = NPT(variant=variant, encoder_widths=widths)
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            layer.reset_parameters()
    return network.to(dtype)


def _mesh(vertices: int, dtype: torch.dtype = torch.float64, batch: int = 2, seed: int = 1) -> Tensor:
    return torch.rand(batch, vertices, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) * 2 - 1


def _pair(variant: str, dtype: torch.dtype = torch.float64, source: int = 33, target: int = 27) -> dict[str, Tensor]:
    """Meshes with different numbers of vertices where the variant takes them."""
    return {
        "source": _mesh(source if variant == "maxpool" else target, dtype),
        "target": _mesh(target, dtype, seed=2),
    }


def _gradients(network: nn.Module, source: Tensor, target: Tensor) -> dict[str, Tensor]:
    """Return the output and all gradients of a random functional of it."""
    source, target = source.clone().requires_grad_(), target.clone().requires_grad_()
    output = network(source=source, target=target)
    weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(5), dtype=output.dtype)
    (output * weights.to(output.device)).sum().backward()
    found = {name: parameter.grad.flatten() for name, parameter in network.named_parameters()}
    return {"output": output.detach(), "source": source.grad, "target": target.grad, **found}


@pytest.mark.parametrize("variant", VARIANTS)
def test_parameter_count_is_that_of_the_released_code(variant: str) -> None:
    assert sum(parameter.numel() for parameter in NPT(variant=variant).parameters()) == 6_054_941


def test_weights_begin_as_released() -> None:
    torch.manual_seed(0)
    network = NPT(encoder_widths=(64, 128, 256))
    layer = network.decoder.block1.linear1
    assert layer.weight.std().item() == pytest.approx(0.02, rel=0.02) and abs(layer.weight.mean().item()) < 1e-3
    bound = layer.in_features**-0.5
    assert 0.9 * bound < layer.bias.abs().max() <= bound
    assert network.encoder.layers[0].weight.std().item() == pytest.approx(0.02, rel=0.2)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("widths", [NARROW, (5, 6, 9), (3, 2, 1)], ids=str)
def test_output_and_every_gradient_equal_the_equations(variant: str, widths: tuple) -> None:
    network = _network(variant, widths=widths)
    fast, literal = (_gradients(n, **_pair(variant)) for n in (network, LiteralNPT(network)))
    assert fast.keys() == literal.keys()
    for name, value in literal.items():
        torch.testing.assert_close(
            fast[name], value, rtol=1e-9, atol=1e-9, msg=lambda text, name=name: f"{name}: {text}"
        )
    torch.testing.assert_close(fast["output"], literal["output"], rtol=0, atol=1e-10)
    if widths == NARROW:
        assert fast["source"].abs().max() > 1e-3  # else this test would say nothing about the encoder


@pytest.mark.parametrize("variant", VARIANTS)
def test_initial_network_in_float32_is_as_exact_as_the_equations_in_float32(variant: str) -> None:
    torch.manual_seed(0)
    network, inputs = NPT(variant=variant, encoder_widths=(64, 128, 256)), _pair(variant, torch.float32, 300, 200)
    with torch.no_grad():
        fast, literal = network(**inputs), LiteralNPT(network)(**inputs)
        exact = network.double()(**{name: mesh.double() for name, mesh in inputs.items()})
    assert (fast - literal).abs().max() < 1e-5
    assert (fast - exact).abs().max() <= (literal - exact).abs().max()


@pytest.mark.parametrize("variant", VARIANTS)
def test_chunks_do_not_change_the_result(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    network, inputs = _network(variant), _pair(variant)
    whole = _gradients(network, **inputs)
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 100)
    network.zero_grad()
    parts = _gradients(network, **inputs)
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value, rtol=1e-10, atol=1e-10)


def test_modulated_relu_without_norm_has_the_derivative_of_its_equation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 30)
    torch.manual_seed(0)
    shapes = [(2, 9, 5), (2, 9, 4), (2, 4, 5), (2, 4, 5)]
    inputs = [torch.randn(shape, dtype=torch.float64, requires_grad=True) for shape in shapes]
    hidden, vertices, scale, shift = inputs
    assert torch.autograd.gradcheck(lambda *given: modulated_relu(*given, normalised=False), inputs)
    expected = torch.relu(hidden * (vertices @ scale) + vertices @ shift)
    torch.testing.assert_close(modulated_relu(*inputs, normalised=False), expected, rtol=1e-12, atol=1e-12)


def test_quadratic_relu_is_its_equation() -> None:
    torch.manual_seed(0)
    vertices = homogeneous(_mesh(9))
    line, scale, shift = (torch.randn(2, 4, 5, dtype=torch.float64) for _ in range(3))
    expected = torch.relu((vertices @ line) * (vertices @ scale) + vertices @ shift)
    torch.testing.assert_close(quadratic_relu(vertices, line, scale, shift), expected, rtol=1e-12, atol=1e-12)


def test_maxpool_target_permutation_permutes_the_output_and_source_permutation_changes_nothing() -> None:
    network, source, target = _network("maxpool"), _mesh(30), _mesh(25, seed=2)
    order, other = torch.randperm(25), torch.randperm(30)
    output = network(source=source, target=target)
    torch.testing.assert_close(network(source=source, target=target[:, order]), output[:, order], rtol=0, atol=1e-12)
    torch.testing.assert_close(network(source=source[:, other], target=target), output, rtol=0, atol=1e-12)


def test_origin_depends_on_how_vertices_are_paired_and_on_nothing_else() -> None:
    network, source, target, order = _network("origin"), _mesh(25), _mesh(25, seed=2), torch.randperm(25)
    output = network(source=source, target=target)
    together = network(source=source[:, order], target=target[:, order])
    torch.testing.assert_close(together, output[:, order], rtol=0, atol=1e-12)
    assert (network(source=source[:, order], target=target) - output).abs().max() > 1e-2


@pytest.mark.parametrize("variant", VARIANTS)
def test_meshes_of_a_batch_do_not_mix(variant: str) -> None:
    network, inputs = _network(variant), _pair(variant)
    together, alone = network(**inputs), network(**{name: mesh[1:] for name, mesh in inputs.items()})
    torch.testing.assert_close(together[1:], alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_pose_encoded_once_serves_many_targets(variant: str) -> None:
    network, source = _network(variant), _mesh(25)
    latent = network.encode(source)
    assert latent.shape == ((2, 20) if variant == "maxpool" else (2, 25, 20))
    for seed in (2, 3):
        target = _mesh(25, seed=seed)
        assert torch.equal(network.decode(latent=latent, target=target), network(source=source, target=target))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("vertices", [1, 2])
def test_few_vertices_are_moved_somewhere_finite(variant: str, vertices: int) -> None:
    output = _network(variant)(source=_mesh(vertices), target=_mesh(vertices))
    assert output.shape == (2, vertices, 3) and torch.isfinite(output).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_parameter_receives_a_gradient_and_dead_biases_receive_zero(variant: str) -> None:
    network = _network(variant)
    network(**_pair(variant)).square().sum().backward()
    dead = {name for name, value in network.named_parameters() if torch.count_nonzero(value.grad) == 0}
    expected = {f"encoder.layers.{i}.bias" for i in range(3)} | {f"decoder.linear{i}.bias" for i in (2, 3)}
    expected |= {f"decoder.block{i}.linear{which}.bias" for i in (1, 2) for which in ("2", "_residual")}
    expected |= {f"decoder.block{i}.linear1.bias" for i in (2, 3)}
    unnormed = {"decoder.lift.bias", "decoder.block1.linear1.bias"}
    assert dead == expected | (set() if variant == "maxpool" else unnormed)


@pytest.mark.parametrize("variant", VARIANTS)
def test_distributed_data_parallel_needs_no_search_for_unused_parameters(variant: str) -> None:
    two_backward_passes(_network(variant), _pair(variant))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("initial", [True, False])
def test_under_autocast_the_result_stays_close_and_float32(variant: str, initial: bool) -> None:
    """At first a feature varies by a hundredth of its size over a mesh: there a plain autocast errs by a fifth."""
    torch.manual_seed(0)
    widths = (64, 128, 256)
    network = NPT(variant=variant, encoder_widths=widths) if initial else _network(variant, torch.float32, 0, widths)
    inputs = _pair(variant, torch.float32, 200, 150)
    with torch.no_grad():
        full = network(**inputs)
        with torch.autocast("cpu", torch.bfloat16):
            half = network(**inputs)
    assert half.dtype == torch.float32
    error = (half - full).square().mean().sqrt() / full.std(dim=1).mean()
    assert 0 < error < 0.03


@pytest.mark.parametrize("variant", VARIANTS)
def test_export_gives_the_same_output_for_other_vertex_numbers(variant: str) -> None:
    network = _network(variant, torch.float32)
    example, other = _pair(variant, torch.float32, 30, 25), _pair(variant, torch.float32, 41, 17)
    source, target = (torch.export.Dim(f"{name}_vertices", min=2, max=10_000) for name in example)
    free = {"source": {1: source if variant == "maxpool" else target}, "target": {1: target}}
    with torch.no_grad():
        exported = torch.export.export(network, (), example, dynamic_shapes=free).module()
        torch.testing.assert_close(exported(**other), network(**other), rtol=0, atol=1e-5)


@pytest.mark.gpu
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_gpu_gives_the_same_gradients_every_time_and_those_of_the_cpu(variant: str) -> None:
    network, inputs = _network(variant), _pair(variant, torch.float64, 300, 200)
    expected = _gradients(network, **inputs)
    network.cuda()
    found = []
    for _ in range(2):
        network.zero_grad()
        found.append(_gradients(network, **{name: mesh.cuda() for name, mesh in inputs.items()}))
    for name, value in expected.items():
        assert torch.equal(found[0][name], found[1][name]), name
        torch.testing.assert_close(found[0][name].cpu(), value, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("variant", VARIANTS)
def test_safetensors_round_trip(variant: str, tmp_path: Path) -> None:
    network, other, inputs = _network(variant), _network(variant, seed=9), _pair(variant)
    assert not torch.equal(network(**inputs), other(**inputs))
    save_file(network.state_dict(), tmp_path / "weights.safetensors")
    other.load_state_dict(load_file(tmp_path / "weights.safetensors"))
    assert torch.equal(network(**inputs), other(**inputs))


@pytest.mark.parametrize(
    ("variant", "source", "target", "message"),
    [
        (
            "maxpool",
            torch.zeros(2, 3, 30),
            torch.zeros(2, 25, 3),
            r"source must be .*\[batch, vertex, 3\].*\[2, 3, 30\]",
        ),
        ("maxpool", torch.zeros(2, 30, 3), torch.zeros(25, 3), r"target must be .*\[25, 3\]"),
        ("maxpool", torch.zeros(2, 30, 3), torch.zeros(3, 25, 3), r"latent must be \[3, 20\], got \[2, 20\]"),
        ("maxpool", torch.zeros(2, 30, 3), torch.zeros(2, 25, 3).double(), r"torch.float32 tensor.*got torch.float64"),
        ("origin", torch.zeros(2, 30, 3), torch.zeros(2, 25, 3), r"equal: got \[2, 30, 3\] and \[2, 25, 3\]"),
        ("origin", torch.zeros(2, 25, 3), torch.zeros(3, 25, 3), r"equal: got \[2, 25, 3\] and \[3, 25, 3\]"),
        ("origin", torch.zeros(2, 0, 3), torch.zeros(2, 0, 3), r"source must be .*\[2, 0, 3\]"),
    ],
)
def test_errors_carry_the_shapes(variant: str, source: Tensor, target: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _network(variant, torch.float32)(source=source, target=target)


def test_origin_refuses_the_poses_of_a_mesh_with_other_vertices() -> None:
    network = _network("origin")
    with pytest.raises(ValueError, match=r"latent must be \[2, 25, 20\], got \[2, 30, 20\]"):
        network.decode(latent=network.encode(_mesh(30)), target=_mesh(25))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"encoder_widths": (8, 8)}, r"three positive integers, got \(8, 8\)"),
        ({"encoder_widths": (8, 0, 8)}, "three positive integers"),
        ({"variant": "max"}, "'maxpool' or 'origin', got 'max'"),
    ],
)
def test_impossible_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NPT(**options)


def test_a_recipe_builds_it_and_recipes_without_a_name_mean_dsffnet() -> None:
    assert set(NETWORK_NAMES) == set(NETWORKS)
    recipe = TrainingRecipe.model_validate({"network": {"name": "npt", "variant": "origin", "encoder_widths": NARROW}})
    network = network_from(recipe.network)
    assert isinstance(network, NPT) and network.variant == "origin" and network.decoder.lift.in_features == 23
    assert isinstance(build_network("npt", encoder_widths=NARROW), NPT)
    assert TrainingRecipe.model_validate({"network": {"target_side": False}}).network == DsffnetRecipe(
        target_side=False
    )
    assert TrainingRecipe().network == DsffnetRecipe()
    assert TrainingRecipe.model_validate(TrainingRecipe(network=NptRecipe()).model_dump()).network == NptRecipe()
