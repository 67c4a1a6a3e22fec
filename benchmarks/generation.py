"""Making meshes: this project's way against the body model alone, and against the way of NPT's generator.

    python benchmarks/generation.py [topology]

All in one process on one BLAS thread, the same identity and poses, medians of interleaved rounds. The NPT way (one mesh
at a time: NumPy skinning of every vertex by its own 4x4 matrix, text OBJ) is written anew from its description.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from datagen.bodies import load_body
from datagen.bodies.skinning import Rest, joint_transforms
from datagen.generate import make_shard, prepare
from datagen.grid import Grid
from datagen.poses import draw_poses
from datagen.random import Stream, generator
from datagen.recipe import DatasetRecipe
from datagen.store.writer import write_shard

POSES, ROUNDS, ONE_AT_A_TIME = 100, 5, 10


def one_at_a_time(rest: Rest, rotations: np.ndarray, faces: np.ndarray, folder: Path) -> None:
    """Skin and write meshes singly, as NPT's data_generation.py does."""
    homogeneous = np.hstack([rest.vertices, np.ones((len(rest.vertices), 1))])
    for number, rotation in enumerate(rotations):
        transforms = joint_transforms(rest, rotation[None])[0]
        blended = np.tensordot(rest.weights, transforms, axes=[[1], [0]])
        vertices = np.matmul(blended, homogeneous[..., None])[..., 0]
        with open(folder / f"0_{number}.obj", "w") as file:
            for x, y, z in vertices:
                file.write(f"v {x:f} {y:f} {z:f}\n")
            for a, b, c in faces + 1:
                file.write(f"f {a:d} {b:d} {c:d}\n")


def rate(work: Callable[[], object], meshes: int) -> float:
    """Meshes a second of one call."""
    began = time.perf_counter()
    work()
    return meshes / (time.perf_counter() - began)


def main() -> None:
    """Measure and print the table."""
    topology = sys.argv[1] if len(sys.argv) > 1 else "notoes_collapse10pc"
    sizes = {"identities": {"training": 2, "evaluation": 2}, "poses": {"seen": POSES, "unseen": 0}}
    recipe = DatasetRecipe.model_validate({"body": {"family": "anny", "topology": topology}, **sizes})
    body, shard = load_body(recipe.body), Grid(recipe).shards()[0]
    parameters = body.draw_identity(generator(recipe.identities.seed, Stream.IDENTITY, 0))
    poses, faces = draw_poses(recipe.poses, range(POSES)), body.faces(parameters)
    rest, rotations = body._rest(parameters), body._rotations(poses[:ONE_AT_A_TIME])  # type: ignore[attr-defined]
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as temporary, threadpool_limits(limits=1):
        folder, url = Path(temporary), f"{temporary}/bench.zarr"
        prepare(url, recipe)
        ways: dict[str, tuple[Callable[[], object], int]] = {
            "one at a time, text OBJ": (lambda: one_at_a_time(rest, rotations, faces, folder), ONE_AT_A_TIME),
            "body model's batch alone": (lambda: body.vertices(parameters, poses), POSES),
            "shard: pose, check": (lambda: make_shard(recipe, shard), POSES),
            "shard: pose, check, compress, write": (
                lambda: write_shard(url, recipe, shard, make_shard(recipe, shard)),
                POSES,
            ),
        }
        for _ in range(ROUNDS):
            for name, (work, meshes) in ways.items():
                found.setdefault(name, []).append(rate(work, meshes))
    base = statistics.median(found["one at a time, text OBJ"])
    print(f"Anny {topology}, {faces.max() + 1:,} vertices, one process, {ROUNDS} rounds of {POSES} meshes")
    for name, rates in found.items():
        middle = statistics.median(rates)
        print(f"  {name:38} {middle:8,.0f} meshes/s   x{middle / base:6.1f}")


if __name__ == "__main__":
    main()
