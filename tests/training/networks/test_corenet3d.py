"""3D-CoreNet: its transport and what it may hold in memory, its spectral norms, its released weights."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from datagen.common.errors import CheckpointError
from tests.literal.corenet3d import LiteralCoreNet3D, literal_transport
from tests.support.three_networks import functional_gradients, lively, meshes, pair
from training.networks.corenet3d import CoreNet3D
from training.networks.layers import optimal_transport as correspondence
from training.networks.layers.elain import neighbour_window
from training.networks.layers.optimal_transport import transport_matrix, warp
from training.networks.released_weights import load_released_corenet3d, released_names

NARROW = {"feature_widths": (8, 12, 16), "generator_widths": (24, 16, 10)}


def _network(dtype: torch.dtype = torch.float64, seed: int = 0, **options: Any) -> CoreNet3D:
    network = lively("corenet3d", dtype=dtype, seed=seed, **NARROW | options)
    assert isinstance(network, CoreNet3D)
    return network


def _spectral_layers(network: CoreNet3D) -> list[nn.Module]:
    return [layer for layer in network.modules() if is_parametrized(layer, "weight")]


def _mesh(vertices: int, dtype: torch.dtype = torch.float64, batch: int = 2) -> Tensor:
    return meshes(vertices, seed=1, batch=batch, dtype=dtype)


def _inputs(dtype: torch.dtype = torch.float64, source: int = 33, target: int = 27) -> dict[str, Tensor]:
    return pair("corenet3d", source=source, target=target, dtype=dtype)


def _unit(vertices: int, seed: int, dtype: torch.dtype = torch.float64, batch: int = 2) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return nn.functional.normalize(torch.randn(batch, vertices, 6, generator=generator, dtype=dtype), dim=2)


def _warped(network: CoreNet3D, inputs: dict[str, Tensor]) -> Tensor:
    """The warped source, which is what the generator is given."""
    given: list[Tensor] = []
    with network.generator.register_forward_pre_hook(lambda _, arguments: given.append(arguments[0])):
        network(**inputs)
    return given[0]


def test_the_singular_vectors_of_nine_layers_are_no_parameters() -> None:
    assert len(list(_network().buffers())) == 2 * 9


def test_centring_the_features_is_another_network() -> None:
    plain, other = _network(), _network(centre_features=True)
    assert (plain(**_inputs()) - other(**_inputs())).abs().max() > 1e-2


@pytest.mark.parametrize(("kept", "block"), [(10**6, 100), (0, 100), (0, 10**6), (0, 1)])
def test_blocks_and_streaming_do_not_change_the_result(kept: int, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    network = _network()
    whole = functional_gradients(network, _inputs())
    monkeypatch.setattr(correspondence, "KEPT_ELEMENTS", kept)
    monkeypatch.setattr(correspondence, "BLOCK_ELEMENTS", block)
    for name, value in functional_gradients(network, _inputs()).items():
        torch.testing.assert_close(value, whole[name], rtol=1e-9, atol=1e-10)


def test_warp_has_the_derivative_of_its_equation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(correspondence, "BLOCK_ELEMENTS", 12)
    inputs = [part.requires_grad_() for part in (_unit(7, 0), _unit(5, 1), _mesh(5))]
    assert torch.autograd.gradcheck(lambda *given: warp(*given, _masses(7), _masses(5)), inputs)


def _masses(vertices: int) -> Tensor:
    return torch.rand(2, vertices, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64).softmax(dim=1)


@pytest.mark.parametrize("masses", [lambda _: None, _masses], ids=["uniform", "by mass"])
def test_transport_is_that_of_the_equations_and_moves_the_points(masses: Any) -> None:
    theta, phi, points = _unit(9, 0), _unit(12, 1), _mesh(12)
    marginals = masses(9), masses(12)
    transport, cosine = transport_matrix(theta, phi, *marginals), theta @ phi.transpose(1, 2)
    expected = literal_transport(cosine, *(1 / n if m is None else m for m, n in zip(marginals, (9, 12), strict=True)))
    torch.testing.assert_close(transport, expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(transport.sum(dim=2), torch.ones(2, 9).double())
    torch.testing.assert_close(transport @ points, warp(theta, phi, points, *marginals))


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
    exact = literal_transport(theta.double() @ phi.double().transpose(1, 2), 1 / 6, 1 / 8) @ points.double()
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
    assert len(saved) == 8 and max(saved) <= 2 * 61 * 6


def test_the_targets_order_has_an_effect_through_the_wide_convolution_alone() -> None:
    network, inputs, order = (
        _network().eval(),
        _inputs(),
        torch.randperm(27, generator=torch.Generator().manual_seed(3)),
    )
    moved = {"source": inputs["source"], "target": inputs["target"][:, order]}
    torch.testing.assert_close(_warped(network, moved), _warped(network, inputs)[:, order], rtol=0, atol=1e-10)
    assert (network(**moved) - network(**inputs)[:, order]).abs().max() > 1e-2
    with torch.no_grad():
        network.generator.lift.weight.view(-1, 3, 3)[:, :, ::2] = 0  # neither neighbour
    torch.testing.assert_close(network(**moved), network(**inputs)[:, order], rtol=0, atol=1e-10)


def test_neighbours_beyond_the_ends_are_zeros() -> None:
    window = neighbour_window(torch.arange(1.0, 7.0).view(1, 2, 3))
    assert window[0].tolist() == [[0, 1, 4, 0, 2, 5, 0, 3, 6], [1, 4, 0, 2, 5, 0, 3, 6, 0]]


def test_correspondence_is_that_of_the_output() -> None:
    network, inputs = _network().eval(), _inputs()
    vertices, warped, transport = LiteralCoreNet3D(network).with_correspondence(**inputs)
    identity, theta, phi, masses = network._described(**inputs)
    found = transport_matrix(theta, phi, identity.masses, masses)
    torch.testing.assert_close(found, transport, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(_warped(network, inputs), warped, rtol=0, atol=1e-10)
    torch.testing.assert_close(network(**inputs), vertices, rtol=0, atol=1e-8)


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


def test_under_autocast_features_cosines_and_transport_do_not_change() -> None:
    network = _network(torch.float32, feature_widths=(32, 64, 64), generator_widths=(128, 64, 32)).eval()
    inputs = _inputs(torch.float32, 200, 150)
    warped, full = _warped(network, inputs), functional_gradients(network, inputs)["source"]
    with torch.autocast("cpu", torch.bfloat16):
        same, half = _warped(network, inputs), functional_gradients(network, inputs)["source"]
    assert torch.equal(same, warped)
    assert nn.functional.cosine_similarity(half.flatten(), full.flatten(), dim=0) > 0.98


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
            r"do not fit 3D-CoreNet \(.*Corr\.pth\): missing: layer\.3\.prelu\.weight$",
        ),
        ("correspondence", lambda content: {**content, "extra": torch.zeros(2)}, r"unknown: extra$"),
        (
            "generator",
            lambda content: {**content, "fc.weight": torch.zeros(24, 3, 1)},
            r"wrong shape: fc\.weight \[24, 3, 1\] instead of \[24, 3, 3\]$",
        ),
        ("generator", lambda content: {"epoch": 3}, r"under 'epoch' there is int"),
        ("generator", lambda content: [torch.zeros(2)], r"no weights by name, but list"),
        (
            "generator",
            lambda content: {"conv1.weight": os.system},
            r"latest_net_G\.pth cannot be loaded: it holds a Python",
        ),
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
    with pytest.raises(CheckpointError, match=r"latest_net_G\.pth cannot be loaded"):
        load_released_corenet3d(**paths)
