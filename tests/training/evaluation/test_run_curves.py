"""Curves of runs: time is the journal's own."""

import numpy as np
import pytest

from training.evaluation.run_curves import RunCurve, run_curve

UNSEEN = "evaluation/pmd_unseen"


def test_seconds_come_from_the_throughput_so_that_a_pause_between_commands_does_not_count() -> None:
    rows = [
        {"step": 10, "time": 100.0, "meshes_per_second": 40.0},
        {"step": 20, "time": 102.0, "meshes_per_second": 40.0, UNSEEN: 0.3},
        {"step": 30, "time": 9000.0, "meshes_per_second": 80.0, UNSEEN: float("nan")},
        {"step": 40, "time": 9001.0, "meshes_per_second": 80.0, UNSEEN: 0.2},
    ]
    found = run_curve(rows, UNSEEN, batch=8, name="a")
    assert found.steps.tolist() == [20, 40] and found.pmd.tolist() == [0.3, 0.2]
    assert found.seconds == pytest.approx([4.0, 6.0])
    assert len(run_curve([], UNSEEN, batch=8)) == 0 and run_curve([], UNSEEN, batch=8).final == float("inf")


def test_the_first_evaluation_at_a_level_or_below_and_what_a_log_scale_shows() -> None:
    steps = np.arange(1.0, 5)
    found = RunCurve("a", steps, 2 * steps, np.array([0.5, 0.2, 0.4, 0.0]))
    assert found.first_reached(0.2) == (2.0, 4.0) and found.first_reached(-1) is None
    assert found.drawable.pmd.tolist() == [0.5, 0.2, 0.4] and found.drawable.seconds.tolist() == [2, 4, 6]
