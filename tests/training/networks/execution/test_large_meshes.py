"""From 300 to 30,000 vertices: the results of the equations, within the memory that is promised."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.support.three_networks import LITERAL, initial, lively, pair

ROOT = Path(__file__).parents[4]
MEASURE = """
import json
import sys
from pathlib import Path

import torch

from training.networks import NETWORKS

def peak():  # of this process alone: getrusage also counts the one that started it
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1024

torch.set_num_threads(1)
before, network = peak(), NETWORKS[sys.argv[1]](**json.loads(sys.argv[2])).eval()
with torch.no_grad():
    output = network(source=torch.rand(1, 28920, 3) * 2 - 1, target=torch.rand(1, 28920, 3) * 2 - 1)
assert output.shape == (1, 28920, 3) and torch.isfinite(output).all()
print(peak() - before)
"""


@torch.no_grad()
@pytest.mark.parametrize("form", LITERAL)
@pytest.mark.parametrize(("source", "target"), [(300, 30_000), (30_000, 300)])
def test_few_and_many_vertices_give_what_the_equations_give(form: str, source: int, target: int) -> None:
    network = lively(form).double().eval()
    inputs = pair(form, source=source, target=target, dtype=torch.float64)
    torch.testing.assert_close(network(**inputs), LITERAL[form](network)(**inputs), rtol=0, atol=1e-8)


@torch.no_grad()
@pytest.mark.parametrize("form", LITERAL)
@pytest.mark.parametrize("start", [initial, lively])
def test_float32_at_thirty_thousand_vertices_is_as_exact_as_the_equations_in_float32(form: str, start) -> None:
    network, inputs = start(form).eval(), pair(form, source=500, target=30_000)
    found, literal = network(**inputs).double(), LITERAL[form](network)(**inputs).double()
    exact = network.double()(**{name: mesh.double() for name, mesh in inputs.items()})
    as_the_equations = 4 * (literal - exact).square().mean()  # twice their error; measured 1.4
    two_roundings = (2 * torch.finfo(torch.float32).eps) ** 2  # some processors need but half a one
    assert (found - exact).square().mean() < as_the_equations.clamp_min(two_roundings)
    if start is initial:
        assert (found - exact).abs().max() < 1e-5


def _added_mebibytes(name: str, **options: tuple[int, ...]) -> float:
    """Return what a network adds at most to a process that has imported it, for one pair of 28,920 vertices each."""
    command = [sys.executable, "-c", MEASURE, name, json.dumps(options)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, done.stderr
    return float(done.stdout)


needs_proc = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from Linux's /proc")


@needs_proc
@pytest.mark.parametrize("name", ["dsffnet", "npt"])
def test_a_paper_sized_network_adds_less_than_700_mebibytes(name: str) -> None:
    assert 100 < _added_mebibytes(name) < 700


@needs_proc
@pytest.mark.slow
def test_3d_corenet_streams_a_matrix_that_would_take_3190_mebibytes() -> None:
    widths = {"feature_widths": (8, 8, 16), "generator_widths": (32, 16, 16)}  # of no weight in this, but for the time
    assert 10 < _added_mebibytes("corenet3d", **widths) < 400
