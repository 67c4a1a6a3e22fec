"""How long a transfer takes: ``python -m benchmarks.transfer.seconds [--run RUN] [--threads 2] [--vertices 6890]``.

One pair with the model loaded is a DSFFNet of the paper's widths (random weights: the time is the same), or weights
that are named, and two people of so many vertices; the median of ten, after one for warming up. The whole command is a
process of its own, from its start to its end, with the same weights; the median of three.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks.transfer.strangers import person
from datagen.mesh.files import save_mesh
from datagen.mesh.geometry import Mesh
from training.checkpoints.checkpoint import save_checkpoint
from training.inference.predict import network_from
from training.inference.transfer import REFINE_WEIGHT, PoseTransfer
from training.recipes.training import TrainingRecipe
from workflows.pretrained import weights_named


def main() -> None:
    """Measure and print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", help="a run, or the name of weights that come along (the paper's widths)")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--vertices", type=int, default=6890)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run = weights_named(options.run) if options.run else untrained_run(folder / "run")
        source, target = simplified(options.vertices, pose=0), simplified(options.vertices, pose=1)
        print(f"torch {torch.__version__}, CPU, {options.threads} threads, {options.vertices:,} vertices, seconds")
        for what, seconds in inside(PoseTransfer.from_run(run), source, target).items():
            print(f"  {what:38}{seconds:7.3f}")
        save_mesh(source, folder / "source.obj")
        save_mesh(target, folder / "target.obj")
        for extra in ((), ("--refine",), ("--picture",)):
            print(f"  {' '.join(('dsffnet transfer', *extra)):38}{whole(run, folder, extra, options.threads):7.3f}")


def untrained_run(folder: Path) -> Path:
    """A run of the paper's widths, with weights as they begin."""
    recipe = TrainingRecipe()
    about = {"step": 1, "recipe": recipe.model_dump(mode="json"), "dataset": ""}
    save_checkpoint(folder, about=about, weights=network_from(recipe.network).state_dict(), state={}, keep=1)
    return folder


def simplified(vertices: int, *, pose: int) -> Mesh:
    """A person of about so many vertices."""
    import fast_simplification

    mesh = person(0.6, pose=pose, number=pose, topology="anny")
    points, faces = fast_simplification.simplify(mesh.vertices, mesh.faces.astype(np.int32), target_count=2 * vertices)
    return Mesh(points.astype(np.float64), faces.astype(np.int64))


def inside(transfer: PoseTransfer, source: Mesh, target: Mesh) -> dict[str, float]:
    """Seconds of one pair with everything loaded."""
    probe = np.repeat(source.vertices[None, :256], 24, axis=0)
    return {
        "one pair": median(lambda: transfer(source=source, target=target)),
        "a frame of a sequence (of 20)": median(lambda: list(transfer.sequence([source] * 20, target)), 3) / 20,
        "one pair, refined": median(lambda: transfer(source=source, target=target, refine=REFINE_WEIGHT)),
        "how one mesh stands (24 ways)": median(lambda: transfer.self_errors(probe)),
    }


def median(work: Callable[[], object], repeats: int = 10) -> float:
    """Seconds of a call, the first left out."""
    taken = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken[1:])


def whole(run: Path, folder: Path, extra: tuple[str, ...], threads: int) -> float:
    """Seconds of the command, from nothing to a file."""
    words = ["--model", run, folder / "source.obj", folder / "target.obj", "-o", folder / "out.obj", *extra]
    command = [sys.executable, "-m", "workflows", "transfer", *map(str, words)]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}

    def work() -> None:
        subprocess.run(command, check=True, capture_output=True, env=environment)

    return median(work, repeats=3)


if __name__ == "__main__":
    main()
