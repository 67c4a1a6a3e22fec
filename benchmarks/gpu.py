"""DSFFNet on one device, fast form against literal form: ``python -m benchmarks.gpu``.

Forward and training step at 6,890 vertices, batch 8 and 64, in float32, TF32 and bfloat16, plain and compiled; peak
memory; the share of the device's measured matrix rate; one pair by a CUDA graph. Needs torch alone, neither Ray nor
Zarr, so that it runs on a bare GPU machine; with ``--device cpu --vertices 200 --batches 2 --narrow`` it can be tried
anywhere.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from training.acceleration import GraphedTransfer, Precision, autocast, precision, products
from training.losses import pose_transfer_loss
from training.networks.dsffnet import DSFFNet

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "training"))
from literal_dsffnet import LiteralDSFFNet

PRECISIONS: tuple[Precision, ...] = ("float32", "tf32", "bfloat16")


def main() -> None:
    """Measure and print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--vertices", type=int, default=6890)
    parser.add_argument("--batches", type=int, nargs="+", default=[8, 64])
    parser.add_argument("--narrow", action="store_true", help="a quarter of the paper's widths")
    parser.add_argument("--compile", action="store_true", help="also the fast form through torch.compile")
    options = parser.parse_args()
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        sys.exit(
            "error: torch sees no CUDA device here. Try it on a CPU: --device cpu --vertices 200 --batches 2 --narrow"
        )
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    rates = {how: matrix_rate(how, device) for how in PRECISIONS}
    print(
        f"torch {torch.__version__}, {name}; measured matrix rates, TFLOP/s: "
        + ", ".join(f"{how} {rate:.1f}" for how, rate in rates.items())
    )
    for batch in options.batches:
        table(batch, options, device, rates)
    single_pair(options, device)


def networks(options: argparse.Namespace, device: torch.device) -> dict[str, nn.Module]:
    """Every form with the same weights."""
    torch.manual_seed(0)
    widths = {"encoder_widths": (16, 32, 256), "decoder_widths": (64, 256, 64)} if options.narrow else {}
    fast = DSFFNet(**widths).to(device)
    found: dict[str, nn.Module] = {"literal": LiteralDSFFNet(fast).to(device), "fast": fast}
    if options.compile:
        found["compiled"] = torch.compile(fast, dynamic=False)  # type: ignore[assignment]
    return found


def table(batch: int, options: argparse.Namespace, device: torch.device, rates: dict[Precision, float]) -> None:
    """One batch size: every form in every precision."""
    print(f"\nbatch {batch} x {options.vertices:,} vertices")
    print("  milliseconds (times faster than the literal float32 form), GiB at the peak, share of the ceiling")
    literal: dict[str, float] = {}
    forms = networks(options, device)
    work = 2.0 * options.vertices * batch * multiplications(forms["fast"])
    for form, network in forms.items():
        torch._dynamo.reset()
        for how in PRECISIONS:
            cells = []
            for what, times in (("forward", 1), ("step", 3)):
                try:
                    seconds, gibibytes = measure(what, network, how, batch, options.vertices, device)
                except torch.OutOfMemoryError:
                    cells.append(f"{what}: out of memory")
                    continue
                if form == "literal":
                    literal[what] = seconds
                ratio = literal[what] / seconds if what in literal else float("nan")
                share = times * work / seconds / (rates[how] * 1e12)
                cells.append(f"{what} {1e3 * seconds:9.2f} ({ratio:5.2f}x) {gibibytes:6.2f} {share:6.1%}")
            print(f"  {form:9}{how:9} {'   '.join(cells)}", flush=True)


def multiplications(network: nn.Module) -> int:
    """Multiplications a vertex of the target in the equations' wide layers: useful work, not what a form executes.

    Merging layers leaves the fast form some 30 % fewer, so its share of the ceiling can pass what its products reach.
    """
    weights = {name: value for name, value in network.state_dict().items() if value.ndim >= 2 and "decoder" in name}
    wide = [value for name, value in weights.items() if not any(part in name for part in ("identity", "mixed", "norm"))]
    return sum(value.shape[0] * value.shape[1] for value in wide)


def measure(
    what: str, network: nn.Module, how: Precision, batch: int, vertices: int, device: torch.device
) -> tuple[float, float]:
    """Seconds of one call (the least of several) and the peak memory in GiB."""
    source, target, truth = (torch.rand(batch, vertices, 3, device=device) * 2 - 1 for _ in range(3))
    edges = torch.randint(vertices, (3 * vertices, 2), device=device)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-6)

    def forward() -> None:
        with torch.no_grad(), precision(how, device):
            network(source=source, target=target)

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        with products(how):
            with autocast(how, device):
                prediction = network(source=source, target=target)
            pose_transfer_loss(prediction, truth, edges)[0].backward()
        optimiser.step()

    work = forward if what == "forward" else step
    for _ in range(3):
        work()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    seconds = min(timed(work, device) for _ in range(10 if device.type == "cuda" else 2))
    peak = torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else float("nan")
    return seconds, peak


def timed(work: Callable[[], None], device: torch.device) -> float:
    """Seconds of one call, the device's work included."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    start = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def matrix_rate(how: Precision, device: torch.device) -> float:
    """TFLOP/s of a large product in a precision: the ceiling."""
    size = 8192 if device.type == "cuda" else 1024
    left, right = (torch.rand(size, size, device=device) for _ in range(2))

    def work() -> None:
        with precision(how, device):
            left @ right

    work()
    return 2 * size**3 / min(timed(work, device) for _ in range(5)) / 1e12


@torch.no_grad()
def single_pair(options: argparse.Namespace, device: torch.device) -> None:
    """One pair at a time: the network called, and replayed."""
    fast = networks(options, device)["fast"].eval()
    source, target = (torch.rand(1, options.vertices, 3, device=device) * 2 - 1 for _ in range(2))
    print(f"\none pair of {options.vertices:,} vertices, milliseconds")
    for how in PRECISIONS:
        for form, call in calls(fast, how, source, target, device):
            for _ in range(3):
                call()
            print(f"  {form:9}{how:9} {1e3 * min(timed(call, device) for _ in range(20)):8.3f}", flush=True)


def calls(
    network: nn.Module, how: Precision, source: Tensor, target: Tensor, device: torch.device
) -> Iterator[tuple[str, Callable[[], None]]]:
    """The network as it is, and by a CUDA graph."""

    def called() -> None:
        with precision(how, device):
            network(source=source, target=target)

    yield "called", called
    if device.type == "cuda":
        graphed = GraphedTransfer(network, precision=how)

        def replayed() -> None:
            graphed(source=source, target=target)

        yield "replayed", replayed


if __name__ == "__main__":
    main()
