"""DSFFNet, fast form against literal form: ``python benchmarks/networks.py [--shape quickstart|full] [--device cuda]``.

Both forms have the same weights and inputs and run in turns, so that a slow moment of the machine hits both; times are
medians. A step is forward, both losses and backward, without the optimiser.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from training.losses import pose_transfer_loss
from training.networks.dsffnet import DSFFNet

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "training"))
from literal_dsffnet import LiteralDSFFNet


class Shape(NamedTuple):
    encoder: tuple[int, int, int]
    decoder: tuple[int, int, int]
    batch: int
    vertices: int
    repeats: int


SHAPES = {
    "quickstart": Shape((64, 128, 256), (64, 256, 64), 4, 615, 20),
    "full": Shape((64, 128, 1024), (256, 1024, 256), 2, 6890, 3),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shape", choices=SHAPES, action="append", help="default: all")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"torch {torch.__version__}, {options.device}, {options.threads} thread(s), float32, milliseconds")
    print(f"{'shape':12}{'':9}{'literal':>10}{'fast':>10}{'ratio':>8}")
    for name in options.shape or SHAPES:
        for what, times in measure(SHAPES[name], torch.device(options.device)).items():
            literal, fast = (1e3 * statistics.median(times[form]) for form in ("literal", "fast"))
            print(f"{name:12}{what:9}{literal:10.1f}{fast:10.1f}{literal / fast:8.2f}")


def measure(shape: Shape, device: torch.device) -> dict[str, dict[str, list[float]]]:
    """Return the seconds of every repetition, by what is done and by which form."""
    torch.manual_seed(0)
    fast = DSFFNet(encoder_widths=shape.encoder, decoder_widths=shape.decoder)
    forms = {"literal": LiteralDSFFNet(fast).to(device), "fast": fast.to(device)}
    source, target, truth = (torch.rand(shape.batch, shape.vertices, 3, device=device) * 2 - 1 for _ in range(3))
    edges = torch.randint(shape.vertices, (3 * shape.vertices, 2), device=device)
    work: dict[str, Callable[[nn.Module], None]] = {
        "forward": lambda network: forward(network, source, target),
        "step": lambda network: step(network, source, target, truth, edges),
    }
    times: dict[str, dict[str, list[float]]] = {what: {form: [] for form in forms} for what in work}
    for _ in range(shape.repeats + 1):
        for what, function in work.items():
            for form, network in forms.items():
                times[what][form].append(timed(function, network, device))
    return {what: {form: taken[1:] for form, taken in row.items()} for what, row in times.items()}


def timed(function: Callable[[nn.Module], None], network: nn.Module, device: torch.device) -> float:
    start = time.perf_counter()
    function(network)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


@torch.no_grad()
def forward(network: nn.Module, source: Tensor, target: Tensor) -> None:
    network(source=source, target=target)


def step(network: nn.Module, source: Tensor, target: Tensor, truth: Tensor, edges: Tensor) -> None:
    network.zero_grad(set_to_none=True)
    pose_transfer_loss(network(source=source, target=target), truth, edges)[0].backward()


if __name__ == "__main__":
    main()
