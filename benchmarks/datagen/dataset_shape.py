"""A dataset of many identities against one of many poses: making, opening, objects on disk, reading.

    python -m benchmarks.datagen.dataset_shape [rounds]

The same number of meshes of the procedural leg, as 2,000 identities in 10 poses and as 20 identities in 1,000, made in
this process (as with ``--local``) in interleaved rounds. Reading is from the page cache: single meshes at random, one
identity after another, all meshes into memory as a training does, and random batches of 8 triples that are streamed.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from datagen.generate import generate
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset, open_dataset
from training.data.vertex_bank import open_bank

SHAPES = {"many identities": (2000, 10), "many poses": (20, 1000)}
READS, BATCHES, OPENED = 2000, 50, 20


def recipe_of(identities: int, poses: int) -> DatasetRecipe:
    """Legs in a grid of training identities and seen poses."""
    sizes = {"identities": {"training": identities, "evaluation": 0}, "poses": {"seen": poses, "unseen": 0}}
    return DatasetRecipe.model_validate({"body": {"family": "leg"}, **sizes})


def seconds(work: Callable[[], object]) -> float:
    """Seconds of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def batches(dataset: Dataset) -> float:
    """Batches of 8 triples a second, streamed from a dataset of which few meshes are held."""
    bank = open_bank(dataset, dataset.identities("training"), cache="stream")
    random, counts = np.random.default_rng(0), [dataset.grid.identity_count, dataset.grid.pose_count] * 2
    taken = seconds(lambda: [bank.batch(random.integers(0, counts, (8, 4))) for _ in range(BATCHES)])
    bank.close()
    return BATCHES / taken


def single_meshes(dataset: Dataset) -> float:
    """Meshes a second, each read alone."""
    random = np.random.default_rng(0)
    cells = random.integers(0, [dataset.grid.identity_count, dataset.grid.pose_count], (READS, 2)).tolist()
    return READS / seconds(lambda: [dataset.vertices(identity, pose) for identity, pose in cells])


def reading(url: str) -> dict[str, float]:
    """What can be read of a dataset in a second."""
    dataset, everyone = open_dataset(url), open_dataset(url).identities("training")
    meshes = dataset.grid.mesh_count
    return {
        "single meshes/s": single_meshes(open_dataset(url)),
        "meshes/s by identity": meshes / seconds(lambda: [dataset.vertices(identity) for identity in everyone]),
        "meshes/s into memory": meshes / seconds(lambda: open_bank(dataset, everyone, cache="device")),
        "streamed batches/s": batches(open_dataset(url)),
    }


def measure(identities: int, poses: int) -> dict[str, float]:
    """Make a dataset and measure everything of it."""
    with tempfile.TemporaryDirectory() as folder:
        url = f"{folder}/leg.zarr"
        made = seconds(lambda: generate(recipe_of(identities, poses), url))
        opened = statistics.median(seconds(lambda: open_dataset(url)) for _ in range(OPENED))
        objects = sum(path.is_file() for path in Path(url).rglob("*"))
        return {"made in s": made, "opened in ms": 1e3 * opened, "objects": objects, **reading(url)}


def main() -> None:
    """Measure and print the medians."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    with threadpool_limits(limits=1):
        measure(20, 10)  # imports and caches
        found = {name: [] for name in (*SHAPES, "20 identities")}  # type: dict[str, list[dict[str, float]]]
        for _ in range(rounds):
            for name, (identities, poses) in {**SHAPES, "20 identities": (20, 10)}.items():
                found[name].append(measure(identities, poses))
    for name, measured in found.items():
        middle = {what: statistics.median(each[what] for each in measured) for what in measured[0]}
        print(f"{name:16}", "  ".join(f"{what}: {value:,.1f}" for what, value in middle.items()))


if __name__ == "__main__":
    main()
