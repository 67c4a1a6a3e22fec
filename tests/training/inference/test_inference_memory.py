"""Inference without gradients: features pass rounded between products, memory is used again, and nobody notices."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.support.three_networks import FORMS, lively, pair
from training.networks.dsffnet import DSFFNet
from training.networks.layers import modulation
from training.networks.layers.modulation import (
    centred_for_autocast,
    homogeneous,
    modulated_relu,
    rounded_modulated_relu,
)

DTYPES = [torch.bfloat16, torch.float16]


def inputs(vertices: int = 37, channels: int = 5) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    torch.manual_seed(0)
    maps = (torch.randn(2, 4, channels) for _ in range(2))
    return torch.randn(2, vertices, channels) * 3, homogeneous(torch.rand(2, vertices, 3)), *maps


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("elements", [2**17, 60])  # one chunk; many, the last of them shorter
@pytest.mark.parametrize("vertices", [1, 37])
def test_rounded_features_are_those_that_autocast_would_take(
    monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype, elements: int, vertices: int
) -> None:
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", elements)
    hidden, *others = inputs(vertices)
    hidden = hidden.to(dtype)
    with torch.no_grad(), torch.autocast("cpu", dtype):
        expected = centred_for_autocast(modulated_relu(hidden, *others))
        found = rounded_modulated_relu(hidden, *others)
        room = torch.full_like(hidden, float("nan"))
        placed = rounded_modulated_relu(hidden, *others, room=room)
        in_place = rounded_modulated_relu(hidden.clone(), *others, room=hidden)
    assert found.dtype == dtype and torch.equal(placed, found)
    assert placed.data_ptr() == room.data_ptr() and torch.equal(in_place, found)
    torch.testing.assert_close(found, expected, rtol=torch.finfo(dtype).eps * 2, atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_result_may_take_the_place_of_its_argument_and_is_the_same(
    monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype
) -> None:
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 60)
    hidden, *others = (array.to(dtype) for array in inputs())
    expected = modulated_relu(hidden, *others)
    kept = modulated_relu(hidden.requires_grad_(), *others, room=hidden)  # a gradient is wanted: nothing is overwritten
    assert torch.equal(kept, expected) and kept.data_ptr() != hidden.data_ptr()
    with torch.no_grad():
        placed = modulated_relu(hidden, *others, room=hidden)
    assert placed.data_ptr() == hidden.data_ptr() and torch.equal(placed, expected)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("how", ["float32", "bfloat16"])
@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode])
def test_inference_changes_neither_meshes_nor_weights_nor_results_given_before(
    monkeypatch: pytest.MonkeyPatch, form: str, how: str, context: type
) -> None:
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 200)
    network, meshes = lively(form).eval(), pair(form)
    before = {name: value.clone() for name, value in [*network.state_dict().items(), *meshes.items()]}
    with context(), torch.autocast("cpu", torch.bfloat16, enabled=how == "bfloat16"):
        first = network(**meshes)
        copy = first.clone()
        again = network(**meshes)
        network(source=meshes["source"] * 0.5, target=meshes["target"] * 0.7)
    assert torch.equal(first, copy) and torch.equal(again, copy)
    now = {**network.state_dict(), **meshes}
    assert all(torch.equal(now[name], value) for name, value in before.items())


@pytest.mark.parametrize("how", ["float32", "bfloat16"])
def test_one_pose_serves_many_targets_without_gradients(how: str) -> None:
    torch.manual_seed(0)
    network = DSFFNet(encoder_widths=(8, 8, 16), decoder_widths=(8, 16, 8))
    source, targets = torch.rand(2, 40, 3), [torch.rand(2, 30, 3) for _ in range(2)]
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=how == "bfloat16"):
        latent = network.encode(source)
        found = [network.decode(latent=latent, target=target) for target in targets]
        for target, output in zip(targets, found, strict=True):
            assert torch.equal(network(source=source, target=target), output)


def test_export_under_autocast_takes_any_number_of_vertices() -> None:
    torch.manual_seed(0)
    network = DSFFNet(encoder_widths=(8, 8, 16), decoder_widths=(8, 16, 8)).eval()
    sizes = {"source": {1: torch.export.Dim("n", min=32)}, "target": {1: torch.export.Dim("m", min=17)}}
    meshes = {"source": torch.rand(2, 40, 3), "target": torch.rand(2, 30, 3)}
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        exported = torch.export.export(network, (), meshes, dynamic_shapes=sizes).module()
        other = {"source": torch.rand(2, 57, 3), "target": torch.rand(2, 61, 3)}
        found, expected = exported(**other), network(**other)
    assert (found - expected).abs().max() < 0.05 * expected.std()
