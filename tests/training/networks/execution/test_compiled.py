"""Compiled networks give what they give uncompiled, at any numbers of vertices; their gradients: test_execution.py."""

from __future__ import annotations

import pytest
import torch

from tests.support.three_networks import BY_AREA, FORMS, lively, pair

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
