"""DSFFNet on one device, fast form against literal form: ``python -m benchmarks.networks.gpu``.

First whether the device computes what a CPU does and what rounding costs; then one pair at a time, called and by CUDA
graph; then forward and training step of whole batches, in float32, TF32 and bfloat16: literal, fast, and fast through
torch.compile. Beside each time: the ratio to the literal float32 form, the memory at the peak less what was held before
(weights, inputs, the optimiser's state), the share of the measured matrix rate, and how far the result is off the
literal float32 form's: the largest difference of any output coordinate, the relative one of the whole gradient. What
fails is said in its place and the rest is measured; the exit status is then 1.

Needs torch and NumPy alone, so that it runs on a bare GPU machine. ``--device cpu --vertices 200 --batches 2 --narrow``
tries it anywhere.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.networks.running import (
    Meshes,
    forward,
    gradient,
    largest,
    mean_square,
    random_meshes,
    relative,
    step,
    with_every_branch,
)
from benchmarks.timing import copy_rate, matrix_rate, measured, release, timed
from training.networks.dsffnet import DSFFNet
from training.networks.execution import GraphedTransfer, Precision, compiled

# isort: split
from tests.literal.dsffnet import LiteralDSFFNet

PRECISIONS: tuple[Precision, ...] = ("float32", "tf32", "bfloat16")
NARROW = {"encoder_widths": (16, 32, 256), "decoder_widths": (64, 256, 64)}
failures: list[str] = []


class Reference(NamedTuple):
    """The literal form in float32: what the other forms are compared with."""

    result: Any
    seconds: float


def main() -> int:
    """Measure and print everything; the exit status is 1 if anything failed."""
    failures.clear()
    options = arguments()
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        sys.exit(
            "error: torch sees no CUDA device here. Try it on a CPU: --device cpu --vertices 200 --batches 2 --narrow"
        )
    options.forms = ("literal", "fast", "compiled") if options.compile else ("literal", "fast")
    options.deadline = time.monotonic() + 60 * options.minutes
    rates = {how: matrix_rate(how, device) for how in options.precisions}
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"torch {torch.__version__}, Python {sys.version.split()[0]}, {name}")
    print(f"matrix rates, TFLOP/s: {', '.join(f'{how} {rate:.2f}' for how, rate in rates.items())}", end="; ")
    print(f"copying {copy_rate(device):,.0f} GB/s read and written", flush=True)
    parity(options, device)
    single_pairs(options, device)
    for batch in options.batches:
        table(batch, options, device, rates)
    return 1 if failures else 0


def arguments() -> argparse.Namespace:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--vertices", type=int, default=6890)
    parser.add_argument("--batches", type=int, nargs="*", default=[8, 64])
    parser.add_argument("--precisions", nargs="+", choices=PRECISIONS, default=PRECISIONS)
    parser.add_argument("--narrow", action="store_true", help="a quarter of the paper's widths")
    parser.add_argument(
        "--compile", action=argparse.BooleanOptionalAction, default=True, help="also the fast form by torch.compile"
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="begin nothing more after so many minutes")
    return parser.parse_args()


def form_of(name: str, options: argparse.Namespace, device: torch.device) -> nn.Module:
    """One form of the network; the weights are always the same."""
    torch.manual_seed(0)
    fast = with_every_branch(DSFFNet(**(NARROW if options.narrow else {})))
    network = LiteralDSFFNet(fast) if name == "literal" else fast
    network.to(device)
    return compiled(network, device) if name == "compiled" else network


def parity(options: argparse.Namespace, device: torch.device) -> None:
    """How far outputs and gradients are apart on two meshes, without torch.compile."""
    print(f"\nparity, batch 2 x {options.vertices:,} vertices: largest difference, PMD, gradient")
    pairs: list[tuple[str, str, Precision, torch.device]] = [("fast", "fast", "float32", torch.device("cpu"))]
    pairs += [("fast", "literal", "float32", device), ("literal", "literal", "float32", torch.device("cpu"))]
    for form, other, how, where in pairs:
        attempt(f"  {form} on {device.type} and {other} on {where.type}", compare, options, (form, how, device),
                (other, how, where))  # fmt: skip
    for how in [name for name in options.precisions if name != "float32"]:
        for form in ("fast", "literal"):
            attempt(f"  {form} in {how} and in float32", compare, options, (form, how, device),
                    (form, "float32", device))  # fmt: skip


def compare(options: argparse.Namespace, *sides: tuple[str, Precision, torch.device]) -> str:
    """The differences of two forms, each (name, precision, device)."""
    outputs, gradients = [], []
    for name, how, device in sides:
        network, meshes = form_of(name, options, device), random_meshes(2, options.vertices, device)
        outputs.append(forward(network, how, meshes).cpu())
        gradients.append(gradient(network, how, meshes))
    return f"{largest(*outputs):.1e}   {mean_square(*outputs):.1e}   {relative(*gradients):.1e}"


def single_pairs(options: argparse.Namespace, device: torch.device) -> None:
    """One pair at a time: every form in every precision, called and replayed."""
    print(f"\none pair of {options.vertices:,} vertices, milliseconds: least, median (off fast float32 by)", flush=True)
    meshes = random_meshes(1, options.vertices, device)
    exact = forward(form_of("fast", options, device), "float32", meshes)
    for how in options.precisions:
        for form in options.forms:
            attempt(f"  {form:9}{how:9}", late(single_pair, options), form, how, meshes, exact, options)
            release(device)


def single_pair(form: str, how: Precision, meshes: Meshes, exact: Tensor, options: argparse.Namespace) -> str:
    """One form in one precision."""
    device = meshes.source.device
    network = form_of(form, options, device).eval()
    cells = []
    for way, kept in (("called", 0), ("replayed", 8))[: 2 if device.type == "cuda" else 1]:
        transfer = GraphedTransfer(network, precision=how, kept=kept)  # which without room for graphs only calls
        call = partial(transfer, source=meshes.source, target=meshes.target)
        off = max(largest(call(), exact) for _ in range(3))
        taken = sorted(timed(call, device) for _ in range(50 if device.type == "cuda" else 2))
        cells.append(f"{way} {1e3 * taken[0]:8.3f} {1e3 * taken[len(taken) // 2]:8.3f} ({off:.1e})")
    return "   ".join(cells)


def table(batch: int, options: argparse.Namespace, device: torch.device, rates: dict[Precision, float]) -> None:
    """One batch size: every form in every precision, forward and step."""
    print(f"\nbatch {batch} x {options.vertices:,} vertices")
    print("  milliseconds (times faster than literal float32), GiB, share of the matrix rate, off by", flush=True)
    meshes = random_meshes(batch, options.vertices, device)
    work = 2.0 * options.vertices * batch * multiplications(form_of("fast", options, torch.device("cpu")))
    references: dict[str, Reference] = {}
    for form in options.forms:
        for how in options.precisions:
            least = {"forward": work / (rates[how] * 1e12), "step": 3 * work / (rates[how] * 1e12)}
            for what, seconds in least.items():
                label = f"  {what:8}{form:9}{how:9}"
                attempt(label, late(cell, options), what, form, how, meshes, options, seconds, references)
                release(device)


def cell(
    what: str,
    form: str,
    how: Precision,
    meshes: Meshes,
    options: argparse.Namespace,
    least: float,
    references: dict[str, Reference],
) -> str:
    """Forward or step of one form in one precision; `least` is the seconds that its products take at best."""
    device = meshes.source.device
    network = form_of(form, options, device)
    result, off = results(what, network, how, meshes), float("nan")
    seconds, gibibytes = measured(work_of(what, network, how, meshes), device)
    if (form, how) == ("literal", "float32"):
        references[what] = Reference(result, seconds)
    ratio = float("nan")
    if what in references:
        exact = references[what]
        ratio = exact.seconds / seconds
        off = largest(result, exact.result) if what == "forward" else relative(result, exact.result)
    return f"{1e3 * seconds:9.2f} ({ratio:5.2f}x) {gibibytes:7.2f} {least / seconds:6.1%}   {off:.1e}"


def results(what: str, network: nn.Module, how: Precision, meshes: Meshes) -> Any:
    """The output, or the gradients."""
    return forward(network, how, meshes).cpu() if what == "forward" else gradient(network, how, meshes)


def work_of(what: str, network: nn.Module, how: Precision, meshes: Meshes) -> Callable[[], object]:
    """What is timed."""
    if what == "forward":
        return partial(forward, network, how, meshes)
    return partial(step, network, how, torch.optim.AdamW(network.parameters(), lr=1e-6), meshes)


def late(work: Callable[..., str], options: argparse.Namespace) -> Callable[..., str]:
    """`work`, unless the time is up."""
    return work if time.monotonic() < options.deadline else lambda *_: "left out: the minutes are up"


def attempt(label: str, work: Callable[..., str], *arguments: object) -> None:
    """Print a line; what fails must not cost the lines after it."""
    try:
        print(f"{label} {work(*arguments)}", flush=True)
    except torch.OutOfMemoryError:
        print(f"{label} out of memory", flush=True)
    except Exception as error:
        failures.append(label)
        print(f"{label} failed: {type(error).__name__}: {str(error).splitlines()[0]}", flush=True)
        traceback.print_exc()


def multiplications(network: nn.Module) -> int:
    """Multiplications a vertex of the target in the equations' wide layers: useful work, not what a form executes.

    Merging layers leaves the fast form some 30 % fewer, so its share of the ceiling can pass what its products reach.
    """
    weights = {name: value for name, value in network.state_dict().items() if value.ndim >= 2 and "decoder" in name}
    wide = [value for name, value in weights.items() if not any(part in name for part in ("identity", "mixed", "norm"))]
    return sum(value.shape[0] * value.shape[1] for value in wide)


if __name__ == "__main__":
    sys.exit(main())
