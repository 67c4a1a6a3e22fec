"""3D-CoreNet against its equations, and what its transport may hold in memory."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from datagen.common.errors import CheckpointError
from tests.literal.corenet3d import LiteralCoreNet3D, literal_transport
from tests.support.one_rank import two_backward_passes
from training.networks import build_network
from training.networks.corenet3d import CoreNet3D
from training.networks.layers import optimal_transport as correspondence
from training.networks.layers.elain import neighbour_window
from training.networks.layers.optimal_transport import transport_matrix, warp
from training.networks.released_weights import load_released_corenet3d, released_names

NARROW = {"feature_widths": (8, 12, 16), "generator_widths": (24, 16, 10)}


def _network(dtype: torch.dtype = torch.float64, seed: int = 0, **options) -> CoreNet3D:
    """Return a network whose weights keep the size of what they act on: with the initial ones its output is tiny."""
    torch.manual_seed(seed)
    network = CoreNet3D(**{**NARROW, **options}).to(dtype)
    for parameter in network.parameters():
        nn.init.normal_(parameter, 0, parameter.shape[-1] ** -0.5 if parameter.ndim == 2 else 0.3)
    nn.init.normal_(network.generator.out.weight, 0, 0.2 * network.generator.out.in_features**-0.5)
    for layer in _spectral_layers(network):
        left, _, right = torch.linalg.svd(layer.parametrizations.weight.original.detach())
        layer.parametrizations.weight[0]._u.copy_(left[:, 0])
        layer.parametrizations.weight[0]._v.copy_(right[0])
    return network


def _spectral_layers(network: CoreNet3D) -> list[nn.Module]:
    return [layer for layer in network.modules() if is_parametrized(layer, "weight")]


def _mesh(vertices: int, dtype: torch.dtype = torch.float64, batch: int = 2, seed: int = 1) -> Tensor:
    return torch.rand(batch, vertices, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype) * 2 - 1


def _inputs(dtype: torch.dtype = torch.float64, source: int = 33, target: int = 27) -> dict[str, Tensor]:
    return {"source": _mesh(source, dtype), "target": _mesh(target, dtype, seed=2)}


def _unit(vertices: int, seed: int, dtype: torch.dtype = torch.float64, batch: int = 2) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return nn.functional.normalize(torch.randn(batch, vertices, 6, generator=generator, dtype=dtype), dim=2)


def _gradients(network: nn.Module, source: Tensor, target: Tensor) -> dict[str, Tensor]:
    """Return the output and all gradients of a random functional of it, parameters by the fast form's names."""
    source, target = source.clone().requires_grad_(), target.clone().requires_grad_()
    output = network(source=source, target=target)
    weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(5), dtype=output.dtype)
    (output * weights.to(output.device)).sum().backward()
    own = {
        f"{part}.{name}": mine
        for part in ("correspondence", "generator")
        for mine, name in released_names(part).items()
        if isinstance(network, LiteralCoreNet3D)
    }
    found = {own.get(name, name): parameter.grad.flatten() for name, parameter in network.named_parameters()}
    return {"output": output.detach(), "source": source.grad, "target": target.grad, **found}


def test_parameter_count_is_the_papers() -> None:
    network = CoreNet3D()
    assert sum(parameter.numel() for parameter in network.parameters()) == 24_461_447
    assert len(list(network.buffers())) == 2 * 9  # the singular vectors of nine layers, which are no parameters


@pytest.mark.parametrize("training", [True, False], ids=["train", "eval"])
@pytest.mark.parametrize(
    "options",
    [{}, {"generator_widths": (10, 24, 12)}, {"centre_features": True}],
    ids=["default", "widening", "centred"],
)
def test_output_and_every_gradient_equal_the_equations(options: dict, training: bool) -> None:
    network = _network(**options).train(training)
    literal = LiteralCoreNet3D(network)
    expected, found = (_gradients(n, **_inputs()) for n in (literal, network))
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(
            found[name], value, rtol=1e-8, atol=1e-8, msg=lambda text, name=name: f"{name}: {text}"
        )
    assert found["source"].abs().max() > 1e-3  # else this test would say nothing about the transport
    assert found["features.layers.0.weight"].abs().max() > 1e-3


def test_centring_the_features_is_another_network() -> None:
    plain, other = _network(), _network(centre_features=True)
    assert (plain(**_inputs()) - other(**_inputs())).abs().max() > 1e-2


def test_float32_output_is_as_exact_as_the_equations_in_float32() -> None:
    network = _network(torch.float32, feature_widths=(32, 64, 64), generator_widths=(128, 64, 32)).eval()
    inputs = _inputs(torch.float32, 300, 200)
    with torch.no_grad():
        fast, literal = network(**inputs), LiteralCoreNet3D(network)(**inputs)
        exact = network.double()(**{name: mesh.double() for name, mesh in inputs.items()})
    assert exact.std() > 0.1
    assert (fast - literal).abs().max() < 2e-5  # rounding of two float32 evaluations, in a box of 2
    assert (fast - exact).abs().max() < 1e-5 + 2 * (literal - exact).abs().max()


@pytest.mark.parametrize(("kept", "block"), [(10**6, 100), (0, 100), (0, 10**6), (0, 1)])
def test_blocks_and_streaming_do_not_change_the_result(kept: int, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    network = _network()
    whole = _gradients(network, **_inputs())
    monkeypatch.setattr(correspondence, "KEPT_ELEMENTS", kept)
    monkeypatch.setattr(correspondence, "BLOCK_ELEMENTS", block)
    network.zero_grad()
    for name, value in _gradients(network, **_inputs()).items():
        torch.testing.assert_close(value, whole[name], rtol=1e-9, atol=1e-10)


def test_warp_has_the_derivative_of_its_equation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(correspondence, "BLOCK_ELEMENTS", 12)
    inputs = [part.requires_grad_() for part in (_unit(7, 0), _unit(5, 1), _mesh(5))]
    assert torch.autograd.gradcheck(warp, inputs)


def test_transport_is_that_of_the_equations_and_moves_the_points() -> None:
    theta, phi, points = _unit(9, 0), _unit(12, 1), _mesh(12)
    transport = transport_matrix(theta, phi)
    torch.testing.assert_close(transport, literal_transport(theta @ phi.transpose(1, 2)), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(transport.sum(dim=2), torch.ones(2, 9).double())
    torch.testing.assert_close(transport @ points, warp(theta, phi, points))


def test_equal_features_correspond() -> None:
    features, order = torch.eye(12).unsqueeze(0), torch.randperm(12)
    transport = transport_matrix(features, features[:, order])
    assert torch.equal(transport.argmax(dim=2)[0], order.argsort())
    assert transport.max(dim=2).values.min() > 0.99


def test_opposite_features_stay_finite_in_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    theta, phi = _unit(6, 0, torch.float32), _unit(8, 0, torch.float32)
    theta[:, 0] = -phi[:, :1].mean(dim=1)
    phi[:] = phi[:, :1]
    points = _mesh(8, torch.float32)
    exact = literal_transport(theta.double() @ phi.double().transpose(1, 2)) @ points.double()
    for part in (theta, phi):
        part.requires_grad_()
    warped = warp(theta, phi, points)
    warped.sum().backward()
    torch.testing.assert_close(warped.double(), exact, rtol=0, atol=1e-5)
    assert torch.isfinite(theta.grad).all() and torch.isfinite(phi.grad).all()


class _Sizes(TorchDispatchMode):
    """Record the storage of every tensor that is made."""

    def __init__(self) -> None:
        super().__init__()
        self.storages: dict[int, int] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                storage = leaf.untyped_storage()
                self.storages[storage.data_ptr()] = storage.nbytes() // leaf.element_size()
        return result


@pytest.mark.parametrize(("kept", "largest"), [(0, 61 * 40), (10**6, 61 * 53)], ids=["streamed", "kept"])
def test_no_larger_array_than_promised_is_made_forward_or_backward(
    kept: int, largest: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(correspondence, "KEPT_ELEMENTS", kept)
    monkeypatch.setattr(correspondence, "BLOCK_ELEMENTS", 500)
    inputs = [part.requires_grad_() for part in (_unit(61, 0, batch=3), _unit(53, 1, batch=3), _mesh(53, batch=3))]
    with _Sizes() as seen:
        warped = warp(*inputs)
        warped.sum().backward()
    assert max(seen.storages.values()) <= largest


def test_autograd_keeps_no_matrix_between_the_passes() -> None:
    saved: list[int] = []
    inputs = [part.requires_grad_() for part in (_unit(61, 0), _unit(53, 1), _mesh(53))]
    with torch.autograd.graph.saved_tensors_hooks(lambda part: saved.append(part.numel()) or part, lambda part: part):
        warp(*inputs)
    assert len(saved) == 6 and max(saved) <= 2 * 61 * 6


def test_the_sources_order_has_no_effect() -> None:
    network, inputs, order = _network().eval(), _inputs(), torch.randperm(33)
    output = network(**inputs)
    moved = network(source=inputs["source"][:, order], target=inputs["target"])
    torch.testing.assert_close(moved, output, rtol=0, atol=1e-10)


def test_the_targets_order_has_an_effect_through_the_wide_convolution_alone() -> None:
    network, inputs, order = (
        _network().eval(),
        _inputs(),
        torch.randperm(27, generator=torch.Generator().manual_seed(3)),
    )
    moved = {"source": inputs["source"], "target": inputs["target"][:, order]}
    before, after = (network.forward_with_correspondence(**each) for each in (inputs, moved))
    torch.testing.assert_close(after.warped, before.warped[:, order], rtol=0, atol=1e-10)
    assert (after.vertices - before.vertices[:, order]).abs().max() > 1e-2
    with torch.no_grad():
        network.generator.lift.weight.view(-1, 3, 3)[:, :, ::2] = 0  # neither neighbour
    torch.testing.assert_close(network(**moved), network(**inputs)[:, order], rtol=0, atol=1e-10)


def test_neighbours_beyond_the_ends_are_zeros() -> None:
    window = neighbour_window(torch.arange(1.0, 7.0).view(1, 2, 3))
    assert window[0].tolist() == [[0, 1, 4, 0, 2, 5, 0, 3, 6], [1, 4, 0, 2, 5, 0, 3, 6, 0]]


@pytest.mark.parametrize(("source", "target"), [(2, 7), (40, 2), (5, 60)])
def test_any_numbers_of_vertices(source: int, target: int) -> None:
    network, inputs = _network().eval(), _inputs(source=source, target=target)
    torch.testing.assert_close(network(**inputs), LiteralCoreNet3D(network)(**inputs), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("source", "target"), [(1, 1), (1, 9), (9, 1)])
def test_a_single_vertex_is_moved_somewhere_finite(source: int, target: int) -> None:
    output = _network()(**_inputs(source=source, target=target))
    assert output.shape == (2, target, 3) and torch.isfinite(output).all()


def test_meshes_of_a_batch_do_not_mix() -> None:
    network, inputs = _network().eval(), _inputs()
    alone = network(**{name: mesh[1:] for name, mesh in inputs.items()})
    torch.testing.assert_close(network(**inputs)[1:], alone, rtol=0, atol=1e-11)


def test_one_forward_and_backward_gives_the_same_bits_every_time() -> None:
    found = [_gradients(_network(), **_inputs()) for _ in range(2)]
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())


def test_correspondence_is_that_of_the_output() -> None:
    network, inputs = _network().eval(), _inputs()
    found = network.forward_with_correspondence(**inputs)
    vertices, warped, transport = LiteralCoreNet3D(network).with_correspondence(**inputs)
    torch.testing.assert_close(network(**inputs), found.vertices, rtol=0, atol=1e-10)
    torch.testing.assert_close(found.transport, transport, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(found.warped, warped, rtol=0, atol=1e-10)
    torch.testing.assert_close(found.vertices, vertices, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["source", "target"])
@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_a_broken_coordinate_shows_in_its_whole_pair_and_no_other(name: str, broken: float) -> None:
    network, inputs = _network().eval(), _inputs()
    sound = network(**inputs)
    inputs[name][0, 4, 1] = broken
    output = network(**inputs)
    assert torch.isnan(output[0]).all()
    torch.testing.assert_close(output[1], sound[1], rtol=0, atol=1e-11)


def test_every_parameter_receives_a_gradient_and_dead_biases_receive_zero() -> None:
    network = _network()
    network(**_inputs()).square().sum().backward()
    assert [name for name, parameter in network.named_parameters() if parameter.grad is None] == []
    zero = {name for name, parameter in network.named_parameters() if torch.count_nonzero(parameter.grad) == 0}
    layers = [f"features.layers.{i}" for i in range(3)]
    layers += [f"features.blocks.{i}.linear{j}" for i in range(4) for j in (1, 2)]
    assert zero == {f"{layer}.bias" for layer in layers}


def test_distributed_data_parallel_needs_no_search_for_unused_parameters() -> None:
    two_backward_passes(_network(), _inputs())


def test_spectral_norm_holds_still_in_evaluation_and_closes_in_on_one_in_training() -> None:
    network = _network(seed=1)
    for layer in _spectral_layers(network):
        nn.init.normal_(layer.parametrizations.weight.original)
    before = {name: value.clone() for name, value in network.named_buffers()}
    first, second = (network.eval()(**_inputs()) for _ in range(2))
    assert torch.equal(first, second)
    assert all(torch.equal(value, before[name]) for name, value in network.named_buffers())
    network.train()
    for _ in range(300):
        for layer in _spectral_layers(network):
            _ = layer.weight
    assert not any(torch.equal(value, before[name]) for name, value in network.named_buffers())
    norms = [torch.linalg.matrix_norm(layer.weight, 2).item() for layer in _spectral_layers(network)]
    assert len(norms) == 9 and norms == pytest.approx([1] * 9, abs=1e-3)


def test_a_training_pass_iterates_once() -> None:
    network = _network(seed=1)
    norm = network.generator.block2.linear1.parametrizations.weight
    nn.init.normal_(norm.original)
    expected = nn.functional.normalize(norm.original.detach() @ norm[0]._v, dim=0)
    network(**_inputs())
    torch.testing.assert_close(norm[0]._u, expected)


def test_under_autocast_the_result_stays_close_and_float32() -> None:
    network = _network(torch.float32, feature_widths=(32, 64, 64), generator_widths=(128, 64, 32)).eval()
    inputs = _inputs(torch.float32, 200, 150)
    with torch.no_grad():
        full = network.forward_with_correspondence(**inputs)
        with torch.autocast("cpu", torch.bfloat16):
            half = network.forward_with_correspondence(**inputs)
            plain = network(**inputs)
    assert half.vertices.dtype == plain.dtype == torch.float32
    assert torch.equal(half.transport, full.transport)  # features, cosines and transport do not change
    for vertices in (half.vertices, plain):
        assert 0 < (vertices - full.vertices).square().mean().sqrt() / full.vertices.std() < 0.03


def test_training_under_autocast_gives_gradients_close_to_the_full_ones() -> None:
    network = _network(torch.float32)
    full = _gradients(network, **_inputs(torch.float32))
    network.zero_grad()
    with torch.autocast("cpu", torch.bfloat16):
        half = _gradients(network, **_inputs(torch.float32))
    for name in ("source", "generator.block1.linear0.parametrizations.weight.original", "generator.out.weight"):
        assert nn.functional.cosine_similarity(half[name].flatten(), full[name].flatten(), dim=0) > 0.98, name


def test_export_gives_the_same_output_for_other_vertex_numbers() -> None:
    network = _network(torch.float32).eval()
    free = {name: {1: torch.export.Dim(f"{name}_vertices", min=2, max=10_000)} for name in ("source", "target")}
    with torch.no_grad():
        exported = torch.export.export(network, (), _inputs(torch.float32), dynamic_shapes=free).module()
        other = _inputs(torch.float32, 41, 17)
        torch.testing.assert_close(exported(**other), network(**other), rtol=0, atol=1e-5)


@pytest.mark.gpu
def test_a_gpu_gives_the_same_gradients_every_time_and_those_of_the_cpu() -> None:
    network, inputs = _network().eval(), _inputs(source=300, target=200)
    expected = _gradients(network, **inputs)
    network.cuda()
    found = []
    for _ in range(2):
        network.zero_grad()
        found.append(_gradients(network, **{name: mesh.cuda() for name, mesh in inputs.items()}))
    for name, value in expected.items():
        assert torch.equal(found[0][name], found[1][name]), name
        torch.testing.assert_close(found[0][name].cpu(), value, rtol=1e-7, atol=1e-7)


def test_initial_values_are_those_of_the_table() -> None:
    torch.manual_seed(0)
    network = CoreNet3D(feature_widths=(64, 64, 128), generator_widths=(128, 64, 64))
    biases = [value for name, value in network.named_parameters() if name.endswith("bias")]
    assert len(biases) > 20 and not any(torch.count_nonzero(value) for value in biases)
    for layer, fans in (
        (network.theta, 256),
        (network.generator.block1.norm0.blend, 384),
        (network.generator.lift, 393),
    ):
        assert layer.weight.std().item() == pytest.approx(0.02 * (2 / fans) ** 0.5, rel=0.1)
    spectral = network.generator.block1.linear0.parametrizations.weight.original
    assert 0.99 * 128**-0.5 < spectral.abs().max() <= 128**-0.5
    assert network.features.blocks[0].activation.weight.item() == 0.25


def test_safetensors_round_trip(tmp_path: Path) -> None:
    network, other = _network().eval(), _network(seed=9).eval()
    assert not torch.equal(network(**_inputs()), other(**_inputs()))
    save_file(network.state_dict(), tmp_path / "weights.safetensors")
    other.load_state_dict(load_file(tmp_path / "weights.safetensors"))
    assert torch.equal(network(**_inputs()), other(**_inputs()))


def _released_files(folder: Path, prefix: str = "") -> tuple[LiteralCoreNet3D, dict[str, Path]]:
    """Write the two files as the released code would, from the literal network's own random weights."""
    torch.manual_seed(4)
    literal = LiteralCoreNet3D(_network(torch.float32)).eval()
    for parameter in literal.parameters():
        nn.init.normal_(parameter, 0, 0.3)
    paths = {"generator": folder / "latest_net_G.pth", "correspondence": folder / "latest_net_Corr.pth"}
    for part, path in paths.items():
        content = literal.get_submodule(part).state_dict()
        torch.save({prefix + name: value for name, value in content.items()}, path)
    return literal, paths


@pytest.mark.parametrize("prefix", ["", "module."])
def test_released_files_give_the_network_that_wrote_them(tmp_path: Path, prefix: str) -> None:
    literal, paths = _released_files(tmp_path, prefix)
    network = load_released_corenet3d(**paths)
    assert not network.training
    values = network.state_dict()
    for part in paths:
        for name, value in literal.get_submodule(part).state_dict().items():
            mine = next(own for own, released in released_names(part).items() if released == name)
            assert torch.equal(values.pop(mine).flatten(), value.flatten())
    assert not values
    found, expected = (n.double()(**_inputs()) for n in (network, literal))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def _without(name: str):
    return lambda content: {key: value for key, value in content.items() if key != name}


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("generator", _without("elain_block2.conv_s.weight_u"), r"missing: elain_block2\.conv_s\.weight_u$"),
        ("generator", _without("conv2.weight"), r"latest_net_G\.pth lacks conv2\.weight"),
        (
            "correspondence",
            _without("layer.3.prelu.weight"),
            r"Corr\.pth does not .* missing: layer\.3\.prelu\.weight$",
        ),
        ("correspondence", lambda content: {**content, "extra": torch.zeros(2)}, r"unknown: extra$"),
        (
            "generator",
            lambda content: {**content, "fc.weight": torch.zeros(24, 3, 1)},
            r"fc\.weight: shape \[24, 3, 1\], expected \[24, 3, 3\]$",
        ),
        ("generator", lambda content: {"epoch": 3}, r"must hold tensors by name"),
        ("generator", lambda content: [torch.zeros(2)], r"must hold tensors by name .* holds list"),
        ("generator", lambda content: {"conv1.weight": os.system}, r"cannot be read as released weights"),
    ],
)
def test_files_that_are_not_the_released_network_are_refused(tmp_path: Path, part: str, change, message: str) -> None:
    _, paths = _released_files(tmp_path)
    torch.save(change(torch.load(paths[part], weights_only=True)), paths[part])
    with pytest.raises(CheckpointError, match=message):
        load_released_corenet3d(**paths)


def test_missing_damaged_and_exchanged_files_are_refused(tmp_path: Path) -> None:
    _, paths = _released_files(tmp_path)
    with pytest.raises(CheckpointError, match=r"absent\.pth cannot be read"):
        load_released_corenet3d(tmp_path / "absent.pth", paths["correspondence"])
    with pytest.raises(CheckpointError, match=r"Corr\.pth lacks conv1\.weight.*exchanged|G\.pth lacks .*exchanged"):
        load_released_corenet3d(generator=paths["correspondence"], correspondence=paths["generator"])
    paths["generator"].write_bytes(paths["generator"].read_bytes()[:-2000])
    with pytest.raises(CheckpointError, match=r"latest_net_G\.pth cannot be read"):
        load_released_corenet3d(**paths)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        (torch.zeros(2, 3, 30), torch.zeros(2, 25, 3), r"source must be .*\[batch, vertex, 3\].*\[2, 3, 30\]"),
        (torch.zeros(2, 30, 3), torch.zeros(25, 3), r"target must be .*\[25, 3\]"),
        (torch.zeros(2, 0, 3), torch.zeros(2, 25, 3), r"source must be .*\[2, 0, 3\]"),
        (torch.zeros(2, 30, 3), torch.zeros(3, 25, 3), r"equally many, got shapes \[2, 30, 3\] and \[3, 25, 3\]"),
        (torch.zeros(2, 30, 3), torch.zeros(2, 25, 3).double(), r"torch.float32 tensor.*got torch.float64"),
    ],
)
def test_errors_carry_the_shapes(source: Tensor, target: Tensor, message: str) -> None:
    network = _network(torch.float32)
    for call in (network, network.forward_with_correspondence):
        with pytest.raises(ValueError, match=message):
            call(source=source, target=target)


@pytest.mark.parametrize("options", [{"feature_widths": (8, 8)}, {"generator_widths": (8, 0, 8)}], ids=str)
def test_impossible_options_are_refused(options: dict) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be three positive"):
        CoreNet3D(**options)


def test_registry_builds_it_by_name() -> None:
    assert isinstance(build_network("corenet3d", **NARROW), CoreNet3D)
