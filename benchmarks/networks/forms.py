"""The networks, fast against literal form, on a CPU: ``python -m benchmarks.networks.forms [--threads 2] [--quick]``.

Every form has the same weights and inputs and all run in turns, so that a slow moment of the machine hits all; times
are medians. Forward passes are timed before any backward pass, which leaves warm memory behind that a process which
only transfers poses never has; the paper's widths are therefore first. A step is forward, both losses, backward and
AdamW. "Off by" is measured before any step: the largest difference of any output coordinate from the literal form's,
and the length of the difference of the whole gradient over the length of the literal form's (where both name their
parameters alike). Memory is the peak of a process of its own over what it held before the step.
"""

from __future__ import annotations

import argparse
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.networks.running import (
    Meshes,
    forward,
    gradient,
    largest,
    random_meshes,
    relative,
    step,
    with_every_branch,
)
from benchmarks.peak_memory import forget_peak, peak_mebibytes
from training.networks.corenet3d import CoreNet3D
from training.networks.dsffnet import DSFFNet
from training.networks.execution import Precision
from training.networks.npt import NPT
from training.objectives.losses import transfer_loss

# isort: split
from tests.literal.corenet3d import LiteralCoreNet3D
from tests.literal.dsffnet import LiteralDSFFNet
from tests.literal.npt import LiteralNPT


class Case(NamedTuple):
    make: Callable[[], nn.Module]
    literal: Callable[[nn.Module], nn.Module]
    batch: int
    vertices: int
    repeats: int


CASES = {
    "DSFFNet": Case(DSFFNet, LiteralDSFFNet, 2, 6890, 3),
    "NPT": Case(NPT, LiteralNPT, 2, 6890, 3),
    "3D-CoreNet": Case(CoreNet3D, LiteralCoreNet3D, 2, 1229, 3),
    "DSFFNet, quickstart": Case(
        lambda: DSFFNet(encoder_widths=(64, 128, 256), decoder_widths=(64, 256, 64)), LiteralDSFFNet, 4, 615, 15
    ),
}
FORMS: dict[str, Precision] = {"literal": "float32", "fast": "float32", "fast bf16": "bfloat16"}
CPU = torch.device("cpu")


def main() -> None:
    """Measure and print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="small shapes only, a few times")
    parser.add_argument(
        "--memory", metavar="FORM", choices=FORMS, help="only the peak memory of a step of this form, in MiB"
    )
    parser.add_argument("--vertices", type=int, default=6890, help="of --memory (6890)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.memory:
        print(peak_of_a_step(options.memory, options.vertices))
        return
    print(f"torch {torch.__version__}, CPU, {options.threads} threads, milliseconds (times faster than literal)")
    smallest = list(CASES)[-1]
    for name, case in {smallest: CASES[smallest]._replace(repeats=3)}.items() if options.quick else CASES.items():
        show(name, case)
    if not options.quick:
        memory()


def show(name: str, case: Case) -> None:
    """One network's table."""
    print(f"\n{name}, {case.batch} x {case.vertices:,} vertices", flush=True)
    torch.manual_seed(0)
    fast = with_every_branch(case.make())
    forms = {"literal": case.literal(fast), "fast": fast, "fast bf16": fast}
    meshes = random_meshes(case.batch, case.vertices, CPU)
    times = {"forward": forward_times(forms, meshes, 2 * case.repeats)}
    differences = compare(forms, meshes)
    times |= step_times(forms, meshes, case.repeats)
    for what, unit in (("forward", ""), ("step", " of the gradient")):
        print(f"  {what:9}{'   '.join(cells(times[what], differences[what], unit))}")
    losses = times["losses"]["both"]
    shares = [f"{losses / times['step'][form]:.1%} of the step of {form}" for form in forms]
    print(f"  losses   {1e3 * losses:,.1f}: {', '.join(shares)}")


def cells(times: dict[str, float], differences: dict[str, float], unit: str) -> list[str]:
    """Time, ratio and difference of every form."""
    literal = times["literal"]
    known = {form: f", off by {off:.1e}{unit}" for form, off in differences.items() if not math.isnan(off)}
    ratios = {form: f" ({literal / times[form]:.1f}x{known.get(form, '')})" for form in differences}
    return [f"{form} {1e3 * taken:,.1f}{ratios.get(form, '')}" for form, taken in times.items()]


def compare(forms: dict[str, nn.Module], meshes: Meshes) -> dict[str, dict[str, float]]:
    """The largest difference of any output coordinate from the literal form's, and the gradient's relative one."""
    outputs, gradients = {}, {}
    for form, network in forms.items():
        network.eval()  # 3D-CoreNet's spectral norms advance at every call in training mode
        outputs[form] = forward(network, FORMS[form], meshes)
        gradients[form] = gradient(network, FORMS[form], meshes)
        network.train()
    others = [form for form in forms if form != "literal"]
    return {
        "forward": {form: largest(outputs[form], outputs["literal"]) for form in others},
        "step": {form: relative(gradients[form], gradients["literal"]) for form in others},
    }


def forward_times(forms: dict[str, nn.Module], meshes: Meshes, repeats: int) -> dict[str, float]:
    """Seconds of an inference (medians) by form, in a process that has made no backward pass of this size."""
    times: dict[str, list[float]] = {}
    for repeat in range(repeats + 1):
        for form, network in forms.items():
            keep(times, form, repeat, partial(forward, network.eval(), FORMS[form], meshes))
            network.train()
    return {form: statistics.median(taken) for form, taken in times.items()}


def step_times(forms: dict[str, nn.Module], meshes: Meshes, repeats: int) -> dict[str, dict[str, float]]:
    """Seconds (medians) of a step by form, and of both losses."""
    optimisers = {form: torch.optim.AdamW(network.parameters(), lr=1e-6) for form, network in forms.items()}
    times: dict[str, dict[str, list[float]]] = {"step": {}, "losses": {}}
    moved = (meshes.truth * 0.9).requires_grad_()
    for repeat in range(repeats + 1):
        for form, network in forms.items():
            keep(times["step"], form, repeat, partial(step, network, FORMS[form], optimisers[form], meshes))
        keep(times["losses"], "both", repeat, partial(both_losses, moved, meshes))
    return {what: {form: statistics.median(taken) for form, taken in found.items()} for what, found in times.items()}


def both_losses(moved: Tensor, meshes: Meshes) -> None:
    """Both losses of a prediction, and their gradients."""
    transfer_loss(moved, truth=meshes.truth, target=meshes.target, edges=meshes.edges)[0].backward()


def keep(times: dict[str, list[float]], form: str, repeat: int, work: Callable[[], object]) -> None:
    """Time one call; the first is for warming up."""
    start = time.perf_counter()
    work()
    if repeat:
        times.setdefault(form, []).append(time.perf_counter() - start)


def peak_of_a_step(form: str, vertices: int) -> float:
    """MiB that a step of batch 8 takes over what was held before."""
    network: nn.Module = DSFFNet()
    if form == "literal":
        network = LiteralDSFFNet(network)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-6)
    step(network, FORMS[form], optimiser, random_meshes(1, 50, CPU))
    meshes = random_meshes(8, vertices, CPU)
    forget_peak()
    before = peak_mebibytes()
    step(network, FORMS[form], optimiser, meshes)
    return peak_mebibytes() - before


def memory() -> None:
    """Peak memory of a training step of each form, each in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.networks.forms", "--memory"]
    peaks = {
        form: float(subprocess.run([*command, form], capture_output=True, text=True, check=True).stdout)
        for form in FORMS
    }
    print("\nDSFFNet, peak memory of a step, 8 x 6,890 vertices")
    for form, peak in peaks.items():
        print(f"  {form:10}{peak:9,.0f} MiB   {peak / peaks['literal']:.2f} of the literal form's")


if __name__ == "__main__":
    main()
