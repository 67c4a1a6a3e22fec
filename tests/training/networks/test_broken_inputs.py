"""Broken numbers and empty batches: nothing plausible comes of them, and no other mesh notices."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tests.support.three_networks import BY_AREA, FORMS, initial, lively, meshes, pair
from training.networks.dsffnet import DSFFNet
from training.networks.layers import modulation
from training.networks.layers import optimal_transport as correspondence
from training.networks.layers import pose_encoder as encoder_module
from training.networks.padded_batches import MixedCounts

BROKEN = [float("nan"), float("inf"), -float("inf")]


def _assert_only_the_second_pair_breaks(network: nn.Module, inputs: dict[str, Tensor], name: str, value: float) -> None:
    with torch.no_grad():
        sound = network(**inputs)
        for vertex in (0, inputs[name].shape[1] // 2, -1):  # the first and the last of a chunk among them
            broken = {**inputs, name: inputs[name].clone()}
            broken[name][1, vertex, 1] = value
            output = network(**broken)
            assert torch.isfinite(sound).all() and torch.isnan(output[1]).all()
            torch.testing.assert_close(output[0], sound[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("form", [*FORMS, *BY_AREA])
@pytest.mark.parametrize("name", ["source", "target"])
@pytest.mark.parametrize("value", BROKEN)
@pytest.mark.parametrize("start", [initial, lively])
def test_a_broken_coordinate_makes_its_pair_nan_and_no_other(form: str, name: str, value: float, start) -> None:
    _assert_only_the_second_pair_breaks(start(form).eval(), pair(form), name, value)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["source", "target"])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
def test_so_it_does_under_autocast(form: str, name: str, dtype: torch.dtype) -> None:
    with torch.autocast("cpu", dtype):
        _assert_only_the_second_pair_breaks(lively(form).eval(), pair(form), name, torch.nan)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["source", "target"])
def test_so_it_does_where_the_work_is_cut_into_chunks(form: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 200)
    monkeypatch.setattr(encoder_module, "ARGMAX_ELEMENTS", 200)
    monkeypatch.setattr(correspondence, "BLOCK_ELEMENTS", 100)
    monkeypatch.setattr(correspondence, "KEPT_ELEMENTS", 0)
    _assert_only_the_second_pair_breaks(lively(form).eval(), pair(form), name, torch.nan)


@pytest.mark.parametrize("option", ["feature_fusion", "target_side"])
@pytest.mark.parametrize("name", ["source", "target"])
def test_so_it_does_without_a_branch(option: str, name: str) -> None:
    torch.manual_seed(0)
    network = DSFFNet(encoder_widths=(8, 16, 24), decoder_widths=(16, 32, 16), **{option: False})
    if option == "feature_fusion":
        for norm in (network.decoder.block1.norm2, network.decoder.block3.norm2):
            nn.init.zeros_(norm.alpha)  # a pose of weight zero
    _assert_only_the_second_pair_breaks(network, pair("dsffnet"), name, torch.nan)


@pytest.mark.parametrize("form", FORMS)
def test_in_a_mixed_batch_the_padding_stays_zero_and_the_others_stay_sound(form: str) -> None:
    network, inputs = (
        lively(form).eval(),
        {"source": meshes(27, seed=1, batch=3), "target": meshes(27, seed=2, batch=3)},
    )
    inputs["source"][1, 3, 2] = torch.nan
    with torch.no_grad():
        output = MixedCounts(network)(**inputs, source_counts=[27, 20, 20], target_counts=[27, 20, 20])
    assert torch.isnan(output[1, :20]).all() and not output[1:, 20:].any()
    assert torch.isfinite(output[[0, 2]]).all()


@pytest.mark.parametrize("form", FORMS)
def test_gradients_of_a_broken_pair_are_nan_so_that_a_trainer_sees_it(form: str) -> None:
    network, inputs = lively(form), pair(form)
    inputs["target"][1, 3, 2] = torch.nan
    network(**inputs).square().mean().backward()
    # A rectifier's derivative hides it from single entries, never from a whole network.
    assert any(torch.isnan(parameter.grad).any() for parameter in network.parameters())


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("source", "target"), [(0, 0), (0, 2), (2, 0)])
def test_an_empty_batch_is_refused_with_its_shape(form: str, source: int, target: int) -> None:
    inputs = {"source": torch.zeros(source, 9, 3), "target": torch.zeros(target, 9, 3)}
    with pytest.raises(ValueError, match=r"\[0, 9, 3\]"):
        initial(form)(**inputs)
    with pytest.raises(ValueError, match=rf"at least one, got shapes \[{source}, 9, 3\] and \[{target}, 9, 3\]"):
        MixedCounts(initial(form))(**inputs)


@pytest.mark.parametrize(("source", "target"), [((2, 9, 3), (3, 9, 3)), ((9, 3), (2, 9, 3)), ((2, 9, 3), (9,))])
def test_a_mixed_batch_of_unequal_sizes_is_refused_with_its_shapes(source: tuple, target: tuple) -> None:
    with pytest.raises(ValueError, match="equally many meshes") as error:
        MixedCounts(initial("dsffnet"))(source=torch.zeros(source), target=torch.zeros(target))
    assert str(list(source)) in str(error.value) and str(list(target)) in str(error.value)
