"""Size and inference time of networks (DSFFNet, Table 2), measured side by side on one pair of meshes."""

import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save
from torch import nn

from training.data.batch import Batch
from training.evaluation.evaluate import Method, require_distinct, require_pairable
from training.inference.predict import load_trained, predict

_KIBIBYTE = 1024


@dataclass(frozen=True)
class Inference:
    """What one network costs.

    Attributes
    ----------
    parameters
        Learned numbers.
    kilobytes
        A file of its weights in float32 (buffers included), in units of 1,024 bytes.
    seconds
        Median time of one pair over the rounds, weights loaded and kernels warm; meshes are where the network is.
    mean
        Mean over the rounds, which the paper states; one round that the machine was busy in weighs on it.
    fastest, slowest
        The shortest and the longest round, in seconds.
    source_vertices, target_vertices
        Of the pair.
    rounds, threads, device
        How often, on how many CPU threads of torch, and where.
    """

    parameters: int
    kilobytes: float
    seconds: float
    fastest: float
    slowest: float
    source_vertices: int
    target_vertices: int
    rounds: int
    threads: int
    device: str
    mean: float


def measure_inference(
    methods: Sequence[Method], batch: Batch, *, repeats: int = 20, warm_up: int = 3, threads: int = 1
) -> dict[str, Inference]:
    """Time one pair through each network in this process and on its CPU, the networks taking turns round by round.

    Taking turns spreads whatever else the machine does over all of them; which comes first moves on with every round.
    The call is the one that an evaluation makes (:func:`training.inference.predict.predict`), in float32.

    Parameters
    ----------
    methods
        Networks by name and weights; all are held in memory at once.
    batch
        Whose first pair is taken, without its padding.
    repeats, warm_up
        Rounds that count, and those before them that do not.
    threads
        CPU threads of torch while measuring.

    Raises
    ------
    EvaluationError
        A network cannot take the pair, or two have one name.
    CheckpointError
        Weights are missing or damaged.
    """
    require_distinct([method.name for method in methods])
    pair = _first_pair(batch)
    networks = {method.name: _loaded(method, pair) for method in methods}
    with _threads(threads):
        seconds = _interleaved(networks, pair, repeats=repeats, warm_up=warm_up)
    return {
        name: Inference(
            parameters=sum(weight.numel() for weight in network.parameters()),
            kilobytes=_kilobytes(network),
            seconds=statistics.median(seconds[name]),
            fastest=min(seconds[name]),
            slowest=max(seconds[name]),
            source_vertices=pair.source.shape[1],
            target_vertices=pair.target.shape[1],
            rounds=repeats,
            threads=threads,
            device="cpu",
            mean=statistics.fmean(seconds[name]),
        )
        for name, network in networks.items()
    }


def _loaded(method: Method, pair: Batch) -> nn.Module:
    network, recipe, _ = load_trained(Path(method.weights))
    counts = pair.source.shape[1], pair.target.shape[1]
    require_pairable(method.name, recipe.network, *counts, where="the pair that is timed")
    return network


def _first_pair(batch: Batch) -> Batch:
    pair = batch.part(0, 1)
    meshes = (pair.source, pair.source_counts), (pair.target, pair.target_counts)
    source, target = (mesh[:, : counts[0]] if counts else mesh for mesh, counts in meshes)
    told = pair.surfaces
    surfaces = told and (told[0].of(slice(1), source.shape[1]), told[1].of(slice(1), target.shape[1]))
    return Batch(source, target, target, torch.zeros(0, 2, dtype=torch.int64), surfaces=surfaces)


def _interleaved(networks: dict[str, nn.Module], pair: Batch, *, repeats: int, warm_up: int) -> dict[str, list[float]]:
    seconds: dict[str, list[float]] = {name: [] for name in networks}
    order = list(networks)
    for turn in range(-warm_up, repeats):
        for name in order:
            before = time.perf_counter()
            predict(networks[name], pair)
            if turn >= 0:
                seconds[name].append(time.perf_counter() - before)
        order = [*order[1:], *order[:1]]
    return seconds


@contextmanager
def _threads(wanted: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(wanted)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _kilobytes(network: nn.Module) -> float:
    """A safetensors file of the weights in float32, spectral norms' vectors and other buffers included."""
    weights = {
        name: value.detach().cpu().float().contiguous() if value.is_floating_point() else value.cpu()
        for name, value in network.state_dict().items()
    }
    return len(save(weights)) / _KIBIBYTE
