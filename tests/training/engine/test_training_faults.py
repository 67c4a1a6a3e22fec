"""Training on Ray nodes, one of which is lost: an elastic group goes on with what is left."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from training.checkpoints.checkpoint import require_checkpoint
from training.tracking.journal import read_journal

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(420)]
ROOT = Path(__file__).parents[3]

_DRIVER = """
import sys, ray
from pathlib import Path
from tests.support.recipes import tiny_training
from training.engine.launch import launch
ray.init(address=sys.argv[3], log_to_driver=False)
recipe = tiny_training(launcher="ray", ranks=2, fewest_ranks=1, steps=int(sys.argv[4]), checkpoint_every=50,
                       evaluate_every=1000, timeout=30)
launch(recipe, data=sys.argv[1], run=Path(sys.argv[2]))
"""


def steps_done(run: Path) -> int:
    return max((row["step"] for row in read_journal(run / "metrics.jsonl")), default=0)


def test_loss_of_a_node_in_training(dataset: str, tmp_path: Path) -> None:
    from ray.cluster_utils import Cluster

    run, last = tmp_path / "run", 3000
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        lost = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        kept = {n: value for n, value in os.environ.items() if not n.startswith("RAY_") or n == "RAY_AUTH_MODE"}
        driver = subprocess.Popen(
            [sys.executable, "-c", _DRIVER, dataset, str(run), cluster.address, str(last)],
            cwd=ROOT,
            env={**kept, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        end = time.monotonic() + 150
        while steps_done(run) < 200:
            assert driver.poll() is None and time.monotonic() < end, driver.communicate(timeout=5)[0]
            time.sleep(0.05)
        cluster.remove_node(lost, allow_graceful=False)
        assert steps_done(run) < last, "work is left when the node goes"
        said, _ = driver.communicate(timeout=240)
        assert driver.returncode == 0, said
    finally:
        cluster.shutdown()
    rows = [row["step"] for row in read_journal(run / "metrics.jsonl")]
    assert rows == list(range(1, last + 1)), "neither gaps nor duplicates"
    assert require_checkpoint(run).finished
