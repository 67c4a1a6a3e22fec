"""The benchmarks run: on a GPU machine there is no time to find out that they do not."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200, check=False)


def test_the_gpu_benchmark_runs_at_small_scale_on_a_cpu() -> None:
    done = run("benchmarks.gpu", "--device", "cpu", "--vertices", "60", "--batches", "2", "--narrow")
    assert done.returncode == 0, done.stderr
    assert "batch 2 x 60 vertices" in done.stdout and "fast     bfloat16" in done.stdout and "one pair" in done.stdout


def test_the_network_benchmark_runs() -> None:
    done = run("benchmarks.networks", "--quick", "--threads", "1")
    assert done.returncode == 0, done.stderr
    assert "DSFFNet, quickstart" in done.stdout and "losses" in done.stdout
