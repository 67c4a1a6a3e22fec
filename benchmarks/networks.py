"""The networks, fast form against literal form, on a CPU: ``python -m benchmarks.networks [--threads 2] [--quick]``.

Every form has the same weights and inputs and all run in turns, so that a slow moment of the machine hits all; times
are medians. A step is forward, both losses, backward and AdamW. Memory is the peak of a process of its own over what it
held before the step.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.peak_memory import forget_peak, peak_mebibytes
from training.acceleration import Precision, autocast, precision, products
from training.losses import pose_transfer_loss
from training.networks.corenet3d import CoreNet3D
from training.networks.dsffnet import DSFFNet
from training.networks.npt import NPT

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "training"))
from literal_corenet3d import LiteralCoreNet3D
from literal_dsffnet import LiteralDSFFNet
from literal_npt import LiteralNPT


class Case(NamedTuple):
    make: Callable[[], nn.Module]
    literal: Callable[[nn.Module], nn.Module]
    batch: int
    vertices: int
    repeats: int


CASES = {
    "DSFFNet, quickstart": Case(
        lambda: DSFFNet(encoder_widths=(64, 128, 256), decoder_widths=(64, 256, 64)), LiteralDSFFNet, 4, 615, 15
    ),
    "DSFFNet": Case(DSFFNet, LiteralDSFFNet, 2, 6890, 3),
    "NPT": Case(NPT, LiteralNPT, 2, 6890, 3),
    "3D-CoreNet": Case(CoreNet3D, LiteralCoreNet3D, 2, 1229, 3),
}
FORMS: dict[str, Precision] = {"literal": "float32", "fast": "float32", "fast bf16": "bfloat16"}
CPU = torch.device("cpu")


def main() -> None:
    """Measure and print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="small shapes only")
    parser.add_argument("--memory", metavar="FORM", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.memory:
        print(peak_of_a_step(options.memory))
        return
    print(f"torch {torch.__version__}, CPU, {options.threads} threads, milliseconds (times faster than literal)")
    for name in list(CASES)[:1] if options.quick else CASES:
        show(name, CASES[name])
    if not options.quick:
        memory()


def show(name: str, case: Case) -> None:
    """One network's table."""
    print(f"\n{name}, {case.batch} x {case.vertices:,} vertices")
    for what, times in measure(case).items():
        middle = {form: 1e3 * statistics.median(taken) for form, taken in times.items()}
        literal = middle.get("literal")
        cells = [
            f"{form} {value:,.1f}" + (f" ({literal / value:.1f}x)" if literal else "") for form, value in middle.items()
        ]
        print(f"  {what:9}{'   '.join(cells)}")


def measure(case: Case) -> dict[str, dict[str, list[float]]]:
    """Seconds of every repetition, by what is done and by which form."""
    torch.manual_seed(0)
    fast = case.make()
    forms = {"literal": case.literal(fast), "fast": fast, "fast bf16": fast}
    source, target, truth, edges = inputs(case.batch, case.vertices)
    optimisers = {form: torch.optim.AdamW(network.parameters(), lr=1e-6) for form, network in forms.items()}
    times: dict[str, dict[str, list[float]]] = {"forward": {}, "step": {}, "losses": {"fast": []}}
    for repeat in range(case.repeats + 1):
        for form, network in forms.items():
            for what, work in (
                ("forward", lambda n=network, f=form: forward(n, FORMS[f], source, target)),
                ("step", lambda n=network, f=form: step(n, FORMS[f], optimisers[f], source, target, truth, edges)),
            ):
                keep(times[what].setdefault(form, []), work, repeat)
        moved = truth.clone().requires_grad_()
        keep(times["losses"]["fast"], lambda m=moved: pose_transfer_loss(m, truth * 0.9, edges)[0].backward(), repeat)
    return times


def keep(taken: list[float], work: Callable[[], object], repeat: int) -> None:
    """Time one call; the first is for warming up."""
    start = time.perf_counter()
    work()
    if repeat:
        taken.append(time.perf_counter() - start)


def inputs(batch: int, vertices: int, device: torch.device = CPU) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Source, target, truth [batch, vertex, 3] and edges [3 vertex, 2]."""
    meshes = (torch.rand(batch, vertices, 3, device=device) * 2 - 1 for _ in range(3))
    return (*meshes, torch.randint(vertices, (3 * vertices, 2), device=device))  # type: ignore[return-value]


@torch.no_grad()
def forward(network: nn.Module, how: Precision, source: Tensor, target: Tensor) -> Tensor:
    """One inference."""
    with precision(how, source.device):
        return network(source=source, target=target)  # type: ignore[no-any-return]


def step(
    network: nn.Module,
    how: Precision,
    optimiser: torch.optim.Optimizer,
    source: Tensor,
    target: Tensor,
    truth: Tensor,
    edges: Tensor,
) -> None:
    """One training step."""
    optimiser.zero_grad(set_to_none=True)
    with products(how):
        with autocast(how, source.device):
            prediction = network(source=source, target=target)
        pose_transfer_loss(prediction, truth, edges)[0].backward()
    optimiser.step()


def peak_of_a_step(form: str) -> float:
    """MiB that a step of batch 8 at 6,890 vertices takes over what was held before."""
    network: nn.Module = DSFFNet()
    if form == "literal":
        network = LiteralDSFFNet(network)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-6)
    step(network, FORMS[form], optimiser, *inputs(1, 50))
    meshes = inputs(8, 6890)
    forget_peak()
    before = peak_mebibytes()
    step(network, FORMS[form], optimiser, *meshes)
    return peak_mebibytes() - before


def memory() -> None:
    """Peak memory of a training step of each form, each in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.networks", "--memory"]
    peaks = {
        form: float(subprocess.run([*command, form], capture_output=True, text=True, check=True).stdout)
        for form in FORMS
    }
    print("\nDSFFNet, peak memory of a step, 8 x 6,890 vertices")
    for form, peak in peaks.items():
        print(f"  {form:10}{peak:9,.0f} MiB   {peak / peaks['literal']:.2f} of the literal form's")


if __name__ == "__main__":
    main()
