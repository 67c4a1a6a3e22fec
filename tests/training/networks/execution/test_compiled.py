"""Compiled networks give what they give uncompiled, forward and backward, at any numbers of vertices."""

from __future__ import annotations

import pytest
import torch

from tests.support.three_networks import BY_AREA, FORMS, lively, loss_gradients, meshes, pair
from training.networks.dsffnet import DSFFNet

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _fresh_compiler() -> None:
    torch.compiler.reset()


@torch.no_grad()
@pytest.mark.parametrize("form", [*FORMS, *BY_AREA])
def test_compiled_inference_gives_the_same_output_for_other_vertex_numbers(form: str) -> None:
    network = lively(form).eval()
    compiled = torch.compile(network, dynamic=True)
    for source, target in ((40, 50), (61, 33), (90, 120)):
        inputs = pair(form, source=source, target=target)
        torch.testing.assert_close(compiled(**inputs), network(**inputs), rtol=1e-4, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("form", FORMS)
def test_a_broken_coordinate_makes_its_pair_nan_and_no_other_compiled(form: str) -> None:
    network, inputs = lively(form).eval(), pair(form)
    compiled, sound = torch.compile(network, dynamic=True), network(**inputs)
    for name in inputs:
        broken = {**inputs, name: inputs[name].clone()}
        broken[name][1, 3, 2] = torch.nan
        output = compiled(**broken)
        assert torch.isnan(output[1]).all()
        torch.testing.assert_close(output[0], sound[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("norm_weights", ["uniform", "area"])
def test_compiled_gradients_of_dsffnet_equal_the_eager_ones_for_other_vertex_numbers(norm_weights: str) -> None:
    torch.manual_seed(0)
    network = DSFFNet(encoder_widths=(8, 16, 24), decoder_widths=(16, 32, 16), norm_weights=norm_weights)
    for name, parameter in network.named_parameters():
        if name.endswith(("alpha", "beta")):
            torch.nn.init.uniform_(parameter, -1, 1)
    compiled = torch.compile(network, dynamic=True)
    for source, target in ((40, 50), (61, 33)):
        inputs = {"source": meshes(source, seed=1), "target": meshes(target, seed=2)}
        found, expected = loss_gradients(compiled, inputs), loss_gradients(network, inputs)
        assert len(found) == len(expected) > 20
        scale = torch.cat([value.flatten() for value in expected.values()]).norm()
        for name, value in expected.items():
            assert (found[f"_orig_mod.{name}"] - value).norm() < 1e-5 * scale, name
