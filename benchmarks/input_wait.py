"""Share of a training step that waits for input: ``python -m benchmarks.input_wait [--threads 2] [--quick]``.

DSFFNet at the quickstart's widths and at the paper's, batch 8, on a grid of procedural legs with as many vertices as
the quickstart's bodies (615) and SMPL (6,890). A streamed bank may hold a quarter of the meshes. A step is input,
forward, both losses, backward and AdamW, and ends when its loss is known, as the trainer's does. ``wait`` is the time
in which the step stands still for its batch; a thread that reads ahead may also slow the rest down, so the step is
compared with that of meshes in memory, too. Every cache runs in turn, in blocks.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn

from datagen.generate import generate
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset, open_dataset
from training.data.triples import TripleOrder
from training.data.vertex_bank import VertexBank, open_bank
from training.data.vertex_layout import Layout
from training.networks.dsffnet import DSFFNet
from training.objectives.losses import transfer_loss

GOAL = 0.02
BATCH = 8
CACHES = ("device", "stream")


class Case(NamedTuple):
    rings: int
    segments: int
    encoder: tuple[int, int, int]
    decoder: tuple[int, int, int]
    steps: int
    """In a block, on a CPU."""


class Times(NamedTuple):
    wait: list[float]
    step: list[float]


CASES = {
    "quickstart, 615 vertices": Case(41, 15, (64, 128, 256), (64, 256, 64), 40),
    "paper, 6,890 vertices": Case(130, 53, (64, 128, 1024), (256, 1024, 256), 2),
}


def main() -> None:
    """Measure and print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--poses", type=int, default=150, help="of each of 8 identities")
    parser.add_argument("--rounds", type=int, default=2, help="blocks of each cache")
    parser.add_argument("--quick", action="store_true", help="the small case only, a few steps")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {options.threads} threads"
    print(f"torch {torch.__version__}, {name}, batch {BATCH}; goal: wait under {GOAL:.0%} of the step")
    for title, case in list(CASES.items())[: 1 if options.quick else None]:
        with tempfile.TemporaryDirectory() as folder:
            show(title, measure(case, Path(folder), device, options))


def show(title: str, times: dict[str, Times]) -> None:
    """One case's table; medians of steps, and the share over all steps together."""
    print(f"\n{title}\n  {'cache':8}{'step ms':>10}{'wait ms':>10}{'longest':>10}{'share':>8}{'step / device':>15}")
    usual = statistics.median(times["device"].step)
    for cache, (wait, step) in times.items():
        middle, share = statistics.median(step), sum(wait) / sum(step)
        print(
            f"  {cache:8}{1e3 * middle:10.1f}{1e3 * statistics.median(wait):10.3f}{1e3 * max(wait):10.2f}"
            f"{share:8.2%}{middle / usual:15.2f}   {'' if share < GOAL else 'over the goal'}"
        )


def measure(case: Case, folder: Path, device: torch.device, options: argparse.Namespace) -> dict[str, Times]:
    """Seconds of every step and of its wait, by cache."""
    dataset = legs(case, folder, options.poses)
    torch.manual_seed(0)
    network = DSFFNet(encoder_widths=case.encoder, decoder_widths=case.decoder).to(device)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-6)
    steps = 10 if options.quick else case.steps if device.type == "cpu" else 150
    order = TripleOrder(dataset.identities("training"), dataset.grid.poses("seen"), batch=BATCH, seed=0)
    banks = {cache: bank_of(cache, dataset, device) for cache in CACHES}
    times = {cache: Times([], []) for cache in banks}
    for turn in range(options.rounds):
        for cache, bank in banks.items():
            block(bank, order, turn * steps, steps, (network, optimiser), times[cache])
    for bank in banks.values():
        bank.close()
    return times


def block(
    bank: VertexBank,
    order: TripleOrder,
    first: int,
    steps: int,
    learning: tuple[nn.Module, torch.optim.Optimizer],
    times: Times,
) -> None:
    """Some steps of one cache; the first is for warming up."""
    with closing(bank.prefetch(order.batches(first_step=first))) as shares:  # type: ignore[type-var]
        for number, (wait, step) in enumerate(islice(timed(bank, shares, *learning), steps + 1)):
            if number:
                times.wait.append(wait)
                times.step.append(step)


def timed(
    bank: VertexBank, shares: Iterator[list[object]], network: nn.Module, optimiser: torch.optim.Optimizer
) -> Iterator[tuple[float, float]]:
    """Seconds of the wait for input, and of the whole step."""
    while True:
        began = time.perf_counter()
        (triples,) = next(shares)
        batch = bank.batch(triples)  # type: ignore[arg-type]
        waited = time.perf_counter() - began
        optimiser.zero_grad(set_to_none=True)
        prediction = network(source=batch.source, target=batch.target)
        loss, _ = transfer_loss(prediction, truth=batch.truth, target=batch.target, edges=batch.edges)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        loss.item()
        yield waited, time.perf_counter() - began


def bank_of(cache: str, dataset: Dataset, device: torch.device) -> VertexBank:
    """A bank of the training meshes; a streamed one holds a quarter of them."""
    identities = dataset.identities("training")
    memory = Layout(dataset, identities).bytes // 4
    return open_bank(dataset, identities, device=device, cache=cache, memory=memory)  # type: ignore[arg-type]


def legs(case: Case, folder: Path, poses: int) -> Dataset:
    """Legs of 8 identities, all for training."""
    recipe = DatasetRecipe.model_validate(
        {
            "body": {"family": "leg", "rings": case.rings, "segments": case.segments},
            "identities": {"training": 8, "evaluation": 0},
            "poses": {"seen": poses, "unseen": 0},
            "triples": {"count": 0},
        }
    )
    return open_dataset(generate(recipe, str(folder / "legs.zarr")).url)


if __name__ == "__main__":
    main()
