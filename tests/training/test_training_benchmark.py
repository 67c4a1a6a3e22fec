"""The benchmark of ranks against threads runs."""

import re
import subprocess
import sys
from pathlib import Path


def test_the_benchmark_of_ranks_against_threads_runs() -> None:
    command = [sys.executable, "-m", "benchmarks.training", "--quick"]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    two, one, ratio = map(float, re.findall(r"round 0 +([\d.]+) +([\d.]+) +([\d.]+)", done.stdout)[0])
    assert two > 0 and one > 0 and abs(ratio - two / one) < 0.02 + 0.1 / one
    assert "median ratio" in done.stdout
