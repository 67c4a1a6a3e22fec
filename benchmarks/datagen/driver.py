"""What one driver spends on a task and on a shard: CPU seconds, as it is the one process that no node can share.

    python -m benchmarks.datagen.driver

Tasks that have nothing to do on a Ray of this machine, handed out as generation hands out its shards; then a dataset of
1,000 shards of one leg each, made in this process, from the last shard on: sizes compared, manifest written, opened.
"""

import tempfile
import time
from collections.abc import Iterator
from typing import Any

from datagen.generate import generate, ray_runner
from datagen.generate.plan import plan_of
from datagen.recipe import DatasetRecipe
from datagen.store import ManifestRow
from workflows.pipeline.ray_cluster import ray_cluster


def one_a_shard(identities: int) -> DatasetRecipe:
    """Legs in ten poses, each mesh a shard of its own."""
    sizes = {"identities": {"training": identities, "evaluation": 0}, "poses": {"seen": 10, "unseen": 0}}
    return DatasetRecipe.model_validate({"body": {"family": "leg"}, **sizes, "store": {"poses_per_shard": 1}})


def handing_out(recipe: DatasetRecipe) -> float:
    """CPU seconds of the driver for a task."""
    tasks = [("s3://bucket/legs.zarr", recipe, [(shard, None)]) for shard in plan_of(recipe).arrays.shards()]
    with ray_cluster():
        for _ in ray_runner(_nothing, tasks):  # workers start meanwhile, which does not count
            pass
        began = time.process_time()
        for _ in ray_runner(_nothing, tasks):
            pass
        return (time.process_time() - began) / len(tasks)


def _nothing(*_: object) -> list[ManifestRow]:
    return [ManifestRow((0, 0, 0, 0), 1, 10_000, "0" * 64, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))]


def finishing(recipe: DatasetRecipe) -> float:
    """CPU seconds for a shard once the last one is stored."""
    ends: list[float] = []

    def noted(results: Iterator[tuple[int, Any]], **_: object) -> Iterator[Any]:
        yield from (result for _, result in results)
        ends.append(time.process_time())

    with tempfile.TemporaryDirectory() as folder:
        dataset = generate(recipe, f"{folder}/legs.zarr", progress=noted)
        return (time.process_time() - ends[-1]) / len(dataset.arrays.shards())


if __name__ == "__main__":
    print(f"{1e3 * finishing(one_a_shard(100)):.3f} ms of CPU a shard after the last one", flush=True)
    print(f"{1e3 * handing_out(one_a_shard(400)):.3f} ms of CPU a task")
