"""What a person reads about a training, and the time that is left."""

from typing import Any

import pytest

from training.tracking.progress import Progress, duration

BEFORE = {"step": 1199, "time": 0.0, "evaluation/pmd_unseen": 11.9e-4}
ROW = {
    "step": 1200, "time": 4500 / 158_800, "loss/total": 0.012345, "evaluation/pmd_unseen": 12.34e-4,
    "meshes_per_second": 812.3, "input_wait": 0.041,
}  # fmt: skip


def line_of(*rows: dict[str, Any], width: int | None = None, **lengths: int) -> str:
    progress = Progress(**lengths)
    for row in rows:
        progress.add(row)
    return progress.line(width)


def test_every_part_in_its_place() -> None:
    assert line_of(BEFORE, ROW, steps=160_000, steps_per_epoch=800) == (
        "epoch 2/200, step 1,200/160,000, loss 0.01235, PMD unseen 12.3e-4, best 11.9e-4, 812 meshes/s, "
        "input wait 4%, 1 h 15 min left"
    )


@pytest.mark.parametrize(("change", "gone"), [({"input_wait": 0.02}, "input wait"), ({"step": 160_000}, "left")])
def test_what_does_not_matter_is_left_out(change: dict[str, float], gone: str) -> None:
    line = line_of(BEFORE, ROW, steps=160_000)
    assert gone in line and gone not in line_of(BEFORE, ROW | change, steps=160_000)


def test_a_row_of_nothing_but_a_step_and_one_that_is_not_finite() -> None:
    assert line_of({"step": 0}, steps=10, steps_per_epoch=5) == "epoch 1/2, step 0/10"
    assert line_of({"step": 10, "loss/total": float("nan")}, steps=10) == "step 10/10, loss nan"


@pytest.mark.parametrize("width", [32, 45, 60, 90, 200])
def test_it_fits_and_step_and_time_left_are_never_lost(width: int) -> None:
    line = line_of(BEFORE, ROW | {"time": 61 / 7800}, steps=9000, steps_per_epoch=800, width=width)
    assert len(line) <= width and "step 1,200/9,000" in line and "1 min 1 s left" in line


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (59.6, "1 min"), (200, "3 min 20 s"), (7500, "2 h 5 min"), (3600, "1 h"), (100_800, "1 d 4 h")],
)
def test_times_in_their_two_largest_units(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def fed(progress: Progress, rows: list[tuple[int, float]], **more: float) -> Progress:
    for step, moment in rows:
        progress.add({"step": step, "time": moment, **more})
    return progress


def test_time_left_comes_from_the_recent_rate() -> None:
    progress = fed(Progress(steps=10_000), [(step, step * 1.0) for step in range(0, 3000, 10)])
    fed(progress, [(2990 + step, 2990 + step * 0.5) for step in range(10, 1010, 10)])  # twice as fast from here
    assert progress.step == 3990 and progress.seconds_left() == pytest.approx(6010 * 0.5)


def test_a_resumed_training_is_timed_by_its_own_steps() -> None:
    """The journal's past was slow, days ago; steps between checkpoint and journal's end are done again unwritten."""
    progress = Progress(steps=1000)
    for step in range(0, 500, 20):
        progress.add({"step": step, "time": step * 9.0, "evaluation/pmd_unseen": 3e-4}, past=True)
    assert progress.seconds_left() is None and "left" not in progress.line() and "480/1,000" in progress.line()
    fed(progress, [(500, 1e6)])
    assert progress.seconds_left() is None
    fed(progress, [(520, 1e6 + 2), (540, 1e6 + 4)], **{"evaluation/pmd_unseen": 5e-4})
    assert progress.seconds_left() == pytest.approx(46)
    assert "PMD unseen 5.0e-4, best 3.0e-4" in progress.line()


def test_ranks_that_died_and_came_back_do_not_count_and_evaluations_do() -> None:
    rows = [(step, step * 0.1) for step in range(0, 200, 20)]
    restarted = [(step, step * 0.1 + 100) for step in range(200, 400, 20)]
    assert fed(Progress(steps=1000), rows + restarted).seconds_left() == pytest.approx(620 * 0.1)
    progress = fed(Progress(steps=1000), rows)
    progress.add({"step": 200, "time": 120.0, "evaluation/pmd_unseen": 1e-3})
    assert progress.seconds_left() == pytest.approx(800 * 120 / 200)


@pytest.mark.parametrize("jump", [-86_400.0, 86_400.0])
def test_a_clock_that_is_put_back_or_forward_does_not_count(jump: float) -> None:
    rows = [(step, step * 0.1) for step in range(0, 200, 20)]
    after = [(step, step * 0.1 + jump) for step in range(200, 400, 20)]
    progress = fed(Progress(steps=1000), rows + after)
    assert progress.seconds_left() == pytest.approx(620 * 0.1) and "1 min 2 s left" in progress.line()


def test_nothing_to_say_before_the_first_row() -> None:
    assert Progress(steps=5).line() == "" and Progress(steps=5).seconds_left() is None
