"""A training or an evaluation that no memory could hold is refused before it takes any; one that runs out says so."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from datagen.common.errors import OutOfMemory, RecipeError
from datagen.generate import inline
from datagen.store import open_dataset
from tests.support.commands import ROOT
from tests.support.recipes import tiny_training
from training.checkpoints.checkpoint import require_checkpoint
from training.data.cache_policy import Room
from training.engine.tasks.transfer.step_memory import require_step_memory
from training.engine.train_step import Learner
from training.engine.trainer import train
from training.evaluation import evaluate as evaluation
from training.evaluation import measure as measuring
from training.evaluation.evaluate import Method, evaluate
from training.recipes.training import EvaluationRecipe, TrainingRecipe


def require(dataset: str, free: float, *, ranks: int = 1, here: int = 1, **changes: Any) -> None:
    room = Room("memory", int(free), 0.5, sharers=here)
    require_step_memory(tiny_training(**changes), open_dataset(dataset), room, ranks=ranks)


@pytest.mark.parametrize(
    "network",
    [
        {"encoder_widths": (8, 8, 10**12)},
        {"decoder_widths": (2**62, 2**62, 2**62)},
        {"decoder_widths": (100_000, 100_000, 8)},
    ],
    ids=str,
)
def test_widths_beyond_memory_are_refused_before_the_network_is_made(network: dict[str, Any], dataset: str) -> None:
    with pytest.raises(RecipeError, match=r"the memory has 20.0 GB free. Lower training.network's widths") as raised:
        require(dataset, 20e9, network=network)
    assert "\n" not in str(raised.value)


def test_a_training_looks_at_the_memory_that_there_is(dataset: str, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"the memory has .* free. Lower training.network's widths"):
        train(tiny_training(network={"encoder_widths": (8, 8, 10**12)}), data=dataset, run=tmp_path / "run")


def test_a_batch_beyond_memory_is_refused_unless_it_is_shared(dataset: str) -> None:
    meshes, channels, float32, held = 16, 6 * 8, 4, 3
    free = float32 * held * meshes * 32 * channels - 1
    with pytest.raises(RecipeError, match=r"16 meshes of 32 vertices .* training.batch, or raise training.accumulate"):
        require(dataset, free, batch=16)
    require(dataset, free, batch=16, accumulate=2)
    require(dataset, free, batch=16, ranks=2)
    with pytest.raises(RecipeError, match="8 meshes"):
        require(dataset, free, batch=16, ranks=2, here=2)  # both on this machine


def test_every_recipe_of_ours_has_room_in_a_gigabyte_for_a_small_mesh(dataset: str) -> None:
    require_step_memory(TrainingRecipe(), open_dataset(dataset), Room("memory", 10**9, 0.5))


def test_memory_that_runs_out_in_a_step_is_one_error_and_the_checkpoint_stays(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, steps = Learner.step, iter(range(100))

    def runs_out(self: Learner, *arguments: Any, **more: Any) -> Any:
        if next(steps) == 5:
            torch.empty(1 << 55)
        return step(self, *arguments, **more)

    monkeypatch.setattr(Learner, "step", runs_out)
    with pytest.raises(OutOfMemory, match=r"^memory ran out \(.*\). The last .* Lower training.batch \(it is 4\)"):
        train(tiny_training(), data=dataset, run=tmp_path / "run")
    assert require_checkpoint(tmp_path / "run").step == 4
    monkeypatch.undo()
    assert train(tiny_training(), data=dataset, run=tmp_path / "run") == 8


def test_the_distance_of_too_many_points_is_refused(dataset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "free_memory", lambda: 16 * 32**2 - 1)
    with pytest.raises(RecipeError, match=r"of 32 points takes 16.4 kB .* Lower evaluation.emd_points \(it is 1,024\)"):
        evaluate([], dataset, EvaluationRecipe(), tasks=inline)
    assert evaluate([], dataset, EvaluationRecipe(emd_points=8), tasks=inline)


def test_memory_that_runs_out_in_a_task_says_what_to_lower(dataset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def runs_out(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(measuring, "read_batch", runs_out)
    with pytest.raises(OutOfMemory, match=r"MemoryError\). Lower evaluation.chunk \(it is 25\)"):
        evaluate([Method("none", "")][:0], dataset, EvaluationRecipe(), tasks=inline)


@pytest.mark.slow
def test_under_a_real_limit_of_memory_the_command_ends_with_one_line(dataset: str, tmp_path: Path) -> None:
    """The limit is 200 MB above what the process has when training begins; a step of these widths takes 800."""
    program = (
        "import psutil, resource, sys; from training.engine import launch, trainer\n"
        "from training.engine.train_step import Learner\n"
        "step = Learner.step\n"
        "def limited(self, *arguments, **more):\n"
        "    most = psutil.Process().memory_info().vms + 200_000_000\n"
        "    resource.setrlimit(resource.RLIMIT_AS, (most, most))\n"
        "    return step(self, *arguments, **more)\n"
        "Learner.step = limited\n"
        "launch.main()\n"
    )
    wide = tiny_training(network={"encoder_widths": (64, 128, 2048), "decoder_widths": (2048, 2048, 256)}, batch=16)
    (tmp_path / "r.json").write_text(wide.model_dump_json(), encoding="utf-8")
    command = [sys.executable, "-c", program, tmp_path / "r.json", dataset, tmp_path / "run"]
    done = subprocess.run(
        list(map(str, command)), cwd=ROOT, capture_output=True, encoding="utf-8", timeout=120, check=False
    )
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: memory ran out (")
