"""Making meshes: this project end to end, against the body model alone, and against the way of NPT's generator.

    python -m benchmarks.datagen.generation [topology ...]

For each Anny topology one table, measured in interleaved rounds on one core: the NPT way (one mesh at a time: NumPy
skinning of every vertex by its own 4x4 matrix, text OBJ; written anew from its description), Anny's own batched
forward, this project's body alone (another identity in each round, as in each shard), and tasks of whole shards
(identity, pose, check, compress, checksum, hash, write); beside them files of as many bytes, which is what new pages
cost on this machine: a virtual one may take 10 us for each that it has not used before. Then reading, size, a worker's
memory, and one against two Ray workers.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from datagen.bodies import load_body
from datagen.common.seeding import Stream, generator
from datagen.generate import ensure_shards, generate, ray_runner
from datagen.generate.plan import prepare
from datagen.generate.shards import batches
from datagen.grid import Shard
from datagen.mesh.rig import part_transforms
from datagen.poses import draw_poses
from datagen.recipe import DatasetRecipe

POSES, SHARDS, ROUNDS, ONE_AT_A_TIME, TURNS = 100, 4, 7, 10, 8


def recipe_of(topology: str, identities: int = SHARDS * ROUNDS, poses: int = POSES) -> DatasetRecipe:
    """A grid of Anny bodies, one shard of 100 poses after another."""
    sizes = {"identities": {"training": identities, "evaluation": 0}, "poses": {"seen": poses, "unseen": 0}}
    return DatasetRecipe.model_validate({"body": {"family": "anny", "topology": topology}, **sizes})


def one_at_a_time(body: Any, parameters: np.ndarray, poses: Any, faces: np.ndarray, folder: Path) -> None:
    """Skin and write meshes singly, as NPT's data_generation.py does."""
    rest = body.rest(parameters)
    weights = rest.weights.toarray() if hasattr(rest.weights, "toarray") else rest.weights
    homogeneous = np.hstack([rest.vertices, np.ones((len(rest.vertices), 1))])
    world = body.world_rotations(poses)
    for number, rotations in enumerate(world):
        transforms = part_transforms(rotations, rest.joints, rest.parents)
        blended = np.tensordot(weights, transforms, axes=[[1], [0]])
        vertices = np.matmul(blended, homogeneous[..., None])[..., 0]
        with open(folder / f"0_{number}.obj", "w") as file:
            for x, y, z in vertices:
                file.write(f"v {x:f} {y:f} {z:f}\n")
            for a, b, c in faces + 1:
                file.write(f"f {a:d} {b:d} {c:d}\n")


def annys_own_forward(topology: str) -> Callable[[], object]:
    """Anny's forward pass of a batch of 100 poses of one identity, in float32 on one thread, without gradients."""
    import anny
    import torch

    torch.set_num_threads(1)
    model = anny.Anny(rig="mixamo", topology=topology, skinning_method="lbs").to(torch.float32)
    turns = torch.eye(4).repeat(POSES, len(model.bone_labels), 1, 1)
    shape = {name: torch.full((POSES,), 0.5) for name in model.phenotype_labels}

    def forward() -> object:
        with torch.no_grad():
            return model(pose_parameters=turns, phenotype_kwargs=shape)

    return forward


def rate(work: Callable[[], object], meshes: int) -> float:
    """Meshes a second of one call."""
    began = time.perf_counter()
    work()
    return meshes / (time.perf_counter() - began)


def measure(topology: str, folder: Path) -> None:
    """Measure and print one topology's table."""
    recipe, url = recipe_of(topology), str(folder / f"{topology}.zarr")
    body = load_body(recipe.body)
    drawn = (body.draw_identity(generator(recipe.identities.seed, Stream.IDENTITY, n), n) for n in range(ROUNDS + 2))
    parameters, *people = drawn
    poses, faces = draw_poses(recipe.poses, range(POSES)), body.faces(parameters)
    shards = prepare(url, recipe).shards()
    forward = annys_own_forward(topology)
    todo = list(shards)
    names = {
        "one": "one at a time, text OBJ (NPT's way)",
        "anny": "Anny's own forward, batch 100",
        "body": "our body alone, batch 100",
        "shard": "whole shards, to disk",
        "files": "files of as many bytes, alone",
    }
    ways: dict[str, tuple[Callable[[], object], int]] = {
        "one": (
            lambda: one_at_a_time(body, parameters, poses[:ONE_AT_A_TIME], faces, folder),
            ONE_AT_A_TIME,
        ),
        "anny": (forward, POSES),
        "body": (lambda: body.vertices(people.pop(), poses), POSES),
        "shard": (lambda: ensure_shards(url, recipe, [(todo.pop(), None) for _ in range(SHARDS)]), SHARDS * POSES),
        "files": (lambda: plain_files(Path(url), shards[len(todo) :][:SHARDS], folder), SHARDS * POSES),
    }
    forward(), body.vertices(people.pop(), poses)
    found = {name: [] for name in ways}  # type: dict[str, list[float]]
    for _ in range(ROUNDS):
        for name, (work, meshes) in ways.items():
            found[name].append(rate(work, meshes))
    middle = {name: statistics.median(rates) for name, rates in found.items()}
    print(f"\nAnny {topology}: {faces.max() + 1:,} vertices, one core, medians of {ROUNDS} rounds")
    for name, label in names.items():
        print(
            f"  {label:38} {middle[name]:9,.0f} meshes/s   x{middle[name] / middle['one']:7.1f} NPT's way"
            f"   x{middle[name] / middle['anny']:5.2f} Anny's forward   x{middle[name] / middle['body']:5.2f} our body"
        )
    apart = 1 / (1 / middle["body"] + 1 / middle["files"])
    print(f"  whole shards make x{middle['shard'] / apart:.2f} of our body and such files one after the other")
    reading(url, recipe, shards, folder)


def plain_files(store: Path, shards: list[Shard], folder: Path) -> None:
    """Write for each of some shards a new file of as many bytes."""
    for shard in shards:
        (folder / shard.path.replace("/", "-")).write_bytes(bytes((store / shard.path).stat().st_size))


def reading(url: str, recipe: DatasetRecipe, shards: list[Shard], folder: Path) -> None:
    """Speed of reading whole shards and single meshes (decoded bytes, from the page cache), and the size."""
    dataset, count = generate(recipe, url), len(shards)
    began = time.perf_counter()
    size = sum(dataset.vertices(identity).nbytes for identity in range(count))
    whole = size / (time.perf_counter() - began) / 1e6
    began = time.perf_counter()
    for place in range(100):
        dataset.vertices(place % count, place * 37 % POSES)
    single = 100 / (time.perf_counter() - began)
    stored = sum((Path(url) / shard.path).stat().st_size for shard in shards) / count / POSES
    text = np.mean([path.stat().st_size for path in folder.glob("0_*.obj")])
    print(f"  reading: whole shards {whole:,.0f} MB/s, single meshes {single:,.0f}/s")
    print(f"  size: {stored / 1e3:.1f} kB a mesh, {stored / text:.3f} of its OBJ")


_WORKER = """
import sys, tempfile
from benchmarks.datagen.generation import recipe_of
from benchmarks.peak_memory import peak_mebibytes
from datagen.generate import ensure_shards
from datagen.generate.plan import prepare
recipe = recipe_of(sys.argv[1], identities=int(sys.argv[2]))
with tempfile.TemporaryDirectory() as folder:
    for shard in prepare(f"{folder}/x.zarr", recipe).shards():
        ensure_shards(f"{folder}/x.zarr", recipe, [(shard, None)])
print(peak_mebibytes())
"""


def memory(topology: str) -> None:
    """Peak resident memory of a worker after a small and after a larger grid."""
    root = str(Path(__file__).parents[2])
    peaks = []
    for identities in (2, 12):
        command = [sys.executable, "-c", _WORKER, topology, str(identities)]
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, cwd=root, env={**os.environ, "PYTHONPATH": root}
        )
        peaks.append(float(done.stdout.split()[-1]))
    print(f"\na worker's peak memory, {topology}: {peaks[0]:,.0f} MiB for 200 meshes, {peaks[1]:,.0f} MiB for 1,200")


def scaling(topology: str, identities: int) -> None:
    """Whole shards a second on one and on two Ray workers, in turns, as new pages of files cost what they like."""
    import ray

    recipe, turns = recipe_of(topology, identities), list[tuple[float, float]]()
    ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    for _ in range(1 + TURNS):
        with one_cpu_taken():
            one = on_ray(recipe)
        turns.append((one, on_ray(recipe)))
    ray.shutdown()
    one, two = np.median(turns[1:], axis=0)  # after the first both workers have loaded the body
    ratios = sorted(two / one for one, two in turns[1:])
    middle, least, most = statistics.median(ratios), ratios[0], ratios[-1]
    print(f"\nRay workers, {topology}, medians of {TURNS} turns: one {one:,.0f} meshes/s, two {two:,.0f}", flush=True)
    print(f"  x{two / one:.2f}; within a turn x{least:.2f} to x{most:.2f}, x{middle:.2f} in the median", flush=True)


@contextmanager
def one_cpu_taken() -> Iterator[None]:
    """Keep one CPU of the Ray cluster for a task that does nothing."""
    import ray

    with tempfile.TemporaryDirectory() as folder:
        begun, end = Path(folder, "begun"), Path(folder, "end")
        waiting = ray.remote(num_cpus=1)(_wait).remote(begun, end)
        while not begun.exists():
            time.sleep(0.02)
        yield
        end.touch()
        ray.get(waiting)


def _wait(begun: Path, end: Path) -> None:
    begun.touch()
    while not end.exists():
        time.sleep(0.02)


def on_ray(recipe: DatasetRecipe) -> float:
    """Meshes a second by the workers of the connected Ray cluster that have a CPU to themselves."""
    with tempfile.TemporaryDirectory() as folder:
        url = f"{folder}/made.zarr"
        wanted = [(shard, None) for shard in prepare(url, recipe).shards()]
        tasks = [(url, recipe, some) for some in batches(recipe, wanted)]
        meshes = recipe.identities.training * POSES
        return rate(lambda: list(ray_runner(ensure_shards, tasks)), meshes)


def main() -> None:
    """Measure and print everything."""
    topologies = sys.argv[1:] or ["notoes_collapse5pc", "notoes_collapse10pc", "anny"]
    with threadpool_limits(limits=1):
        for topology in topologies:
            with tempfile.TemporaryDirectory() as folder:
                measure(topology, Path(folder))
    memory(topologies[-1])
    for topology in dict.fromkeys([topologies[0], topologies[-1]]):
        scaling(topology, identities=60 if topology == "anny" else 1200)  # of anny 1200 would be 16 GB


if __name__ == "__main__":
    main()
