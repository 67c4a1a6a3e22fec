"""Two ranks of one thread against one process of two: ``python -m benchmarks.training.ranks [--rounds 3] [--quick]``.

DSFFNet at the quickstart's widths, a batch of 8 over both ranks, on legs of 615 and 1,230 vertices (the quickstart's
bodies, and the next topology of Anny). Both ways are whole trainings by ``python -m training.engine``, in turns, on the
same two cores; a training's rate is the median of ``meshes_per_second`` in its journal, without the first line
(warming up) and the last (which holds the closing evaluation). Two ranks pay for exchanging gradients over gloo, and
gain where an operation does not use two threads well. On a busy machine look at the ratios, not at the rates.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.training.input_wait import BATCH, CASES, Case, legs
from training.recipes.training import TrainingRecipe

GOAL = 0.9
TIMEOUT = 1800.0
ROOT = Path(__file__).resolve().parents[2]
QUICKSTART = CASES["quickstart, 615 vertices"]
SIZES = {"615 vertices": QUICKSTART, "1,230 vertices": QUICKSTART._replace(segments=2 * QUICKSTART.segments)}
WAYS = {"2 ranks x 1 thread": (2, 1), "1 process x 2 threads": (1, 2)}


def main() -> None:
    """Measure and print everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3, help="trainings of each way")
    parser.add_argument("--steps", type=int, default=150, help="of a training")
    parser.add_argument("--quick", action="store_true", help="615 vertices only, one round of a few steps")
    options = parser.parse_args()
    rounds, steps = (1, 4) if options.quick else (options.rounds, options.steps)
    print(f"DSFFNet {QUICKSTART.decoder}, batch {BATCH}, {steps} steps a training; goal: a ratio of {GOAL} or more")
    for title, case in list(SIZES.items())[: 1 if options.quick else None]:
        print(f"\n{title}, meshes/s" + "".join(f"{way:>24}" for way in WAYS) + f"{'ratio':>8}")
        with tempfile.TemporaryDirectory() as folder:
            show([compared(case, Path(folder), steps, number) for number in range(rounds)])


def show(ratios: list[float]) -> None:
    """The middle of all rounds."""
    middle = statistics.median(ratios)
    print(f"  median ratio {middle:.2f}{'' if middle >= GOAL else ', under the goal'}")


def compared(case: Case, folder: Path, steps: int, number: int) -> float:
    """One training of each way; the rate of two ranks over that of one process."""
    data = folder / "legs.zarr"
    if not data.exists():
        legs(case, str(data), poses=100)
    recipe = recipe_of(case, steps)
    rates = [
        rate(recipe, data, folder / f"run-{number}-{ranks}", ranks=ranks, threads=threads)
        for ranks, threads in WAYS.values()
    ]
    print(f"  round {number:<15}" + "".join(f"{found:24.1f}" for found in rates) + f"{rates[0] / rates[1]:8.2f}")
    return rates[0] / rates[1]


def recipe_of(case: Case, steps: int) -> TrainingRecipe:
    """The quickstart's training, some ten journal lines long."""
    return TrainingRecipe.model_validate(
        {
            "network": {"encoder_widths": case.encoder, "decoder_widths": case.decoder},
            "batch": BATCH,
            "steps": steps,
            "schedule": {"name": "constant"},
            "gradient_clip": 1.0,
            "device": "cpu",
            "cache": "device",
            "log_every": max(1, steps // 10),
        }
    )


def rate(recipe: TrainingRecipe, data: Path, run: Path, *, ranks: int, threads: int) -> float:
    """Meshes a second of a training by so many processes of so many threads.

    Raises
    ------
    RuntimeError
        It failed; with what it said.
    """
    path = run.with_suffix(".json")
    path.write_text(recipe.model_dump_json())
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    shared = {"WORLD_SIZE": ranks, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": threads}
    command = [sys.executable, "-m", "training.engine", str(path), str(data), str(run)]
    processes = []
    for rank in range(ranks):
        own = {name: str(value) for name, value in {**shared, "RANK": rank, "LOCAL_RANK": rank}.items()}
        with open(f"{path}.{rank}.log", "wb") as log:
            processes.append(subprocess.Popen(command, cwd=ROOT, env=os.environ | own, stdout=log, stderr=log))
    wait(processes, path)
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    return statistics.median(row["meshes_per_second"] for row in rows[1:-1])


def wait(processes: list[subprocess.Popen[bytes]], path: Path) -> None:
    """Until all have ended well; if one has not, the others are ended and the last that it said is raised."""
    try:
        for rank, process in enumerate(processes):
            if process.wait(TIMEOUT):
                said = Path(f"{path}.{rank}.log").read_text(encoding="utf-8")
                raise RuntimeError(f"rank {rank} ended with {process.returncode}: {said}")
    finally:
        for process in processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
