"""Each algebraic rewrite of the networks alone, against what it replaces, in float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import conv1d, linear

from tests.literal.corenet3d import LiteralElaIN
from tests.literal.dsffnet import LiteralNorm
from tests.literal.norms import InstanceNorm
from tests.support.three_networks import lively, meshes
from training.networks.dsffnet import DSFFNet, joined
from training.networks.layers import modulation
from training.networks.layers.elain import ElaIN, Generator, Identity, centred
from training.networks.layers.modulation import (
    FFAdaIN,
    affine_map,
    homogeneous,
    modulated_relu,
    pose_probe,
    posed_map,
)
from training.networks.layers.pose_encoder import PoseEncoder, centred_features, deviation_after, normalised_linear
from training.networks.npt import quadratic_relu

EXACT = {"rtol": 1e-10, "atol": 1e-10}


@pytest.fixture(autouse=True)
def _float64() -> None:
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(0)
    yield
    torch.set_default_dtype(torch.float32)


def _mesh(vertices: int, seed: int = 1) -> Tensor:
    return meshes(vertices, seed=seed, dtype=torch.float64)


def _by_channel(features: Tensor, masses: Tensor | None = None) -> Tensor:
    """Instance norm of ``[b, n, c]``."""
    norm = InstanceNorm()
    norm.masses = None if masses is None else masses.mT
    return norm(features.mT).mT


def test_a_linear_layer_of_pose_and_vertex_is_one_affine_map_a_mesh() -> None:
    layer, latent, vertices = nn.Linear(7 + 3, 5), torch.randn(2, 7), _mesh(9)
    mixed = torch.cat([latent.unsqueeze(1).expand(-1, 9, -1), vertices], dim=2)
    torch.testing.assert_close(homogeneous(vertices) @ posed_map(layer, pose_probe(latent)), layer(mixed), **EXACT)
    own = nn.Linear(3, 5)
    torch.testing.assert_close(homogeneous(vertices) @ affine_map(own), own(vertices), **EXACT)


@pytest.mark.parametrize(("fusion", "target_side"), [(True, True), (False, True), (True, False)])
def test_both_branches_of_ffadain_are_two_maps_a_mesh(fusion: bool, target_side: bool) -> None:
    norm = FFAdaIN(channels=5, latent=7, fusion=fusion, target_side=target_side)
    literal = LiteralNorm(5, 7, fusion, target_side)
    for parameter in norm.parameters():
        nn.init.normal_(parameter)
    own = literal.state_dict()
    literal.load_state_dict({name: value.reshape(own[name].shape) for name, value in norm.state_dict().items()})
    hidden, vertices, latent = torch.randn(2, 9, 5), _mesh(9), torch.randn(2, 7)
    scale, shift = norm(pose_probe(latent))
    found = _by_channel(hidden) * (homogeneous(vertices) @ scale) + homogeneous(vertices) @ shift
    mixed = torch.cat([latent.unsqueeze(2).expand(-1, -1, 9), vertices.transpose(1, 2)], dim=1)
    expected = literal(hidden.transpose(1, 2), vertices.transpose(1, 2), mixed).transpose(1, 2)
    torch.testing.assert_close(found, expected, **EXACT)


def test_a_norm_after_a_linear_layer_is_a_linear_layer_a_mesh_and_ignores_the_bias() -> None:
    layer, features = nn.Linear(6, 5), torch.randn(2, 11, 6)
    found = centred_features(features) @ normalised_linear(layer.weight, centred_features(features))
    torch.testing.assert_close(found, _by_channel(layer(features)), **EXACT)


def test_the_encoders_maximum_goes_through_norm_and_relu() -> None:
    encoder, source = PoseEncoder((6, 8, 12)), _mesh(30)
    torch.testing.assert_close(encoder(source), encoder.features(source).amax(dim=1), **EXACT)
    hidden = source
    for layer in encoder.linear_layers():
        hidden = torch.relu(_by_channel(layer(hidden)))
    torch.testing.assert_close(encoder(source), hidden.amax(dim=1), **EXACT)


def test_dsffnets_first_layer_norm_and_relu_are_quadratic_in_the_coordinates() -> None:
    network = lively("dsffnet").double()
    assert isinstance(network, DSFFNet)
    decoder, target, probe = network.decoder, _mesh(11), pose_probe(torch.randn(2, 24))
    scale, shift = decoder.block1.norm1(probe)
    vertices = homogeneous(target)
    expected = torch.relu(_by_channel(decoder.lift(target)) * (vertices @ scale) + vertices @ shift)
    torch.testing.assert_close(decoder.lifted(target, vertices, probe), expected, **EXACT)


@pytest.mark.parametrize("outputs", [3, 6, 9])
def test_a_blocks_last_layer_merges_with_the_next(outputs: int) -> None:
    first, second, weight, following = (torch.randn(s) for s in ((2, 7, 6), (2, 7, 6), (6, 6), (outputs, 6)))
    torch.testing.assert_close(
        joined(first, second, weight, following), (first + second @ weight.t()) @ following.t(), **EXACT
    )


def test_elain_is_two_affine_maps_of_the_identity_feature_a_mesh() -> None:
    norm, literal = ElaIN(5, 4), LiteralElaIN(5, 4)
    pairs = {"side": "mlp_same", "scale": "mlp_gamma", "shift": "mlp_beta", "blend": "mlp_weight"}
    for mine, released in pairs.items():
        layer, copy = norm.get_submodule(mine), literal.get_submodule(released)
        copy.load_state_dict({"weight": layer.weight.unsqueeze(2), "bias": layer.bias})
    hidden, identity, constant = torch.randn(2, 9, 5), torch.randn(2, 9, 4), torch.randn(5)
    found = norm(centred(hidden, constant), Identity.of(identity))
    expected = literal((hidden + constant).transpose(1, 2), identity.transpose(1, 2)).transpose(1, 2)
    torch.testing.assert_close(found, expected, **EXACT)


def test_3d_corenets_wide_convolution_and_the_next_layer_are_one_map_of_nine_numbers() -> None:
    generator, warped = Generator((12, 8, 6), 4), _mesh(10)
    found = generator.lifted(warped)
    weight = generator.lift.weight.view(12, 3, 3)
    lifted = conv1d(warped.transpose(1, 2), weight, generator.lift.bias, padding=1).transpose(1, 2)
    expected = linear(lifted, generator.linear1.weight, generator.linear1.bias)
    torch.testing.assert_close(found.values + found.mean, expected, **EXACT)
    torch.testing.assert_close(found.mean, expected.mean(dim=1, keepdim=True), **EXACT)
    torch.testing.assert_close(found.deviation, (expected.var(dim=1, keepdim=True) + 1e-5).sqrt(), **EXACT)


@pytest.mark.parametrize(("normalised", "weighted"), [(True, False), (False, False), (True, True)])
def test_modulated_relu_has_the_derivative_of_its_equation(
    normalised: bool, weighted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 30)
    inputs = [torch.randn(shape, requires_grad=True) for shape in ((2, 9, 5), (2, 9, 4), (2, 4, 5), (2, 4, 5))]
    hidden, vertices, scale, shift = inputs
    options = {"normalised": normalised, "masses": torch.randn(2, 9, 1).softmax(dim=1) if weighted else None}
    assert torch.autograd.gradcheck(lambda *given: modulated_relu(*given, **options), inputs)
    normal = _by_channel(hidden, options["masses"]) if normalised else hidden
    expected = torch.relu(normal * (vertices @ scale) + vertices @ shift)
    torch.testing.assert_close(modulated_relu(*inputs, **options), expected, rtol=1e-12, atol=1e-12)


def test_deviation_after_has_the_derivative_of_its_equation() -> None:
    weight = torch.randn(6, 4, requires_grad=True)
    features = centred_features(torch.randn(2, 9, 4)).requires_grad_()
    assert torch.autograd.gradcheck(deviation_after, (weight, features))
    variance = (features @ weight.t()).var(dim=1, correction=0)
    torch.testing.assert_close(deviation_after(weight, features), torch.rsqrt(variance + 1e-5))
    masses = torch.randn(2, 9, 1).softmax(dim=1)
    assert torch.autograd.gradcheck(lambda *given: deviation_after(*given, masses), (weight, features))
    variance = ((features @ weight.t()).square() * masses).sum(dim=1)
    torch.testing.assert_close(deviation_after(weight, features, masses), torch.rsqrt(variance + 1e-5))


def test_a_mean_far_above_the_deviation_does_not_spoil_the_norm() -> None:
    hidden = torch.randn(1, 500, 8, dtype=torch.float32) + 1e4  # neighbouring float32 numbers are 1e-3 apart there
    ones, zeros = (torch.zeros(1, 4, 8, dtype=torch.float32) for _ in range(2))
    ones[:, 3] = 1
    vertices = homogeneous(torch.rand(1, 500, 3, dtype=torch.float32))
    exact = modulated_relu(hidden.double(), vertices.double(), ones.double(), zeros.double())
    torch.testing.assert_close(modulated_relu(hidden, vertices, ones, zeros).double(), exact, rtol=0, atol=1e-3)


def test_a_channel_of_tiny_variance_keeps_its_scale() -> None:
    common = torch.randn(1, 400, 1) * 100
    features = torch.cat([common + 1e-1 * torch.randn(1, 400, 1), common], dim=2).float()
    features = features - features.mean(dim=1, keepdim=True)
    weight = torch.tensor([[1.0, -1.0]], dtype=torch.float32)
    exact = deviation_after(weight.double(), features.double())
    torch.testing.assert_close(deviation_after(weight, features).double(), exact, rtol=1e-5, atol=0)


def test_quadratic_relu_is_its_equation() -> None:
    vertices = homogeneous(_mesh(9))
    line, scale, shift = (torch.randn(2, 4, 5) for _ in range(3))
    expected = torch.relu((vertices @ line) * (vertices @ scale) + vertices @ shift)
    torch.testing.assert_close(quadratic_relu(vertices, line, scale, shift), expected, rtol=1e-12, atol=1e-12)
