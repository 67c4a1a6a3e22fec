"""Share of a training step that waits for input: ``python -m benchmarks.training.input_wait [--threads 2] [--quick]``.

DSFFNet at the quickstart's widths and at the paper's, batch 8, on a grid of procedural legs with as many vertices as
the quickstart's bodies (615) and SMPL (6,890). A streamed bank may hold a quarter of the meshes. A step is input,
forward, both losses, backward and AdamW, and ends when its loss is known, as the trainer's does. ``wait`` is the time
in which the step stands still for its batch; a thread that reads ahead may also slow the rest down, so the step is
compared with that of meshes in memory, too. Every way runs in turn. ``blocks`` is a stream of triples in blocks of
shards. ``--s3 30``: the data lie on an S3 server that takes 30 ms more for a request, and the requests of a whole epoch
are counted (``--poses 1200``: in shards of 100 meshes, as the quickstart's).
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn

from datagen.generate import generate
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset, open_dataset
from tests.support.damage.object_store import BUCKET, Proxy, proxied, s3_server
from training.data.triples import TripleOrder, order_of
from training.data.vertex_bank import VertexBank, open_bank
from training.data.vertex_layout import Layout
from training.networks.dsffnet import DSFFNet
from training.objectives.losses import transfer_loss
from training.recipes.training import TrainingRecipe

GOAL = 0.02
BATCH = 8
WAYS = ("device", "stream", "blocks")
_COLUMNS = 12
"""Of shards, along the poses."""


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
    parser.add_argument("--rounds", type=int, default=2, help="turns of each way")
    parser.add_argument("--s3", type=float, metavar="MS", help="data on an S3 server that takes so much longer")
    parser.add_argument("--quick", action="store_true", help="the small case only, a few steps")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {options.threads} threads"
    print(f"torch {torch.__version__}, {name}, batch {BATCH}; goal: wait under {GOAL:.0%} of the step")
    for title, case in list(CASES.items())[: 1 if options.quick else None]:
        with tempfile.TemporaryDirectory() as folder, ExitStack() as around:
            dataset, proxy = placed(case, Path(folder), options, around)
            show(title, measure(case, dataset, device, options))
            if proxy:
                show_requests(dataset, proxy)


def show(title: str, times: dict[str, Times]) -> None:
    """One case's table; medians of steps, and the share over all steps together."""
    print(f"\n{title}\n  {'way':8}{'step ms':>10}{'wait ms':>10}{'longest':>10}{'share':>8}{'step / device':>15}")
    usual = statistics.median(times["device"].step)
    for way, (wait, step) in times.items():
        middle, share = statistics.median(step), sum(wait) / sum(step)
        print(
            f"  {way:8}{1e3 * middle:10.1f}{1e3 * statistics.median(wait):10.3f}{1e3 * max(wait):10.2f}"
            f"{share:8.2%}{middle / usual:15.2f}   {'' if share < GOAL else 'over the goal'}"
        )


def show_requests(dataset: Dataset, proxy: Proxy) -> None:
    """Requests that an epoch of triples makes, without learning."""
    for way in WAYS[1:]:
        before, order = len(proxy.requests("/vertices/c/")), order_by(way, dataset)
        with closing(bank_of(way, dataset, torch.device("cpu"))) as bank:
            for (triples,) in islice(bank.prefetch(order.batches(first_step=0)), order.steps_per_epoch):
                bank.batch(triples)
        asked = len(proxy.requests("/vertices/c/")) - before
        print(f"  {way:8}{asked:,} requests for {len(dataset.sizes)} shards: {asked / len(dataset.sizes):.2f} each")


def measure(case: Case, dataset: Dataset, device: torch.device, options: argparse.Namespace) -> dict[str, Times]:
    """Seconds of every step and of its wait, by way."""
    torch.manual_seed(0)
    network = DSFFNet(encoder_widths=case.encoder, decoder_widths=case.decoder).to(device)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-6)
    steps = 10 if options.quick else case.steps if device.type == "cpu" else 150
    banks = {way: bank_of(way, dataset, device) for way in WAYS}
    times = {way: Times([], []) for way in banks}
    for turn in range(options.rounds):
        for way, bank in banks.items():
            block(bank, order_by(way, dataset), turn * steps, steps, (network, optimiser), times[way])
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
    """Some steps of one way; the first is for warming up."""
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


def quarter(dataset: Dataset) -> int:
    """Bytes of a quarter of the training meshes, which a streamed bank holds."""
    return Layout(dataset, dataset.identities("training")).bytes // 4


def order_by(way: str, dataset: Dataset) -> TripleOrder:
    """The order of triples of one way."""
    block = f"{quarter(dataset) / 1e3:.0f}kB" if way == "blocks" else None
    return order_of(TrainingRecipe(batch=BATCH, block=block), dataset)


def bank_of(way: str, dataset: Dataset, device: torch.device) -> VertexBank:
    """A bank of the training meshes."""
    identities, memory = dataset.identities("training"), quarter(dataset)
    placed = {"device": device, "memory": memory, "block": order_by(way, dataset).memory()}
    return open_bank(dataset, identities, cache="device" if way == "device" else "stream", **placed)  # type: ignore[arg-type]


def placed(case: Case, folder: Path, options: argparse.Namespace, around: ExitStack) -> tuple[Dataset, Proxy | None]:
    """Legs in a folder, or on a server behind a proxy while ``around`` is open."""
    if options.s3 is None:
        return legs(case, str(folder / "legs.zarr"), poses=options.poses), None
    around.enter_context(s3_server())
    url = legs(case, f"{BUCKET}/legs.zarr", poses=options.poses).url
    proxy = around.enter_context(proxied(folder / "requests", delay=options.s3 / 1e3))
    return open_dataset(url), proxy


def legs(case: Case, url: str, *, poses: int) -> Dataset:
    """Legs of 8 identities, all for training."""
    sizes = {
        "body": {"family": "leg", "rings": case.rings, "segments": case.segments},
        "identities": {"training": 8, "evaluation": 0},
        "poses": {"seen": poses, "unseen": 0},
        "triples": {"count": 0},
        "store": {"poses_per_shard": -(-poses // _COLUMNS)},
    }
    return generate(DatasetRecipe.model_validate(sizes), url)


if __name__ == "__main__":
    main()
