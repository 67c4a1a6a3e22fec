"""Ranks as processes of their own over gloo, as torchrun would start them, with a bound on how long they may take."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import yaml

from training.recipes.training import TrainingRecipe

ROOT = Path(__file__).parents[3]


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
    module: str = "training.engine",
) -> list[subprocess.Popen[str]]:
    """Start ``count`` ranks of ``python -m module RECIPE DATA RUN``."""
    run.parent.mkdir(parents=True, exist_ok=True)
    path = run.parent / f"{run.name}-recipe.yaml"
    path.write_text(yaml.safe_dump(recipe.model_dump(mode="json")))
    return _started([sys.executable, "-m", module, str(path), data, str(run)], count)


def _started(command: Sequence[str], count: int) -> list[subprocess.Popen[str]]:
    shared = {
        "WORLD_SIZE": str(count),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(free_port()),
        "OMP_NUM_THREADS": "1",
    }
    return [
        subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(count)
    ]


def train_in_turn(jobs: Sequence[tuple[TrainingRecipe, Path]], *, data: str, place: Path, count: int = 2) -> None:
    """Train every (recipe, run) by one group of ranks, one after the other; starting a group takes seconds."""
    path = place / "jobs.json"
    path.write_text(json.dumps([[recipe.model_dump(mode="json"), data, str(run)] for recipe, run in jobs]))
    results = finish(_started([sys.executable, "-m", "tests.support.ranks", str(path)], count))
    assert [status for status, _ in results] == [0] * count, results


def finish(ranks: list[subprocess.Popen[str]], *, timeout: float = 120) -> list[tuple[int, str]]:
    """Exit status and output of each rank; all are killed if one hangs."""
    try:
        return [(process.wait(timeout), process.stdout.read() if process.stdout else "") for process in ranks]
    finally:
        for process in ranks:
            process.kill()
            process.wait()
