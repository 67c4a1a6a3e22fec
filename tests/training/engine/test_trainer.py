"""Training that can be trusted: the same for any ranks and any interruption, and nothing lost when it fails."""

import json
import os
import shutil
import signal
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock

from datagen.common.errors import (
    CheckpointError,
    DatasetError,
    DsffnetError,
    RecipeError,
    StorageError,
    TrainingError,
    UnsafeFileError,
)
from datagen.generate import generate
from tests.support.disk import grow, small_disk
from tests.support.files import flip_bit
from tests.support.ranks import finish, start_ranks
from tests.support.recipes import tiny_dataset, tiny_training
from training.checkpoints.checkpoint import require_checkpoint
from training.engine import distributed as ranks
from training.engine.distributed import Ranks, alone_in
from training.engine.trainer import Due, train
from training.tracking.journal import read_journal


def losses(run: Path) -> torch.Tensor:
    return torch.tensor([row["loss/total"] for row in read_journal(run / "metrics.jsonl")], dtype=torch.float64)


def weights(run: Path) -> dict[str, torch.Tensor]:
    return require_checkpoint(run).weights()


def same_bits(first: Path, second: Path) -> bool:
    one, other = weights(first), weights(second)
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def undisturbed(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; tests that change it copy it."""
    run = tmp_path_factory.mktemp("undisturbed") / "run"
    assert train(tiny_training(), data=str(_pristine), run=run) == 8
    return run


def test_it_learns(dataset: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(tiny_training(steps=60, learning_rate=0.02, evaluate_every=60, checkpoint_every=60), data=dataset, run=run)
    assert losses(run)[-10:].mean() < 0.5 * losses(run)[:5].mean()


def test_a_lock_that_is_a_link_makes_nothing_elsewhere(dataset: str, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".lock").symlink_to(tmp_path / "made")
    with pytest.raises(UnsafeFileError, match="link"):
        train(tiny_training(), data=dataset, run=tmp_path / "run")
    assert not (tmp_path / "made").exists()


def test_the_journal_holds_every_step_and_the_probe(undisturbed: Path) -> None:
    rows = read_journal(undisturbed / "metrics.jsonl")
    assert [row["step"] for row in rows] == list(range(1, 9))
    needed = {"loss/reconstruction", "loss/edge", "gradient_norm", "learning_rate", "meshes_per_second", "input_wait"}
    assert all(needed <= row.keys() for row in rows)
    assert [row["step"] for row in rows if "evaluation/pmd_unseen" in row] == [4, 8]


def test_stop_and_resume_equals_uninterrupted_to_the_bit(dataset: str, undisturbed: Path, tmp_path: Path) -> None:
    stopped = tmp_path / "stopped"
    shutil.copytree(undisturbed, stopped)
    shutil.rmtree(stopped / "checkpoints" / "step-00000008")
    assert require_checkpoint(stopped).step == 4
    train(tiny_training(), data=dataset, run=stopped)
    assert same_bits(stopped, undisturbed)
    assert torch.equal(losses(stopped), losses(undisturbed))


def test_blocks_are_resumed_to_the_bit_by_any_cache_and_are_no_other_runs(dataset: str, tmp_path: Path) -> None:
    recipe = tiny_training(block="0.03MB")
    train(recipe, data=dataset, run=tmp_path / "whole")
    shutil.copytree(tmp_path / "whole", tmp_path / "stopped")
    shutil.rmtree(tmp_path / "stopped" / "checkpoints" / "step-00000008")
    train(tiny_training(block="0.03MB", cache="stream"), data=dataset, run=tmp_path / "stopped")
    assert same_bits(tmp_path / "stopped", tmp_path / "whole")
    with pytest.raises(RecipeError, match=r"training.block: 0.03MB there, None here"):
        train(tiny_training(), data=dataset, run=tmp_path / "whole")


def test_a_damaged_newest_checkpoint_costs_only_the_steps_since_the_one_before(
    dataset: str, undisturbed: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(undisturbed, damaged)
    flip_bit(damaged / "checkpoints" / "step-00000008" / "weights.safetensors")
    train(tiny_training(), data=dataset, run=damaged)
    assert same_bits(damaged, undisturbed)
    for name in ("step-00000004", "step-00000008"):
        flip_bit(damaged / "checkpoints" / name / "weights.safetensors")
    train(tiny_training(), data=dataset, run=damaged)
    assert caplog.text.count("no sound checkpoint is left in") == 1 and "starts again from step 0" in caplog.text
    assert same_bits(damaged, undisturbed)


def test_a_finished_run_is_left_alone(dataset: str, undisturbed: Path) -> None:
    before = (undisturbed / "metrics.jsonl").read_bytes()
    assert train(tiny_training(), data=dataset, run=undisturbed) == 8
    assert (undisturbed / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize("optimiser", ["adamw", "muon"])
def test_nan_on_one_rank_stops_both_before_the_step(
    optimiser: str, dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAULT_RANK", "1")
    monkeypatch.setenv("FAULT_STEP", "7")
    recipe = tiny_training(launcher="ray", ranks=2, optimiser=optimiser)
    started = start_ranks(recipe, data=dataset, run=tmp_path / "run", count=2, module="tests.support.ranks.faulty_rank")
    (first, said), (second, said_by_culprit) = finish(started)
    assert first and second
    assert "not finite at step 7 (on another rank)" in said
    assert "not finite at step 7 (this rank's examples were [[" in said_by_culprit
    assert "The last good checkpoint is kept" in said_by_culprit
    assert require_checkpoint(tmp_path / "run").step == 4
    assert all(torch.isfinite(value).all() for value in weights(tmp_path / "run").values())


@pytest.mark.slow
def test_sigkill_of_a_rank_ends_the_other_and_a_restart_ends_equal(dataset: str, tmp_path: Path) -> None:
    recipe = tiny_training(launcher="ray", ranks=2, steps=400, log_every=1, checkpoint_every=20)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    finish(start_ranks(recipe, data=dataset, run=whole, count=2))
    started = start_ranks(recipe, data=dataset, run=killed, count=2)
    while not list((killed / "checkpoints").glob("step-*")):
        time.sleep(0.01)
    started[1].kill()
    (status, said), (of_the_killed, _) = finish(started, timeout=60)
    assert of_the_killed == -signal.SIGKILL and status == 1 and "Traceback" not in said
    assert said.splitlines()[-1].startswith("error: another rank has ended") and "same command again" in said
    assert [status for status, _ in finish(start_ranks(recipe, data=dataset, run=killed, count=2))] == [0, 0]
    assert same_bits(killed, whole)


def test_sigterm_finishes_the_step_and_checkpoints(dataset: str, tmp_path: Path) -> None:
    run, recipe = tmp_path / "run", tiny_training(steps=100_000, checkpoint_every=100_000)
    (rank,) = started = start_ranks(recipe, data=dataset, run=run, count=1)
    while not read_journal(run / "metrics.jsonl"):
        time.sleep(0.05)
    began = time.monotonic()
    rank.terminate()
    ((status, output),) = finish(started, timeout=30)
    assert status == 143 and "stopped at step" in output, output
    assert time.monotonic() - began < 15
    assert require_checkpoint(run).step == read_journal(run / "metrics.jsonl")[-1]["step"]


def test_disk_full_at_checkpoint_time(dataset: str, tmp_path: Path) -> None:
    """On a real file system that fills up: one error, and the last good checkpoint stays."""
    recipe = tiny_training(steps=40, keep_checkpoints=40)
    with small_disk(tmp_path / "disk", kibibytes=200) as disk:
        with pytest.raises(StorageError, match=r"could not write .*step-0000.*Earlier checkpoints are kept"):
            train(recipe, data=dataset, run=disk / "run")
        kept = require_checkpoint(disk / "run")
        assert kept.step >= 4 and not list((disk / "run" / "checkpoints").glob(".partial-*"))
        grow(disk, kibibytes=20_000)
        assert train(recipe, data=dataset, run=disk / "run") == 40


def test_all_ranks_start_from_the_checkpoint_that_rank_0_chooses(dataset: str, tmp_path: Path) -> None:
    """While the ranks wait for a dying driver's rank 0 to let go, it writes one more checkpoint."""
    recipe = tiny_training(launcher="ray", ranks=2, steps=12)
    whole, run = tmp_path / "whole", tmp_path / "run"
    finish(start_ranks(recipe, data=dataset, run=whole, count=2))
    newest = whole / "checkpoints" / "step-00000008"
    shutil.copytree(whole, run)
    for name in ("step-00000008", "step-00000012"):
        shutil.rmtree(run / "checkpoints" / name)
    with FileLock(run / ".lock"):
        started = start_ranks(recipe, data=dataset, run=run, count=2)
        time.sleep(6)
        shutil.copytree(newest, run / "checkpoints" / newest.name)
    assert [status for status, _ in finish(started)] == [0, 0]
    assert same_bits(run, whole)


def test_a_run_that_is_in_use_fails_on_every_rank(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DSFFNET_LOCK_SECONDS", "1")
    (tmp_path / "run").mkdir()
    with FileLock(tmp_path / "run" / ".lock"):
        recipe = tiny_training(launcher="ray", ranks=2)
        results = finish(start_ranks(recipe, data=dataset, run=tmp_path / "run", count=2), timeout=60)
    assert all(status == 1 and "another process is training in" in output for status, output in results), results


@pytest.mark.parametrize(
    ("step", "owes"),
    [
        (1, ""),
        (3, "check log"),
        (4, "check log validate"),
        (5, "picture"),
        (6, "check log"),
        (7, "check checkpoint"),
        (8, "check log validate"),
        (11, "check log validate checkpoint"),
        (16, "check log validate"),
        (32, "check log validate"),
        (35, "check picture checkpoint"),
    ],
)
def test_what_a_step_owes(step: int, owes: str) -> None:
    """A validation is logged, whatever else is; the last step, 11 here, owes all but a picture."""
    recipe = tiny_training(steps=40, log_every=3, evaluate_every=4, picture_every=5, checkpoint_every=7)
    due = Due.after(step, recipe, last_step=11 if step == 11 else 40, check_every=16)
    assert " ".join(name for name, is_due in asdict(due).items() if is_due) == owes


def test_a_gpu_is_looked_at_now_and_then() -> None:
    recipe = tiny_training(steps=400, log_every=400, evaluate_every=400, checkpoint_every=400)
    assert [s for s in range(1, 50) if Due.after(s, recipe, last_step=400, check_every=16).check] == [16, 32, 48]


def test_validations_come_when_they_are_due_whatever_is_logged(dataset: str, tmp_path: Path) -> None:
    train(tiny_training(steps=10, log_every=3, evaluate_every=4), data=dataset, run=tmp_path / "run")
    rows = read_journal(tmp_path / "run" / "metrics.jsonl")
    assert [row["step"] for row in rows if "evaluation/pmd_seen" in row] == [4, 8, 10]


def test_another_dataset_or_recipe_is_refused(dataset: str, undisturbed: Path, tmp_path: Path) -> None:
    other = str(tmp_path / "other.zarr")
    generate(tiny_dataset(poses={"seen": 7, "unseen": 4}), other)
    with pytest.raises(CheckpointError, match="was trained on dataset"):
        train(tiny_training(), data=other, run=undisturbed)
    with pytest.raises(RecipeError, match=r"training.learning_rate: 0.003 there, 0.1 here.*--fresh"):
        train(tiny_training(learning_rate=0.1), data=dataset, run=undisturbed)
    assert train(tiny_training(log_every=3, keep_checkpoints=1), data=dataset, run=undisturbed) == 8


def test_a_damaged_dataset_is_refused(spoilable: Path, tmp_path: Path) -> None:
    flip_bit(spoilable / "grid/training/0/vertices/c/1/0/0/0")
    with pytest.raises(DatasetError, match=r"grid/training/0/vertices/c/1/0/0/0 is damaged.*verify .* --repair"):
        train(tiny_training(), data=str(spoilable), run=tmp_path / "run")


def test_two_trainings_in_one_run(dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranks, "LOCK_SECONDS", 0)
    with (
        alone_in(tmp_path / "run", Ranks(0, 1, 0)),
        pytest.raises(TrainingError, match="another process is training in"),
    ):
        train(tiny_training(), data=dataset, run=tmp_path / "run")


def test_training_in_bfloat16_reaches_the_same_loss(dataset: str, tmp_path: Path, undisturbed: Path) -> None:
    train(tiny_training(precision="bfloat16"), data=dataset, run=tmp_path / "run")
    rounded, exact = losses(tmp_path / "run"), losses(undisturbed)
    assert not np.array_equal(rounded, exact) and np.allclose(rounded, exact, rtol=0.02)


@pytest.mark.parametrize("network", [{"name": "npt", "encoder_widths": (8, 8, 13)}, {"name": "corenet3d"}])
def test_the_baselines_learn_by_the_same_trainer(dataset: str, tmp_path: Path, network: dict) -> None:
    if network["name"] == "corenet3d":
        network |= {"feature_widths": (8, 8, 16), "generator_widths": (16, 16, 8)}
    train(tiny_training(network=network, steps=30), data=dataset, run=tmp_path / "run")
    found = losses(tmp_path / "run")
    assert np.isfinite(found).all() and found[-5:].mean() < found[:5].mean()


def test_ranks_that_cannot_share_the_batch() -> None:
    with pytest.raises(ValueError, match="batch 4 cannot be shared equally by 3 ranks"):
        tiny_training(launcher="ray", ranks=3)


def test_cuda_where_there_is_none(dataset: str, tmp_path: Path) -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(DsffnetError, match=r"torch sees no CUDA device\. Set training\.device=cpu"):
        train(tiny_training(device="cuda"), data=dataset, run=tmp_path / "run")


GOLDEN = Path(__file__).parents[2] / "golden" / "loss_curve.json"


def test_golden_loss_curve(undisturbed: Path) -> None:
    """A change that should not change numbers proves it. After a meant change: REGENERATE=1 pytest -k golden_loss"""
    found = losses(undisturbed).tolist()
    if os.environ.get("REGENERATE"):
        GOLDEN.write_text(json.dumps(found, indent=1) + "\n")
    assert found == pytest.approx(json.loads(GOLDEN.read_text()), rel=1e-4)
