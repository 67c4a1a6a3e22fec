"""Size and time of networks: what is counted, fairly, and refused."""

from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.common.errors import CheckpointError, EvaluationError
from datagen.store import open_dataset
from tests.support.recipes import mixed_dataset, tiny_training
from training.checkpoints.checkpoint import export_weights, require_checkpoint
from training.data.batch import Batch, read_batch
from training.engine.trainer import train
from training.evaluation import timing as inference_time
from training.evaluation.evaluate import Method
from training.evaluation.timing import measure_inference
from training.inference.predict import load_trained

NETWORKS = {
    "DSFFNet": {"encoder_widths": (8, 8, 8), "decoder_widths": (8, 8, 8)},
    "NPT origin": {"name": "npt", "variant": "origin", "encoder_widths": (8, 8, 13)},
    "3D-CoreNet": {"name": "corenet3d", "feature_widths": (8, 8, 8), "generator_widths": (16, 16, 16)},
}


def pair(vertices: int) -> Batch:
    """Random points: no network does more work for one mesh than for another of its size."""
    source, target = torch.rand(2, 1, vertices, 3) * 2 - 1
    return Batch(source, target, target, torch.zeros(0, 2, dtype=torch.int64))


@pytest.fixture(scope="module")
def methods(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Method]:
    folder = tmp_path_factory.mktemp("runs")
    for name, network in NETWORKS.items():
        train(tiny_training(network=network, steps=1), data=str(_pristine), run=folder / name)
    return [Method(name, str(folder / name)) for name in NETWORKS]


def test_sizes_are_those_of_the_files_that_an_export_in_float32_writes(methods: list[Method], tmp_path: Path) -> None:
    found = measure_inference(methods, pair(40), repeats=2, warm_up=0)
    assert list(found) == list(NETWORKS)
    for method in methods:
        network = load_trained(Path(method.weights))[0]
        export_weights(require_checkpoint(Path(method.weights)), tmp_path / "exported")
        written = (tmp_path / "exported" / "weights.safetensors").stat().st_size
        cost = found[method.name]
        assert cost.parameters == sum(weight.numel() for weight in network.parameters())
        assert cost.kilobytes * 1024 > 4 * cost.parameters
        assert 0 <= written - cost.kilobytes * 1024 < 6000, (
            "the file says in its header what it is; the rest is weights"
        )


def test_half_precision_files_count_as_what_they_are_loaded_as(methods: list[Method], tmp_path: Path) -> None:
    export_weights(require_checkpoint(Path(methods[0].weights)), tmp_path / "half", dtype=torch.bfloat16)
    both = [methods[0], Method("half", str(tmp_path / "half"))]
    found = measure_inference(both, pair(20), repeats=1)
    assert found["half"].kilobytes == found["DSFFNet"].kilobytes


def test_rounds_take_turns_and_the_median_leaves_out_the_warm_up(
    methods: list[Method], monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[str] = []
    clock = iter(np.arange(1000))

    def predict(network: torch.nn.Module, batch: object) -> None:
        called.append(type(network).__name__)
        if len(called) == 3 * 2 + 2:  # in the first round that counts, something held up the second network
            for _ in range(50):
                next(clock)

    monkeypatch.setattr(inference_time, "predict", predict)
    monkeypatch.setattr(inference_time.time, "perf_counter", lambda: float(next(clock)))
    found = measure_inference(methods, pair(30), repeats=3, warm_up=2)
    rounds = [called[start : start + 3] for start in range(0, len(called), 3)]
    assert len(rounds) == 5 and all(set(each) == set(called) for each in rounds)
    assert len({each[0] for each in rounds}) == 3, "each network is first in some round"
    assert {cost.seconds for cost in found.values()} == {1.0}
    assert sorted(cost.slowest for cost in found.values()) == [1.0, 1.0, 51.0]
    assert sorted(cost.mean for cost in found.values()) == pytest.approx([1.0, 1.0, 53 / 3])


def test_it_says_what_was_measured_and_leaves_the_threads_as_they_were(methods: list[Method]) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    cost = measure_inference(methods[:1], pair(50), repeats=2, threads=1)["DSFFNet"]
    after = torch.get_num_threads()
    torch.set_num_threads(before)
    assert (cost.source_vertices, cost.target_vertices) == (50, 50)
    assert (cost.rounds, cost.threads, cost.device) == (2, 1, "cpu")
    assert 0 < cost.fastest <= cost.seconds <= cost.slowest < 5
    assert after == 2


def test_more_vertices_take_more_time(methods: list[Method]) -> None:
    few, many = (measure_inference(methods[:1], pair(n), repeats=5, threads=1)["DSFFNet"] for n in (100, 50_000))
    assert many.fastest > 3 * few.fastest


def test_the_first_pair_of_a_batch_is_taken_without_its_padding(methods: list[Method], tmp_path: Path) -> None:
    from datagen.generate import generate

    data = open_dataset(generate(mixed_dataset(), str(tmp_path / "mixed.zarr")).url)
    batch = read_batch(data, np.array([[0, 0, 1, 1], [1, 0, 0, 1]]), padded=True)
    cost = measure_inference([methods[0]], batch, repeats=1)["DSFFNet"]
    assert (cost.source_vertices, cost.target_vertices) == (32, 30)
    with pytest.raises(EvaluationError, match=r"NPT origin pairs.*the pair that is timed has a source of 32"):
        measure_inference(methods, batch, repeats=1)


def test_what_cannot_be_measured_is_refused(methods: list[Method], tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="two methods are called 'NPT origin'"):
        measure_inference([methods[1], methods[1]], pair(10))
    with pytest.raises(CheckpointError, match="no usable checkpoint"):
        measure_inference([Method("nothing", str(tmp_path / "nothing"))], pair(10))
