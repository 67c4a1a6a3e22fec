"""Ranks as processes of their own over gloo, as torchrun would start them, with a bound on how long they may take."""

import json
import multiprocessing
import os
import runpy
import socket
import sys
from collections.abc import Sequence
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import yaml

from training.recipes.training import TrainingRecipe

ROOT = Path(__file__).parents[3]
_LIBRARIES = ["torch._dynamo", "scipy.optimize", "scipy.spatial", "zarr", "pydantic", "yaml", "matplotlib.figure"]
multiprocessing.set_forkserver_preload(_LIBRARIES)


def free_port() -> int:
    """A TCP port that nobody listens on at the moment."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Forked(ForkServerProcess):
    """``python -m MODULE ARGUMENTS`` begun within milliseconds, as a copy of a process that has imported the libraries.

    The packages of this repository are imported anew in each; environment, signals and status are its own, but for
    variables that libraries read as they are imported. What it prints goes to the file ``output``.
    """

    def __init__(self, words: Sequence[str], output: Path, **environment: str) -> None:
        super().__init__(daemon=True)
        self.output, self._words, self._environment = output, list(words), {**os.environ, **environment}
        self.start()

    def run(self) -> None:
        with open(self.output, "w", encoding="utf-8") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        os.environ.clear()
        os.environ.update(self._environment)
        os.chdir(ROOT)
        sys.argv = self._words
        runpy.run_module(self._words[0], run_name="__main__", alter_sys=True)


def start_ranks(
    recipe: TrainingRecipe,
    *,
    data: str,
    run: Path,
    count: int,
    module: str = "training.engine",
) -> list[Forked]:
    """Start ``count`` ranks of ``python -m module RECIPE DATA RUN``."""
    run.parent.mkdir(parents=True, exist_ok=True)
    path = run.parent / f"{run.name}-recipe.yaml"
    path.write_text(yaml.safe_dump(recipe.model_dump(mode="json")))
    return _started([module, str(path), data, str(run)], count, run.parent)


def _started(words: Sequence[str], count: int, place: Path) -> list[Forked]:
    shared = {
        "WORLD_SIZE": str(count),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(free_port()),
        "OMP_NUM_THREADS": "1",
    }
    outputs = [place / f"{Path(words[-1]).name}-{rank}.log" for rank in range(count)]
    return [
        Forked(words, output, **shared, RANK=str(rank), LOCAL_RANK=str(rank)) for rank, output in enumerate(outputs)
    ]


def train_in_turn(jobs: Sequence[tuple[TrainingRecipe, Path]], *, data: str, place: Path, count: int = 2) -> None:
    """Train every (recipe, run) by one group of ranks, one after the other; starting a group takes seconds."""
    path = place / "jobs.json"
    path.write_text(json.dumps([[recipe.model_dump(mode="json"), data, str(run)] for recipe, run in jobs]))
    results = finish(_started(["tests.support.ranks", str(path)], count, place))
    assert [status for status, _ in results] == [0] * count, results


def finish(ranks: list[Forked], *, timeout: float = 120) -> list[tuple[int, str]]:
    """Exit status and output of each rank; all are killed if one hangs."""
    try:
        for process in ranks:
            process.join(timeout)
        assert all(process.exitcode is not None for process in ranks), f"not at an end after {timeout} s"
        return [(process.exitcode, process.output.read_text()) for process in ranks]
    finally:
        for process in ranks:
            process.kill()
            process.join()
