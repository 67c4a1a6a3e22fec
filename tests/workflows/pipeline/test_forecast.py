"""How long trainings take is tried and said before anything is made, where this machine's CPU does them."""

from typing import Any

import pytest
import torch

from tests.support.recipes import PARTS, tiny_training
from training.engine import step_time
from training.engine.step_time import StepTime, seconds_a_step
from training.recipes.training import TrainingRecipe
from training.tracking.provenance import cores
from workflows.pipeline import forecast
from workflows.pipeline.forecast import announce_times
from workflows.recipe.loader import load_recipe

LONG = tiny_training(steps=30_000, batch=8, device="cpu")


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The vertices of the meshes that steps were tried with; a step takes 0.01 s."""
    return trying(monkeypatch, StepTime(0.012, 0.01))


def trying(monkeypatch: pytest.MonkeyPatch, found: StepTime) -> list[int]:
    """Let steps that are tried take so long; the vertices that they were tried with."""
    seen: list[int] = []

    def seconds(recipe: TrainingRecipe, *, vertices: int) -> StepTime:
        seen.append(vertices)
        return found

    monkeypatch.setattr(step_time, "seconds_a_step", seconds)
    monkeypatch.setattr(forecast, "on_cluster", lambda: False)
    return seen


def test_each_training_and_all_of_them_are_told_in_minutes(
    tried: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = load_recipe("smoke", [])
    announce_times(recipe.data, {"train": LONG, "train-beside": LONG.model_copy(update={"steps": 60_000})})
    said = [line.partition("] ")[2] for line in capsys.readouterr().out.splitlines()]
    assert tried == [96, 96]
    assert said[0] == "train: trying a few steps, to tell how long 30,000 will take here"
    assert said[1] == "train: about 5 min, 0.01 s a step" and said[3] == "train-beside: about 10 min, 0.01 s a step"
    assert said[4].startswith("trainings: about 15 min in all;") and len(said) == 5


def test_a_busy_machine_is_told_of_beside_what_it_would_take_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trying(monkeypatch, StepTime(0.1, 0.01))
    announce_times(load_recipe("smoke", []).data, {"train": LONG})
    *_, train, total = (line.partition("] ")[2] for line in capsys.readouterr().out.splitlines())
    assert train == "train: about 5 min, 0.01 s a step"
    alone_and_now = "about 5 min in all if this machine does nothing else, about 50 min while it is as busy as now;"
    assert total.startswith(f"trainings: {alone_and_now}")


def test_what_a_step_waits_for_others_is_not_its_own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, own = iter(range(1000)), iter(float(n) / 4 for n in range(1000))
    monkeypatch.setattr(step_time, "_SECONDS", 0.0)
    monkeypatch.setattr(step_time, "_MORE", 1.0)
    monkeypatch.setattr(step_time.time, "perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr(step_time.time, "thread_time", lambda: next(own))
    assert seconds_a_step(tiny_training(batch=2), vertices=20) == StepTime(1 + 1, 0.25 + 0.25)


@pytest.mark.parametrize("case", ["short", "on a GPU", "on a cluster", "vertices that only files tell"])
def test_what_cannot_be_told_or_is_over_soon_is_not_tried(
    case: str, tried: list[int], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(forecast, "on_cluster", lambda: case == "on a cluster")
    body = ["data.body={family: smpl, path: SMPL.npz}"] if case == "vertices that only files tell" else []
    changes = {"short": {"steps": 10}, "on a GPU": {"device": "auto"}}.get(case, {})
    announce_times(load_recipe("smoke", body).data, {"train": LONG.model_copy(update=changes)})
    assert tried == [] and capsys.readouterr().out == ""


@pytest.mark.parametrize("optimiser", ["adamw", "muon"])
@pytest.mark.parametrize("changes", [{"augmentation": {"subset": 20}}, PARTS], ids=["dsffnet", "parts"])
def test_steps_of_every_kind_are_tried_and_nothing_of_it_stays(
    changes: dict[str, Any], optimiser: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_time, "_SECONDS", 0.0)
    recipe = tiny_training(**changes, edge_weight=0, optimiser=optimiser, batch=2, ranks=2, launcher="ray")
    before, more = torch.get_num_threads(), cores() + 1
    torch.set_num_threads(more)
    assert min(seconds_a_step(recipe, vertices=20)) > 0
    after = torch.get_num_threads()
    torch.set_num_threads(before)
    assert after == more


def test_examples_that_are_too_many_to_try_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr(step_time, "_SECONDS", 0.0)
    monkeypatch.setattr(step_time, "_VERTICES", 40)
    monkeypatch.setattr(step_time, "_MORE", 1.0)
    monkeypatch.setattr(step_time.time, "perf_counter", lambda: float(next(clock)))
    few, many = (seconds_a_step(tiny_training(batch=batch), vertices=20).now for batch in (2, 8))
    assert (few, many) == (1 + 1, 4 + 1)  # one second each way, forward and back of a batch of two, the optimiser


@pytest.mark.parametrize(("ranks", "seconds"), [(1, 1 + 1), (2, 1 + 1 / 2)])
def test_ranks_share_the_time_that_moving_matrices_takes(
    ranks: int, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr(step_time, "_SECONDS", 0.0)
    monkeypatch.setattr(step_time.time, "perf_counter", lambda: float(next(clock)))
    recipe = tiny_training(optimiser="muon", batch=2, ranks=ranks, launcher="ray")
    assert step_time._tried(recipe, 1, 1.0, 20).now == seconds
