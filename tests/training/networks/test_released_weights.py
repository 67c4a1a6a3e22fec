"""Released weights: read by name as the authors' modules use them, and by ours."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import conv1d, instance_norm

from datagen.common.errors import DsffnetError
from tests.support.three_networks import to_released
from training.networks.dsffnet import DSFFNet
from training.networks.npt import NPT
from training.networks.released_weights import load_released_dsffnet, load_released_npt

ENCODER, DECODER = (8, 12, 20), (10, 24, 14)


class _Weights:
    """A state_dict of 1x1 convolutions, and which of its names have been used."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        self.state, self.used = state, set[str]()

    def __getitem__(self, name: str) -> Tensor:
        self.used.add(name)
        return self.state[name]

    def conv(self, name: str, features: Tensor) -> Tensor:
        return conv1d(features, self[f"{name}.weight"], self[f"{name}.bias"])

    def encoder(self, source: Tensor) -> Tensor:
        for i in (1, 2, 3):
            source = torch.relu(instance_norm(self.conv(f"encoder.conv{i}", source)))
        return source


def _dsffnet(weights: _Weights, source: Tensor, target: Tensor) -> Tensor:
    """DSFFNet's equations by the names of the authors' FFAdaINModel."""
    latent = weights.encoder(source).amax(dim=2, keepdim=True).expand(-1, -1, target.shape[2])
    mixed = torch.cat([latent, target], dim=1)

    def norm(name: str, hidden: Tensor) -> Tensor:
        alpha, beta = weights[f"{name}.alpha"], weights[f"{name}.beta"]
        sigma = alpha * weights.conv(f"{name}.conv_po2", mixed) + (1 - alpha) * weights.conv(f"{name}.conv_id2", target)
        mu = beta * weights.conv(f"{name}.conv_po1", mixed) + (1 - beta) * weights.conv(f"{name}.conv_id1", target)
        return instance_norm(hidden) * sigma + mu

    hidden = target
    for i in (1, 2, 3):
        block = f"decoder.testres{i}"
        hidden = weights.conv(f"decoder.conv{i}", hidden)
        first = weights.conv(f"{block}.conv1", torch.relu(norm(f"{block}.test1", hidden)))
        hidden = first + weights.conv(f"{block}.conv2", torch.relu(norm(f"{block}.test2", first)))
    return 2 * torch.tanh(weights.conv("decoder.conv4", hidden))


def _npt(weights: _Weights, source: Tensor, target: Tensor, variant: str) -> Tensor:
    """NPT's equations by the names of the authors' modules."""
    latent = weights.encoder(source)
    if variant == "maxpool":
        latent = latent.amax(dim=2, keepdim=True).expand(-1, -1, target.shape[2])

    def norm(name: str, hidden: Tensor) -> Tensor:
        if variant == "origin" or "block1" not in name:
            hidden = instance_norm(hidden)
        return hidden * weights.conv(f"{name}.conv_weight", target) + weights.conv(f"{name}.conv_bias", target)

    hidden = torch.cat([latent, target], dim=1)
    for i in (1, 2, 3):
        block = f"decoder.spadain_block{i}"
        hidden = weights.conv(f"decoder.conv{i}", hidden)
        first = weights.conv(f"{block}.conv1", torch.relu(norm(f"{block}.spadain1", hidden)))
        second = weights.conv(f"{block}.conv2", torch.relu(norm(f"{block}.spadain2", first)))
        hidden = second + weights.conv(f"{block}.conv_res", torch.relu(norm(f"{block}.spadain_res", hidden)))
    return 2 * torch.tanh(weights.conv("decoder.conv4", hidden))


def _random(network: nn.Module) -> nn.Module:
    """Distinct values everywhere, so that no two weights can be exchanged unnoticed."""
    torch.manual_seed(3)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.3)
    return network.double()


def _dsffnet_state() -> dict[str, Tensor]:
    return to_released(_random(DSFFNet(encoder_widths=ENCODER, decoder_widths=DECODER)))


def _meshes() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    source, target = (torch.rand(2, 17, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    return source, target


def _same_function(network: nn.Module, released: Callable[..., Tensor], state: dict[str, Tensor]) -> None:
    """Both use all weights, and give the same output; columns first in the released code."""
    weights, (source, target) = _Weights(state), _meshes()
    expected = released(weights, source.transpose(1, 2), target.transpose(1, 2)).transpose(1, 2)
    assert weights.used == state.keys()
    torch.testing.assert_close(network.double()(source=source, target=target), expected, rtol=0, atol=1e-5)
    assert not network.training


def test_dsffnet_with_released_weights_is_the_released_function() -> None:
    state = _dsffnet_state()
    network = load_released_dsffnet(state)
    _same_function(network, _dsffnet, {name: value.float().double() for name, value in state.items()})


@pytest.mark.parametrize("variant", ["maxpool", "origin"])
def test_npt_with_released_weights_is_the_released_function(variant: str) -> None:
    state = to_released(_random(NPT(variant=variant, encoder_widths=ENCODER)))
    network = load_released_npt(state, variant=variant)
    _same_function(
        network,
        lambda *given: _npt(*given, variant=variant),
        {name: value.float().double() for name, value in state.items()},
    )


def test_released_sizes() -> None:
    """Shapes that the authors' modules have (their code, at its only widths)."""
    dsffnet, npt = to_released(DSFFNet()), to_released(NPT())
    assert list(dsffnet["decoder.testres2.test1.conv_po2.weight"].shape) == [1024, 1027, 1]
    assert list(dsffnet["decoder.conv2.weight"].shape) == [1024, 256, 1]
    assert list(dsffnet["decoder.testres3.test2.alpha"].shape) == [1]
    assert list(npt["decoder.spadain_block2.spadain_res.conv_weight.weight"].shape) == [513, 3, 1]
    assert list(npt["decoder.conv3.weight"].shape) == [256, 513, 1]
    assert len(dsffnet) == 2 * (3 + 4 + 3 * (2 + 2 * 4)) + 3 * 2 * 2 and len(npt) == 2 * (3 + 4 + 3 * (3 + 3 * 2))


def _prefixed(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"module.{name}": value for name, value in state.items()}


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(
    "wrapped",
    [lambda state: state, _prefixed, lambda state: {"state_dict": _prefixed(state), "epoch": 7}],
    ids=["plain", "parallel", "trainer"],
)
def test_files_of_every_wrapping_are_read(tmp_path: Path, wrapped: Callable, legacy: bool) -> None:
    """Weights of 2020 are in PyTorch's format before zip files."""
    state = _dsffnet_state()
    path = tmp_path / "model.pth"
    torch.save(wrapped(state), path, _use_new_zipfile_serialization=not legacy)
    read = to_released(load_released_dsffnet(str(path)))
    assert read.keys() == state.keys()
    for name, value in state.items():
        assert torch.equal(read[name], value.float())


def test_an_ablation_is_read_with_its_option() -> None:
    network = _random(DSFFNet(encoder_widths=ENCODER, decoder_widths=DECODER, target_side=False))
    read = load_released_dsffnet(to_released(network), target_side=False)
    assert torch.equal(
        read.decoder.block1.norm1.mixed_scale.weight.double(),
        network.decoder.block1.norm1.mixed_scale.weight.float().double(),
    )
    with pytest.raises(DsffnetError, match=r"missing: decoder\.testres1\.test1\.alpha"):
        load_released_dsffnet(to_released(network))


def test_faults_are_named_all_at_once() -> None:
    state = _dsffnet_state()
    del state["decoder.conv4.bias"]
    state["decoder.extra"] = torch.zeros(3)
    state["decoder.testres1.conv1.weight"] = torch.zeros(10, 9, 1)
    with pytest.raises(DsffnetError) as caught:
        load_released_dsffnet(state)
    for part in (
        "do not fit DSFFNet",
        "missing: decoder.conv4.bias;",
        "unknown: decoder.extra;",
        "wrong shape: decoder.testres1.conv1.weight [10, 9, 1] instead of [10, 10, 1]",
    ):
        assert part in str(caught.value)


def test_weights_of_another_network_are_refused_briefly() -> None:
    with pytest.raises(
        DsffnetError, match=r"do not fit NPT: missing: .* and \d+ more; unknown: .*testres.* more"
    ) as caught:
        load_released_npt(_dsffnet_state(), variant="maxpool")
    assert len(str(caught.value)) < 1500
    with pytest.raises(DsffnetError, match=r"missing: encoder\.conv1\.weight"):
        load_released_dsffnet({"weight": torch.zeros(3)})


class _Malicious:
    def __reduce__(self) -> tuple:
        return (Path.touch, (Path("touched"),))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: None, "cannot be read: No such file"),
        (lambda path: path.mkdir(), "cannot be read: Is a directory"),
        (lambda path: path.write_bytes(b""), "not a checkpoint"),
        (lambda path: path.write_text("v 0 0 0\n"), "not a checkpoint"),
        (lambda path: path.write_bytes(bytes(range(256)) * 9), "not a checkpoint"),
        (lambda path: torch.save(nn.Linear(2, 2), path), r"a Python object \(torch.nn.modules.linear.Linear\)"),
        (lambda path: torch.save(torch.zeros(2), path), "no weights by name, but a tensor of torch.float32"),
        (lambda path: torch.save({}, path), "no weights by name, but dict"),
        (lambda path: torch.save({"epoch": 3}, path), "no state_dict of weights: under 'epoch' there is int"),
        (
            lambda path: torch.save({"a": torch.zeros(2, dtype=torch.int64)}, path),
            "under 'a' there is a tensor of torch.int64",
        ),
    ],
)
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, write: Callable[[Path], object], message: str) -> None:
    path = tmp_path / "model.pth"
    write(path)
    with pytest.raises(DsffnetError, match=message) as caught:
        load_released_npt(path, variant="origin")
    assert "model.pth" in str(caught.value)


def test_a_truncated_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.pth"
    torch.save(_dsffnet_state(), path)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(DsffnetError, match=r"not a checkpoint of torch\.save, or it is damaged"):
        load_released_dsffnet(path)


def test_pickled_code_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("model.pth").write_bytes(pickle.dumps(_Malicious(), protocol=2))
    with pytest.raises(DsffnetError):
        load_released_dsffnet("model.pth")
    torch.save(_Malicious(), "model.pth")
    with pytest.raises(DsffnetError):
        load_released_dsffnet("model.pth")
    assert not Path("touched").exists()
