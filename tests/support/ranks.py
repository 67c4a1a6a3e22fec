"""Ranks as processes of their own over gloo, as torchrun would start them, with a bound on how long they may take."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import yaml

from training.recipes.training import TrainingRecipe

ROOT = Path(__file__).parents[2]


def free_port() -> int:
    """A TCP port that nobody listens on at the moment."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def start_ranks(
    recipe: TrainingRecipe,
    *,
    data: str,
    run: Path,
    count: int,
    module: str = "training",
    log: Path | None = None,
) -> list[subprocess.Popen[str]]:
    """Start ``count`` ranks of ``python -m module RECIPE DATA RUN``."""
    run.parent.mkdir(parents=True, exist_ok=True)
    path = run.parent / f"{run.name}-recipe.yaml"
    path.write_text(yaml.safe_dump(recipe.model_dump(mode="json")))
    shared = {
        "WORLD_SIZE": str(count),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(free_port()),
        "OMP_NUM_THREADS": "1",
    }
    return [
        subprocess.Popen(
            [sys.executable, "-m", module, str(path), data, str(run)],
            cwd=ROOT,
            env={**os.environ, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(count)
    ]


def finish(ranks: list[subprocess.Popen[str]], *, timeout: float = 120) -> list[tuple[int, str]]:
    """Exit status and output of each rank; all are killed if one hangs."""
    try:
        return [(process.wait(timeout), process.stdout.read() if process.stdout else "") for process in ranks]
    finally:
        for process in ranks:
            process.kill()
            process.wait()
