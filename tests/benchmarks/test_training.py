"""The benchmark of ranks against threads runs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.training.ranks import QUICKSTART, rate, recipe_of


def test_a_rank_that_fails_is_told_with_its_reason(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"rank 0 ended with 1: [^$]*nothing\.zarr"):
        rate(recipe_of(QUICKSTART, 4), tmp_path / "nothing.zarr", tmp_path / "run", ranks=1, threads=1)


@pytest.mark.slow  # five processes that import torch
def test_the_benchmark_of_ranks_against_threads_runs() -> None:
    command = [sys.executable, "-m", "benchmarks.training.ranks", "--quick"]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    two, one, ratio = map(float, re.findall(r"round 0 +([\d.]+) +([\d.]+) +([\d.]+)", done.stdout)[0])
    assert two > 0 and one > 0 and abs(ratio - two / one) < 0.02 + 0.1 / one
    assert "median ratio" in done.stdout
