"""One step means the same however it is cut: over ranks, over parts, over interruptions, over vertex counts."""

import json
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from datagen.common.errors import BudgetSpent, CheckpointError, TrainingError
from datagen.generate import generate
from tests.support.ranks import finish, start_ranks, train_in_turn
from tests.support.recipes import PARTS, tiny_dataset, tiny_training
from training.checkpoints.checkpoint import require_checkpoint
from training.engine import trainer
from training.engine.train_step import Learner
from training.engine.trainer import train
from training.networks.corenet3d import CoreNet3D
from training.recipes.training import TrainingRecipe
from training.tracking.journal import read_journal

TEN = {"steps": 10, "checkpoint_every": 5, "evaluate_every": 10}


def losses(run: Path) -> torch.Tensor:
    return torch.tensor([row["loss/total"] for row in read_journal(run / "metrics.jsonl")], dtype=torch.float64)


def same_bits(first: Path, second: Path, *, average: bool = False) -> bool:
    one, other = (require_checkpoint(run).weights(average=average) for run in (first, second))
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


NETWORKS: dict[str, dict[str, Any]] = {
    "dsffnet": {"name": "dsffnet", "encoder_widths": (8, 8, 8), "decoder_widths": (8, 8, 8)},
    "npt": {"name": "npt", "encoder_widths": (8, 8, 13)},
    "corenet3d": {"name": "corenet3d", "feature_widths": (8, 8, 16), "generator_widths": (16, 16, 8)},
    "parts": PARTS["network"],
}


CUTS = {
    "dsffnet": ("float64", 1e-6),
    "dsffnet in float32": ("float32", 1e-4),
    "npt": ("float64", 1e-6),
    "corenet3d": ("float64", 1e-6),
    "parts": ("float64", 1e-6),
}
"""Networks trained by one rank, by one in parts and by two; the tolerance of their losses."""


def cut(name: str, **changes: Any) -> TrainingRecipe:
    given = {**TEN, "precision": CUTS[name][0], "average": 0.9, "network": NETWORKS[name.split(maxsplit=1)[0]]}
    if name == "parts":
        given |= {"augmentation": PARTS["augmentation"] | {"at_rest": True}, "optimiser": "muon"}
    return tiny_training(**given | changes)


@pytest.fixture(scope="module")
def by_two(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs by two ranks in two parts each; ``dsffnet resumed`` was begun by one rank, which did half of it."""
    place = tmp_path_factory.mktemp("two")
    resumed = place / "dsffnet resumed"
    train(cut("dsffnet"), data=str(_pristine), run=resumed)
    shutil.rmtree(resumed / "checkpoints" / "step-00000010")
    lines = (resumed / "metrics.jsonl").read_text().splitlines(keepends=True)
    (resumed / "metrics.jsonl").write_text("".join(lines[:5]))
    jobs = [(cut(name, launcher="ray", ranks=2, accumulate=2), place / name) for name in CUTS]
    jobs.append((cut("dsffnet", launcher="ray", ranks=2), resumed))
    train_in_turn(jobs, data=str(_pristine), place=place)
    return place


@pytest.mark.parametrize("name", CUTS)
def test_one_rank_equals_two_ranks_equals_parts(dataset: str, tmp_path: Path, by_two: Path, name: str) -> None:
    train(cut(name), data=dataset, run=tmp_path / "one")
    assert ("loss/at_rest" in read_journal(tmp_path / "one" / "metrics.jsonl")[0]) == (name == "parts")
    train(cut(name, accumulate=2), data=dataset, run=tmp_path / "parts")
    for run in (tmp_path / "parts", by_two / name):
        assert torch.allclose(losses(run), losses(tmp_path / "one"), rtol=CUTS[name][1], atol=0), run
        expected, found = (require_checkpoint(place).weights() for place in (tmp_path / "one", run))
        assert all(torch.allclose(found[key], value, rtol=0, atol=2e-4) for key, value in expected.items()), run


def test_a_run_of_one_rank_is_resumed_by_two(dataset: str, tmp_path: Path, by_two: Path) -> None:
    train(cut("dsffnet"), data=dataset, run=tmp_path / "whole")
    assert len(losses(by_two / "dsffnet resumed")) == 10
    assert torch.allclose(losses(by_two / "dsffnet resumed"), losses(tmp_path / "whole"), rtol=1e-6, atol=0)


def test_three_ranks_share_a_batch_of_four_unequally(dataset: str, tmp_path: Path) -> None:
    """As when an elastic group has lost a node."""
    given = {**TEN, "precision": "float64"}
    train(tiny_training(**given), data=dataset, run=tmp_path / "one")
    three = tiny_training(**given, launcher="ray", ranks=4, fewest_ranks=1)
    results = finish(start_ranks(three, data=dataset, run=tmp_path / "three", count=3))
    assert [status for status, _ in results] == [0, 0, 0], results
    assert torch.allclose(losses(tmp_path / "three"), losses(tmp_path / "one"), rtol=1e-6, atol=0)


@pytest.mark.slow
def test_four_ranks_then_two_then_four_learn_as_one(dataset: str, tmp_path: Path) -> None:
    """An elastic group that loses half of its machines and gets them back, in both orders of triples."""
    given = {"steps": 12, "checkpoint_every": 4, "evaluate_every": 12, "batch": 8, "precision": "float64"}
    orders: dict[str, dict[str, Any]] = {"shuffled": {}, "in blocks": {"block": "30kB", "cache": "stream"}}
    for name, order in orders.items():
        train(tiny_training(**given, **order), data=dataset, run=tmp_path / "one" / name)
    elastic = {**given, "launcher": "ray", "ranks": 4, "fewest_ranks": 2}
    jobs = [(tiny_training(**elastic, **order), tmp_path / name) for name, order in orders.items()]
    for ranks, until in ((4, 4), (2, 8), (4, 12)):
        train_in_turn(jobs, data=dataset, place=tmp_path, count=ranks)
        for folder in tmp_path.glob("*/checkpoints/step-*"):
            if int(folder.name.removeprefix("step-")) > until:
                shutil.rmtree(folder)
    for name in orders:
        one, found = tmp_path / "one" / name, tmp_path / name
        assert torch.allclose(losses(found), losses(one), rtol=1e-6, atol=0)
        expected, weights = (require_checkpoint(run).weights() for run in (one, found))
        assert all(torch.allclose(weights[key], value, rtol=0, atol=2e-4) for key, value in expected.items())


def test_a_spectral_norm_iterates_once_a_step_and_a_single_part_is_as_without(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {"network": NETWORKS["corenet3d"]}
    train(tiny_training(**given), data=dataset, run=tmp_path / "once")
    monkeypatch.delattr(CoreNet3D, "accumulation")
    train(tiny_training(**given), data=dataset, run=tmp_path / "by itself")
    assert same_bits(tmp_path / "once", tmp_path / "by itself")


def test_augmented_training_resumes_to_the_bit(dataset: str, tmp_path: Path) -> None:
    recipe = tiny_training(augmentation={"vertices": 0.7, "source_noise": 0.01})
    train(recipe, data=dataset, run=tmp_path / "whole")
    shutil.copytree(tmp_path / "whole", tmp_path / "stopped")
    shutil.rmtree(tmp_path / "stopped" / "checkpoints" / "step-00000008")
    train(recipe, data=dataset, run=tmp_path / "stopped")
    assert same_bits(tmp_path / "stopped", tmp_path / "whole")


@pytest.mark.parametrize("name, differs", [("dsffnet", False), ("npt", False), ("corenet3d", True)])
def test_the_order_of_vertices_matters_to_3d_corenet_alone(
    dataset: str, tmp_path: Path, name: str, differs: bool
) -> None:
    """Its generator has a kernel of three along the list of vertices."""
    given = {"network": NETWORKS[name], "precision": "float64", "steps": 4}
    train(tiny_training(**given), data=dataset, run=tmp_path / "listed")
    train(tiny_training(**given, augmentation={"shuffle": True}), data=dataset, run=tmp_path / "shuffled")
    same = torch.allclose(losses(tmp_path / "listed"), losses(tmp_path / "shuffled"), rtol=1e-9, atol=0)
    assert same != differs


def test_averaged_weights_resume_to_the_bit_and_are_what_is_evaluated(dataset: str, tmp_path: Path) -> None:
    whole, stopped, raw = (tmp_path / name for name in ("whole", "stopped", "raw"))
    train(tiny_training(average=0.9), data=dataset, run=whole)
    shutil.copytree(whole, stopped)
    shutil.rmtree(stopped / "checkpoints" / "step-00000008")
    train(tiny_training(average=0.9), data=dataset, run=stopped)
    assert same_bits(stopped, whole) and same_bits(stopped, whole, average=True)
    train(tiny_training(), data=dataset, run=raw)
    assert same_bits(raw, whole) and not same_bits(raw, whole, average=True)
    measured = [read_journal(run / "metrics.jsonl")[-1]["evaluation/pmd_unseen"] for run in (whole, raw)]
    assert measured[0] != measured[1]


def test_early_stopping_ends_the_run_for_good(dataset: str, tmp_path: Path) -> None:
    recipe = tiny_training(steps=400, learning_rate=1e-12, evaluate_every=2, early_stopping=3)
    reached = train(recipe, data=dataset, run=tmp_path / "run")
    assert reached < 400
    rows = (tmp_path / "run" / "metrics.jsonl").read_bytes()
    assert train(recipe, data=dataset, run=tmp_path / "run") == reached
    assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == rows
    assert require_checkpoint(tmp_path / "run").finished


def test_the_best_checkpoint_is_that_of_the_lowest_unseen_pmd(dataset: str, tmp_path: Path) -> None:
    recipe = tiny_training(steps=24, learning_rate=0.05, evaluate_every=2, checkpoint_every=8, keep_checkpoints=1)
    train(recipe, data=dataset, run=tmp_path / "run")
    rows = [row for row in read_journal(tmp_path / "run" / "metrics.jsonl") if "evaluation/pmd_unseen" in row]
    best = min(rows, key=lambda row: row["evaluation/pmd_unseen"])
    assert require_checkpoint(tmp_path / "run", "best").step == best["step"]


def test_a_time_budget_stops_with_a_checkpoint_and_the_same_command_goes_on(dataset: str, tmp_path: Path) -> None:
    recipe = tiny_training(steps=100_000, budget="1s", checkpoint_every=100_000, evaluate_every=100_000)
    reached = []
    for _ in range(2):
        with pytest.raises(BudgetSpent, match=r"budget of 1s is spent at step \d+ of 100000.*same command again"):
            train(recipe, data=dataset, run=tmp_path / "run")
        reached.append(require_checkpoint(tmp_path / "run").step)
    assert 0 < reached[0] < reached[1]


def test_a_clock_that_jumps_neither_spends_the_budget_nor_stops_the_training(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, journal = time.time, tmp_path / "run" / "metrics.jsonl"
    monkeypatch.setattr(time, "time", lambda: real() + (86_400 if journal.exists() else 0))
    assert train(tiny_training(budget="1h"), data=dataset, run=tmp_path / "run") == 8
    assert [row["step"] for row in read_journal(journal)] == list(range(1, 9))


@pytest.mark.parametrize("every", [1, 4])
def test_a_step_that_is_not_finite_changes_nothing_nor_do_those_after_it(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int
) -> None:
    """As on a GPU, where nobody waits to see: the weights are those before the step all the same."""
    monkeypatch.setitem(trainer.CHECK_EVERY, "cpu", every)
    saved: dict[int, dict[str, torch.Tensor]] = {}
    real = Learner.step

    def spoiled(self: Learner, parts: list, **keywords: float) -> dict:
        number = len(saved) + 1
        saved[number] = {name: value.clone() for name, value in self.network.state_dict().items()}
        if number == 6:
            parts[0].truth[0, 0, 0] = float("nan")
        last.append(self)
        return real(self, parts, **keywords)

    last: list[Learner] = []
    monkeypatch.setattr(Learner, "step", spoiled)
    recipe = tiny_training(steps=40, log_every=40, evaluate_every=40, checkpoint_every=40)
    says = r"not finite at step 6 \(this rank's examples were \[\[.*There is no checkpoint yet; lower"
    with pytest.raises(TrainingError, match=says):
        train(recipe, data=dataset, run=tmp_path / "run")
    assert len(saved) == (6 if every == 1 else 8)
    before, after = saved[6], last[-1].network.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    kept = json.loads((tmp_path / "run" / "not-finite.json").read_text())
    assert (kept["step"], kept["what"], len(kept["ranks"][0]["examples"])) == (6, "loss", 4)


def test_a_gradient_alone_that_is_not_finite_names_its_step(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(trainer.CHECK_EVERY, "cpu", 8)
    real, calls = torch.nn.utils.clip_grad_norm_, []

    def spoiled(*arguments: Any) -> torch.Tensor:
        calls.append(1)
        return real(*arguments) * (float("inf") if len(calls) == 5 else 1)

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", spoiled)
    recipe = tiny_training(steps=40, log_every=40, evaluate_every=40, checkpoint_every=40)
    with pytest.raises(
        TrainingError, match=r"step 5 \(in the gradient only; this rank's examples were \[\[.*not-finite"
    ):
        train(recipe, data=dataset, run=tmp_path / "run")
    kept = json.loads((tmp_path / "run" / "not-finite.json").read_text())
    assert (kept["step"], kept["what"], kept["ranks"][0]["rank"]) == (5, "gradient", 0)


def test_fine_tuning_begins_from_a_run_on_any_dataset(dataset: str, tmp_path: Path) -> None:
    other = str(tmp_path / "other.zarr")
    generate(tiny_dataset(poses={"seen": 7, "unseen": 4}), other)
    train(tiny_training(), data=dataset, run=tmp_path / "first")
    with pytest.raises(CheckpointError, match=r"was trained on dataset.*training\.start_from="):
        train(tiny_training(), data=other, run=tmp_path / "first")
    train(tiny_training(start_from=str(tmp_path / "first"), learning_rate=1e-12), data=other, run=tmp_path / "second")
    first, second = (require_checkpoint(tmp_path / name).weights() for name in ("first", "second"))
    assert all(torch.allclose(first[name], second[name], atol=1e-6) for name in first)


def test_identities_of_different_vertex_counts_train_together(tmp_path: Path) -> None:
    """Two species of legs: their batches are padded, and the loss of a mesh does not depend on its company."""
    body = {"family": "mixed", "bodies": [{"family": "leg", "rings": 8, "segments": 4}, {"family": "leg", "rings": 6}]}
    data = str(tmp_path / "mixed.zarr")
    generate(tiny_dataset(body=body, identities={"training": 4, "evaluation": 2}), data)
    given = {**TEN, "steps": 24, "learning_rate": 0.01, "precision": "float64"}
    train(tiny_training(**given), data=data, run=tmp_path / "one")
    train(tiny_training(**given, accumulate=4), data=data, run=tmp_path / "parts")
    assert torch.allclose(losses(tmp_path / "one"), losses(tmp_path / "parts"), rtol=1e-5, atol=0)
    assert losses(tmp_path / "one")[-5:].mean() < losses(tmp_path / "one")[:5].mean()


def test_the_cache_changes_no_bit(dataset: str, tmp_path: Path) -> None:
    for cache in ("device", "stream"):
        train(tiny_training(cache=cache), data=dataset, run=tmp_path / cache)
    assert same_bits(tmp_path / "device", tmp_path / "stream")
