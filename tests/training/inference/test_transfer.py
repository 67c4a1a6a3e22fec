"""Predicting and transferring call the network the same way, on a CPU and on a GPU."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.support.shapes.avatars import sphere
from tests.support.three_networks import lively
from training.data.batch import Batch
from training.inference import transfer
from training.inference.predict import predict
from training.inference.standing import Standing
from training.inference.transfer import PoseTransfer
from training.networks import NETWORKS
from training.networks import execution as acceleration

NO_EDGES = torch.zeros(0, 2, dtype=torch.int64)


@pytest.fixture
def network() -> nn.Module:
    torch.manual_seed(0)
    return NETWORKS["dsffnet"](encoder_widths=(16, 32, 64), decoder_widths=(32, 64, 32)).eval()


def meshes_of(batch: int, seed: int = 1) -> dict[str, Tensor]:
    random = torch.Generator().manual_seed(seed)
    return {name: torch.rand(batch, count, 3, generator=random) * 2 - 1
            for name, count in (("source", 90), ("target", 70))}  # fmt: skip


def test_a_way_to_stand_that_is_told_may_be_of_another_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its root is not believed then, that of a mesh that was looked at here is."""
    body, known, real = sphere(subdivisions=2), list[bool](), transfer.facing

    def watched(understand: Any, vertices: Any, before: Any) -> Any:
        known.append(isinstance(before, Standing) and before.root is not None)
        return real(understand, vertices, before)

    monkeypatch.setattr(transfer, "facing", watched)
    posing = PoseTransfer(lively("parts"))
    found = posing.standing(body)
    posing(source=body, target=body)
    posing(source=body, target=body, source_axes=found, target_axes=found)
    assert known == [True, True, False, False]


@torch.no_grad()
def test_predicting_on_a_cpu_is_calling_the_network(network: nn.Module) -> None:
    meshes = meshes_of(10)
    expected = torch.cat([network(**{name: mesh[part] for name, mesh in meshes.items()})
                          for part in (slice(0, 8), slice(8, 10))])  # fmt: skip
    assert torch.equal(predict(network, Batch(**meshes, truth=meshes["target"], edges=NO_EDGES)), expected)


def test_a_transfer_runs_where_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    placed = []
    network = SimpleNamespace(to=lambda device: placed.append(str(device)) or nn.Linear(1, 1))
    monkeypatch.setattr(transfer, "load_trained", lambda run: (network, None, 0))
    for there in (True, False):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        PoseTransfer.from_run(Path("run"))
    PoseTransfer.from_run(Path("run"), device="cuda:1")
    assert placed == ["cuda", "cpu", "cuda:1"]


@pytest.mark.gpu
@torch.no_grad()
def test_predicting_a_single_pair_on_a_gpu_is_replayed_and_the_same(network: nn.Module) -> None:
    for seed in range(4):
        meshes = {name: mesh.cuda() for name, mesh in meshes_of(1, seed).items()}
        found = predict(network.cuda(), Batch(**meshes, truth=meshes["target"], edges=NO_EDGES))
        assert torch.allclose(found, network(**meshes), atol=1e-5)
    assert any(acceleration._GRAPHS[network].values())


@pytest.mark.gpu
def test_a_transfer_on_a_gpu_gives_what_it_gives_on_a_cpu(network: nn.Module) -> None:
    pairs = [{name: mesh[0].numpy() for name, mesh in meshes_of(1, seed).items()} for seed in range(4)]
    expected = [PoseTransfer(network).vertices(**each) for each in pairs]
    on_gpu = PoseTransfer(network.cuda())
    for each, known in zip(pairs, expected, strict=True):
        assert abs(on_gpu.vertices(**each) - known).max() < 1e-5
    assert any(acceleration._GRAPHS[network].values())
