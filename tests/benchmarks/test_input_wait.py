"""The benchmark of input waiting runs."""

import subprocess
import sys
from pathlib import Path


def test_the_benchmark_of_input_waiting_runs() -> None:
    command = [sys.executable, "-m", "benchmarks.training.input_wait", "--quick", "--rounds", "1", "--threads", "1"]
    done = subprocess.run(
        [*command, "--device", "cpu", "--poses", "20"],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert all(f"  {way}" in done.stdout for way in ("device", "stream", "blocks")) and "%" in done.stdout
