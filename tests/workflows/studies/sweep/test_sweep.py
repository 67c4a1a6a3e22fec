"""Sweeps: what is tried, in one error line if it cannot be; trials that fail or stop alone; the same command again."""

import contextlib
import csv
import os
import shutil
import signal
import subprocess
import sys
import types
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
import yaml

from datagen.common.errors import ClusterError, DsffnetError, RecipeError, TrainingError, TrainingStopped, WorkflowError
from tests.support.commands import wait_for
from tests.support.files import tree_hash
from tests.support.recipes import tiny_dataset, tiny_training
from tests.support.trials import here
from training.checkpoints.checkpoint import require_checkpoint
from training.engine.distributed import STOP_FILE, StopRequest
from training.engine.trainer import train
from training.inference.predict import load_trained
from training.recipes.training import TrainingRecipe
from training.tracking.journal import read_journal
from training.tracking.record import flatten, read_record
from workflows.pipeline.run_folder import SweepFolder
from workflows.recipe.loader import WorkflowRecipe, load_recipe, save_recipe
from workflows.recipe.names import named_training
from workflows.studies.sweep import run as sweeping
from workflows.studies.sweep.plan import Sweep, Trial, known_sweeps, parse_grid, plan_sweep, read_sweep, split_values
from workflows.studies.sweep.ray_trials import Outcome, Place, ray_trials, train_trial
from workflows.studies.sweep.run import Settings, judge, run_sweep

ROOT = Path(__file__).parents[4]
HOST = {"Alive": True, "Resources": {"CPU": 2.0}}
THREE = [
    {"name": "slow", "description": "hardly moves", "set": ["training.learning_rate=1e-6"]},
    {"name": "wild", "set": ["training.learning_rate=1e30", "training.gradient_clip=null"]},
    {"name": "good"},
]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A recipe file that trains for eight steps in this process."""
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    save_recipe(WorkflowRecipe(data=tiny_dataset(), training=tiny_training()), path)
    return str(path)


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory, tiny: str) -> Sweep:
    return sweep_of(tmp_path_factory.mktemp("three"), tiny, THREE)


@pytest.fixture(scope="module", autouse=True)
def _without_ray() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sweeping, "ray_cluster", contextlib.nullcontext)
        yield


@pytest.fixture(scope="module")
def _swept(tmp_path_factory: pytest.TempPathFactory, _pristine: Path, three: Sweep) -> Path:
    out = Path(shutil.copytree(_pristine, tmp_path_factory.mktemp("swept") / "out" / "dataset.zarr")).parent
    run_sweep(three, out, Settings("tiny"), runner=here)
    return out


@pytest.fixture
def swept(_swept: Path, tmp_path: Path) -> Path:
    """A copy of a folder in which the three trials were run."""
    return Path(shutil.copytree(_swept, tmp_path / "swept"))


@pytest.fixture
def out(_swept: Path, tmp_path: Path) -> Path:
    """A folder in which the dataset was made, and nothing trained."""
    for name in ("dataset.zarr", "stages"):
        shutil.copytree(_swept / name, tmp_path / "out" / name)
    return tmp_path / "out"


def sweep_of(folder: Path, recipe: str, trials: Any) -> Sweep:
    (folder / "trials.yaml").write_text(yaml.safe_dump(trials))
    return plan_sweep(recipe=recipe, shared=[], trials=str(folder / "trials.yaml"))


def nowhere(*_: Any, **__: Any) -> Iterator[Outcome | None]:
    raise AssertionError("no trial should be run")


def named(sweep: Sweep) -> list[str]:
    return [trial.name for trial in sweep.trials]


def test_a_grid_is_every_combination_named_by_what_varies(tiny: str) -> None:
    vary = ["training.learning_rate=0.1,0.2", "training.network.initial_mixing=0,0.5"]
    sweep = plan_sweep(recipe=tiny, shared=["training.steps=5"], vary=vary)
    assert named(sweep) == [f"learning_rate={a}_initial_mixing={b}" for a in ("0.1", "0.2") for b in ("0", "0.5")]
    last = sweep.trials[-1].training
    assert last.learning_rate == 0.2 and last.network.initial_mixing == 0.5 and last.steps == 5  # type: ignore[union-attr]


def test_trials_of_a_file_are_run_in_every_combination_of_a_grid(tmp_path: Path, tiny: str) -> None:
    (tmp_path / "two.yaml").write_text(
        'trials: [{name: a}, {name: b, set: [training.batch=2]}]\nvary: ["training.seed=1,2"]'
    )
    sweep = plan_sweep(recipe=tiny, shared=[], trials=str(tmp_path / "two.yaml"))
    assert named(sweep) == ["a_seed=1", "a_seed=2", "b_seed=1", "b_seed=2"]
    assert (sweep.trials[3].training.batch, sweep.trials[3].training.seed) == (2, 2)


def test_commas_within_brackets_part_no_values_and_names_are_as_long_as_it_takes(tiny: str) -> None:
    assert split_values("[8,8,8],[16,8,8]") == ("[8,8,8]", "[16,8,8]")
    vary = [
        "training.network.name=npt,dsffnet",
        "training.schedule.name=step",
        "training.network.encoder_widths=[8,8,8]",
    ]
    sweep = plan_sweep(recipe=tiny, shared=[], vary=vary)
    assert named(sweep)[0] == "network.name=npt_schedule.name=step_encoder_widths=8-8-8"
    assert [trial.training.network.name for trial in sweep.trials] == ["npt", "dsffnet"]


def test_trials_are_one_rank_in_their_own_process_whatever_the_recipe_says(tiny: str) -> None:
    shared = ["training.launcher=ray", "training.ranks=2", "training.fewest_ranks=1"]
    (trial,) = plan_sweep(recipe=tiny, shared=shared, vary=["training.seed=3"]).trials
    assert (trial.training.launcher, trial.training.ranks, trial.training.fewest_ranks) == ("inline", 1, None)
    assert trial.recipe.training.ranks == 2, "the best trial's recipe is kept as it would be run alone"


@pytest.mark.parametrize(
    ("vary", "says"),
    [
        (["training.lerning_rate=1"], "trial lerning_rate=1: .*did you mean 'training.learning_rate'"),
        (["training.learning_rate="], r"has an empty value. Write e.g. --vary training.learning_rate=A,B"),
        (["training.learning_rate=1,,2"], "has an empty value"),
        (["training.learning_rate"], "is not of the form training.key=VALUE,VALUE"),
        (["training.seed=1", "training.seed=2"], "names 'training.seed' twice"),
        (["training.seed=1,1"], "2 trials are called 'seed=1'"),
        (["data.poses.seen=3,4"], "only keys of training can differ between trials"),
        (["training.evaluate_triples=3,4"], "compared on the same triples"),
        (["training.learning_rate=fast"], "trial learning_rate=fast: .*training.learning_rate: .*given: 'fast'"),
        ([], "a sweep needs something to try.*networks"),
    ],
)
def test_a_grid_that_cannot_be_is_one_clear_error(vary: list[str], says: str, tiny: str) -> None:
    with pytest.raises(RecipeError, match=says) as caught:
        plan_sweep(recipe=tiny, shared=[], vary=vary)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("just words", "is not a list of trials: .*just words.*A trial is {name: "),
        ("trials: {a: 1}", "is not a list of trials: trials: "),
        ("[{name: a, sett: []}]", r"trials.0.sett: Extra inputs"),
        ("[{name: a, set: training.seed=1}]", r"trials.0.set: .*given: 'training.seed=1'"),
        ("[{description: nameless}]", r"trials.0.name: Field required"),
        ("[{name: a}, {name: b}, {name: a}]", "2 trials are called 'a'. Give each a name"),
        ("[{name: ../a}]", "trial name '../a' cannot be a folder's"),
        ("[]", "a sweep needs something to try"),
        ("[{name: a", "cannot be read"),
    ],
)
def test_a_file_that_is_no_list_of_trials_is_one_clear_error(text: str, says: str, tmp_path: Path, tiny: str) -> None:
    (tmp_path / "trials.yaml").write_text(text)
    with pytest.raises(RecipeError, match=says) as caught:
        plan_sweep(recipe=tiny, shared=[], trials=str(tmp_path / "trials.yaml"))
    assert "\n" not in str(caught.value)


def test_a_sweep_that_is_not_there_is_answered_with_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="no sweep 'network', did you mean 'networks'"):
        read_sweep("network")
    with pytest.raises(RecipeError, match="cannot be read"):
        read_sweep(str(tmp_path / "none.yaml"))


def test_data_without_unseen_poses_cannot_compare_trials(tiny: str) -> None:
    with pytest.raises(RecipeError, match=r"compared on unseen poses.*data.poses.unseen"):
        plan_sweep(recipe=tiny, shared=["data.poses.unseen=0"], vary=["training.seed=1"])


@pytest.mark.parametrize("name", known_sweeps())
def test_named_sweeps_resolve_and_give_every_trial_the_same_number_of_triples(name: str) -> None:
    sweep = plan_sweep(recipe=None, shared=[], trials=name)
    assert len(sweep.trials) >= 5 and read_sweep(name).description
    budgets = {(trial.training.steps or 0) * trial.training.batch for trial in sweep.trials}
    assert budgets == {12_000}
    if name == "networks":
        assert {trial.training.network.name for trial in sweep.trials} == {"dsffnet", "npt", "corenet3d"}


@pytest.mark.parametrize("network", ["npt", "corenet3d"])
def test_published_trials_are_the_published_recipes_at_other_widths(network: str) -> None:
    trials = {trial.name: trial for trial in plan_sweep(recipe=None, shared=[], trials="networks").trials}
    trial = flatten(trials[f"{network}-published"].training.model_dump(mode="json"))
    published = flatten(TrainingRecipe.model_validate(named_training(f"{network}-paper")).model_dump(mode="json"))
    elsewhere = {"steps", "launcher", "device", "evaluate_every", *(key for key in published if "widths" in key)}
    assert {key: trial[key] for key in published.keys() - elsewhere} == {
        key: published[key] for key in published.keys() - elsewhere
    }


def test_a_trial_that_cannot_be_placed_starts_none(three: Sweep, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    submitted: list[str] = []
    task = types.SimpleNamespace(remote=lambda trial, *_, **__: submitted.append(trial.name))
    ray = types.SimpleNamespace(remote=lambda **_: lambda function: task, nodes=lambda: [HOST])
    monkeypatch.setitem(sys.modules, "ray", ray)
    first, last = three.trials[0], three.trials[-1]
    on_gpu = last.recipe.model_copy(update={"training": last.recipe.training.model_copy(update={"device": "cuda"})})
    with pytest.raises(TrainingError, match=r"trial good has training\.device=cuda"):
        next(ray_trials([first, replace(last, recipe=on_gpu)], Place("x", out, "mark"), tags=lambda _: {}))
    assert submitted == []


def test_a_trial_that_diverges_is_recorded_with_its_reason_and_the_others_go_on(swept: Path) -> None:
    record = read_record(swept / "trials" / "wild")
    assert record is not None and record.status == "FAILED" and "not finite" in record.tags["failure"]
    parent, child = read_record(swept), read_record(swept / "trials" / "good")
    assert parent is not None and child is not None
    assert (parent.kind, parent.name, parent.status, parent.tags["best_trial"]) == ("sweep", "tiny", "FINISHED", "good")
    assert parent.metrics["trials_finished"] == 2 and parent.metrics["trials_failed"] == 1
    assert (child.kind, child.name, child.parent, child.status) == ("train", "good", "../..", "FINISHED")
    assert child.tags["varied.training.learning_rate"] == "0.003" == child.parameters["learning_rate"]
    assert child.model is None, "a sweep does not fill the model registry"


def test_the_report_is_sorted_names_the_best_and_gives_its_recipe(three: Sweep, swept: Path) -> None:
    text = (swept / "sweep.md").read_text()
    assert text.index("| good") < text.index("| slow") < text.index("| wild")
    assert "Best: **good**" in text and "**wild** failed: loss or gradient is not finite" in text
    html, markdown = ((swept / name).read_text() for name in ("report.html", "report.md"))
    assert next(line for line in text.splitlines() if line.startswith("| good")) in markdown
    assert "3 trainings from recipe" in html and "Dataset card" in html
    assert (swept / "figures" / "sweep.png").stat().st_size > 10_000
    assert load_recipe(str(swept / "best.yaml")).training == three.trials[2].recipe.training
    assert named(plan_sweep(recipe=None, shared=[], trials=str(swept / "trials.yaml"))) == ["slow", "wild", "good"]


def test_the_csv_has_each_trial_measured_from_its_own_journal(swept: Path) -> None:
    with open(swept / "sweep.csv") as file:
        rows = list(csv.DictReader(file))
    rates = {row["trial"]: float(row["training.learning_rate"]) for row in rows}
    assert rates == {"good": 0.003, "slow": 1e-6, "wild": 1e30}
    journal = read_journal(swept / "trials" / "good" / "metrics.jsonl")
    assert float(rows[0]["pmd_unseen"]) == journal[-1]["evaluation/pmd_unseen"] and rows[0]["steps"] == "8"
    assert f" {float(rows[0]['seconds']):.1f} " in (swept / "sweep.md").read_text(), "not 0 s"
    assert float(rows[0]["seconds"]) == pytest.approx(sum(4 / row["meshes_per_second"] for row in journal))
    assert {float(row["twice_the_best"]) for row in rows} == {2 * float(rows[0]["pmd_unseen"])}
    assert [row["twice_the_best_step"] for row in rows] == ["4.0", "4.0", ""], (
        "twice the best, which 'wild' did not reach"
    )
    parent = read_record(swept)
    assert parent is not None and parent.metrics["best_pmd_unseen"] == pytest.approx(float(rows[0]["pmd_unseen"]) * 1e4)


def test_a_trial_is_an_ordinary_run(swept: Path) -> None:
    run = swept / "trials" / "slow"
    for name in ("recipe.yaml", "provenance.json", "metrics.jsonl", "figures/training-curve.png"):
        assert (run / name).is_file(), name
    assert load_trained(run)[2] == 8
    assert yaml.safe_load((run / "recipe.yaml").read_text())["learning_rate"] == 1e-6


def test_again_finished_trials_are_skipped_and_only_failed_ones_are_tried(three: Sweep, swept: Path) -> None:
    before = tree_hash(swept / "trials" / "good")
    begun: list[str] = []

    def noting(trials: Sequence[Trial], place: Place, **options: Any) -> Iterator[Outcome | None]:
        begun.extend(trial.name for trial in trials)
        yield from here(trials, place, **options)

    results = run_sweep(three, swept, Settings("tiny"), runner=noting)
    assert begun == ["wild"] and tree_hash(swept / "trials" / "good") == before
    assert [result.state for result in results] == ["finished", "finished", "failed"]


def test_when_all_is_finished_not_even_ray_is_started(
    tmp_path: Path, tiny: str, swept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweeping, "ray_cluster", nowhere)
    shown: list[Any] = []
    results = run_sweep(sweep_of(tmp_path, tiny, THREE[::2]), swept, Settings("x"), runner=nowhere, show=shown.extend)
    assert [result.trial.name for result in results] == ["good", "slow"] and shown == results
    assert "wild" not in (swept / "sweep.md").read_text()


def test_a_stopped_trial_goes_on_from_its_checkpoint_and_ends_as_if_undisturbed(
    tmp_path: Path, tiny: str, dataset: str, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = plan_sweep(recipe=tiny, shared=[], vary=["training.seed=1"])
    looks = iter([False, False, False, True])  # the first before any step
    with monkeypatch.context() as patched, pytest.raises(TrainingStopped, match="Run the same command again") as stop:
        patched.setattr(StopRequest, "made", lambda self: next(looks))
        run_sweep(sweep, out, Settings("tiny"), runner=here)
    assert stop.value.exit_status == 143
    for folder in (out, out / "trials" / "seed=1"):
        record = read_record(folder)
        assert record is not None and record.status == "KILLED"
    assert require_checkpoint(out / "trials" / "seed=1").step == 3
    (out / "trials" / "seed=1" / STOP_FILE).touch()  # what an earlier command may have left
    (result,) = run_sweep(sweep, out, Settings("tiny"), runner=here)
    assert result.finished and result.steps == 8
    train(sweep.trials[0].training, data=dataset, run=tmp_path / "undisturbed")
    one, other = (require_checkpoint(run).weights() for run in (out / "trials" / "seed=1", tmp_path / "undisturbed"))
    assert all(torch.equal(one[name], other[name]) for name in other)


def test_told_to_stop_before_it_began_leaves_no_record(three: Sweep, out: Path) -> None:
    def stopped(trials: Sequence[Trial], place: Place, **options: Any) -> Iterator[Outcome | None]:
        (trials[0].folder(place.out) / STOP_FILE).touch()
        yield from here(trials[:1], place, **options)

    with pytest.raises(TrainingStopped, match=r"1 trial \(slow\) not finished: told to stop before it began"):
        run_sweep(three, out, Settings("tiny"), runner=stopped)
    assert read_record(out / "trials" / "slow") is None


def test_a_programming_error_in_one_trial_is_its_own_and_leaves_a_traceback(
    three: Sweep, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("by nothing\nat all")

    monkeypatch.setattr("workflows.pipeline.train.launch", broken)
    with pytest.raises(WorkflowError, match=r"3 trials \(slow, wild, good\) failed.*ZeroDivisionError: by nothing \("):
        run_sweep(three, out, Settings("tiny"), runner=here)
    assert "Traceback" in (out / "trials" / "good" / "failure.txt").read_text()
    parent = read_record(out)
    assert parent is not None and parent.status == "FAILED"


def test_a_machine_that_sees_another_disk_trains_nothing(three: Sweep, out: Path) -> None:
    place = Place(str(out / "dataset.zarr"), out, "another mark")
    outcome = train_trial(three.trials[0], place, tags={}, threads=1)
    assert outcome.state == "failed" and "--out must be on a shared disk" in outcome.reason


def test_another_recipe_in_the_same_folder_is_refused_before_anything_is_touched(
    tmp_path: Path, tiny: str, swept: Path
) -> None:
    before = tree_hash(swept)
    other = sweep_of(tmp_path, tiny, [{"name": "good", "set": ["training.learning_rate=0.1"]}])
    with pytest.raises(RecipeError, match=r"training.learning_rate: 0.003 there, 0.1 here"):
        run_sweep(other, swept, Settings("tiny"), runner=nowhere)
    with pytest.raises(DsffnetError, match="data"):
        run_sweep(plan_sweep(recipe=tiny, shared=["data.poses.seen=7"], vary=["training.seed=1"]), swept, Settings("x"))
    assert tree_hash(swept) == before


def test_fresh_removes_the_sweep_and_leaves_strangers_alone(swept: Path, tmp_path: Path) -> None:
    (swept / "notes.txt").write_text("mine")
    SweepFolder(swept).remove()
    assert (swept / "notes.txt").exists()
    ours = ("trials", "dataset.zarr", "sweep.md", "sweep.csv", "figures/sweep.png", "best.yaml", "record.json")
    assert not [name for name in ours if (swept / name).exists()]
    (tmp_path / "other" / "trials").mkdir(parents=True)
    with pytest.raises(RecipeError, match="no sweep of ours"):
        SweepFolder(tmp_path / "other").remove()


def test_some_failures_are_no_failure_unless_strict() -> None:
    failed, stopped = Outcome("a", "failed", "too fast"), Outcome("b", "stopped", "no time left", exit_status=75)
    judge([failed, Outcome("c", "finished")], of=2, strict=False)
    with pytest.raises(WorkflowError, match=r"1 trial \(a\) failed, the first because: too fast"):
        judge([failed], of=2, strict=True)
    with pytest.raises(WorkflowError):
        judge([failed], of=1, strict=False)
    with pytest.raises(TrainingStopped, match="no time left") as caught:
        judge([failed, stopped], of=3, strict=False)
    assert caught.value.exit_status == 75


# With real Ray -----------------------------------------------------------------------------------------------------

LONG = ("--vary", "training.learning_rate=0.003,0.001", "--set", "training.steps=400", "training.checkpoint_every=20")


def start(out: Path, *arguments: str) -> "subprocess.Popen[str]":
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "MLFLOW_"))}
    command = [sys.executable, "-m", "workflows", "sweep", "--recipe", "smoke", "--out", str(out), *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.Popen(command, cwd=ROOT, env=clean, text=True, **pipes)  # type: ignore[call-overload,no-any-return]


def run(out: Path, *arguments: str) -> tuple[int, str]:
    process = start(out, *arguments)
    output, _ = process.communicate(timeout=300)
    return process.returncode, output


def steps_made(out: Path) -> list[int]:
    rows = [read_journal(path) for path in sorted(out.glob("trials/*/metrics.jsonl"))]
    return [row[-1]["step"] for row in rows if row]


@pytest.mark.cluster
@pytest.mark.timeout(600)
def test_stopped_and_killed_on_real_ray_it_ends_as_if_undisturbed_and_mlflow_shows_it(tmp_path: Path) -> None:
    out, undisturbed = tmp_path / "out", tmp_path / "undisturbed"
    process = start(out, *LONG)
    wait_for(lambda: max(steps_made(out), default=0) >= 30, process=process)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=100)
    assert process.returncode == 143, output
    stopped = [require_checkpoint(folder).step for folder in out.glob("trials/*") if (folder / "latest").exists()]
    assert stopped and all(step < 400 for step in stopped)

    process = start(out, *LONG)
    wait_for(lambda: max(steps_made(out), default=0) >= max(stopped) + 40, process=process)
    workers = [
        p for p in psutil.Process(process.pid).children(recursive=True) if "ray::train_trial" in "".join(p.cmdline())
    ]
    assert workers
    workers[0].send_signal(signal.SIGKILL)  # Ray starts that trial again
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0 and "Continue from the best" in output, output

    assert run(undisturbed, *LONG)[0] == 0
    for name in ("learning_rate=0.003", "learning_rate=0.001"):
        one, other = (require_checkpoint(folder / "trials" / name).weights() for folder in (out, undisturbed))
        assert all(torch.equal(one[key], other[key]) for key in other)
        steps = [row["step"] for row in read_journal(out / "trials" / name / "metrics.jsonl")]
        assert steps == sorted(set(steps)) and steps[-1] == 400
    status, output = run(out, *LONG)
    assert status == 0 and "2 of 2 skipped, finished before" in output

    import mlflow

    client = mlflow.MlflowClient(f"sqlite:///{out / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("dsffnet").experiment_id])
    (parent,) = [r for r in runs if r.data.tags["kind"] == "sweep"]
    children = {r.info.run_name: r for r in runs if r.data.tags.get("mlflow.parentRunId") == parent.info.run_id}
    assert set(children) == {"generate", "learning_rate=0.003", "learning_rate=0.001"}
    assert {r.info.status for r in runs} == {"FINISHED"}
    assert children["learning_rate=0.001"].data.tags["varied.training.learning_rate"] == "0.001"
    assert "evaluation/pmd_unseen" in children["learning_rate=0.001"].data.metrics
    assert {"sweep.md", "sweep.csv", "sweep.png"} <= {file.path for file in client.list_artifacts(parent.info.run_id)}


@pytest.mark.cluster
def test_more_cpus_than_a_machine_has_and_a_usage_error(tmp_path: Path) -> None:
    status, output = run(tmp_path / "out", *LONG, "--cpus-per-trial", "4096")
    assert status == ClusterError.exit_status and output.count("error: ") == 1 and "Traceback" not in output, output
    assert "--cpus-per-trial is 4096, but no machine of the cluster has more than" in output
    status, output = run(tmp_path / "none", "--vary", "training.lerning_rate=1")
    assert status == 2 and "did you mean 'training.learning_rate'" in output and not (tmp_path / "none").exists()


def test_parse_grid_reads_words_with_signs_in_their_values() -> None:
    assert parse_grid(["a.b=x=1,2"]) == {"a.b": ("x=1", "2")}
