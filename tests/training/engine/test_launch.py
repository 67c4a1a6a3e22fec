"""Launching: restarts by progress, the budget over restarts, GPUs of the cluster, recipes from a file and words."""

import json
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from datagen.common.errors import BudgetSpent, RecipeError, StorageError, TrainingError
from tests.support.ranks import ROOT, Forked, finish
from tests.support.recipes import tiny_training
from training.checkpoints.checkpoint import require_checkpoint
from training.engine import launch
from training.engine.distributed import STOP_FILE
from training.recipes.files import recipe_in
from training.recipes.training import TrainingRecipe


class Dying:
    """Ray's ``fit`` that uses up its restarts again and again; ``steps``: the checkpoint each call gets to."""

    def __init__(self, run: Path, steps: list[int | None]) -> None:
        self._run, self._steps, self.calls = run, steps, 0

    def __call__(self) -> None:
        step = self._steps[self.calls]
        self.calls += 1
        if step is None:
            raise RuntimeError("a node was lost")
        (self._run / "checkpoints" / f"step-{step:08d}").mkdir(parents=True)
        if self.calls < len(self._steps):
            raise RuntimeError("a node was lost")


def test_ranks_that_die_with_progress_are_started_again_and_again(tmp_path: Path) -> None:
    fit = Dying(tmp_path, [10, 20, 30, 40, 50, 60, 70])
    launch.fit_while_progressing(fit, tmp_path)
    assert fit.calls == 7


@pytest.mark.parametrize("left_over", [None, STOP_FILE, "failure.json"])
def test_without_progress_or_told_to_stop_or_with_something_to_mend_it_ends(
    tmp_path: Path, left_over: str | None
) -> None:
    fit = Dying(tmp_path, [10, None, 20] if left_over is None else [10, 20, 30])
    if left_over:
        (tmp_path / left_over).touch()
    with pytest.raises(RuntimeError, match="a node was lost"):
        launch.fit_while_progressing(fit, tmp_path)
    assert fit.calls == (2 if left_over is None else 1)


def test_a_rank_whose_disk_is_full_leaves_its_failure_in_the_room_that_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = tmp_path / ".room"
    room.write_bytes(bytes(2**16))

    def write_where_there_is_room(path: Path, content: bytes) -> None:
        if room.exists():
            raise StorageError(f"could not write {path}: No space left on device")
        path.write_bytes(content)

    monkeypatch.setattr(launch, "write_atomically", write_where_there_is_room)
    told = {"run": str(tmp_path), "mark": "none", "recipe": {}, "data": "", "began": 0.0}
    with pytest.raises(TrainingError, match="does not see"):
        launch.train_rank(told)
    failure = launch.failure_of(tmp_path)
    assert failure is not None and "does not see" in str(failure)


@pytest.mark.parametrize("error", [None, TrainingError("a rank's"), RuntimeError("Ray's")], ids=repr)
def test_room_for_a_failure_is_kept_while_ranks_train(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception | None
) -> None:
    kept: list[int] = []

    def fit() -> None:
        kept.append((tmp_path / ".room").stat().st_size)
        if error:
            raise error

    monkeypatch.setattr(launch, "require_enough", lambda *_, **__: None)
    monkeypatch.setattr(launch, "_join_seconds", lambda: 0.0)
    monkeypatch.setattr(launch, "_group", lambda *_, **__: SimpleNamespace(fit=fit))
    monkeypatch.setattr(launch, "fit_while_progressing", lambda fit, _: fit())
    with pytest.raises(TrainingError) if error else nullcontext():
        launch._with_ray(TrainingRecipe(ranks=2, device="cpu"), "data.zarr", tmp_path)
    assert kept == [2**16] and not (tmp_path / ".room").exists()


@pytest.mark.parametrize(
    ("ago", "steps"), [(300, 8), (6000, 1), (-60, 8)], ids=["half spent", "spent", "clocks differ"]
)
def test_the_budget_counts_from_the_drivers_start(dataset: str, tmp_path: Path, ago: float, steps: int) -> None:
    """Restarts included; and a group that comes too late still learns a step."""
    recipe, run = tiny_training(budget="10min"), tmp_path / "run"
    config = {"recipe": recipe.model_dump(mode="json"), "data": dataset, "run": str(run), "mark": "its"}
    run.mkdir()
    (run / ".launch").write_text("its")
    late = pytest.raises(BudgetSpent, match="budget of 10min is spent at step 1 of 8") if steps == 1 else nullcontext()
    with late:
        launch.train_rank(config | {"began": time.time() - ago})
    assert require_checkpoint(run).step == steps


@pytest.mark.parametrize(
    ("changes", "gpus", "torch_sees_them", "expected"),
    [
        ({"ranks": 4}, 4, True, True),
        ({"ranks": 4}, 3, True, False),
        ({"ranks": 4, "fewest_ranks": 2}, 3, True, True),
        ({"ranks": 4}, 4, False, False),
        ({"ranks": 1, "device": "cuda"}, 0, False, True),
        ({"ranks": 1, "device": "cpu"}, 4, True, False),
    ],
)
def test_gpus_are_the_clusters(changes: dict[str, int], gpus: int, torch_sees_them: bool, expected: bool) -> None:
    recipe = tiny_training(**{"launcher": "ray", "device": "auto"} | changes)
    assert launch.on_gpus(recipe, lambda: gpus, lambda: torch_sees_them) == expected


@pytest.mark.parametrize(("changes", "key"), [({}, "ranks is 4"), ({"fewest_ranks": 3}, "fewest_ranks is 3")])
def test_too_few_machines_are_said_by_the_key_that_asks(changes: dict[str, int], key: str) -> None:
    recipe = tiny_training(launcher="ray", ranks=4, **changes)
    with pytest.raises(TrainingError, match=rf"training\.{key}, but the cluster has 2 CPUs"):
        launch.require_enough(recipe, lambda: 2, "CPU")


def test_machines_that_were_cut_off_are_waited_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(time, "sleep", lambda _: None)
    recipe, counts = tiny_training(launcher="ray", ranks=4), iter([1, 1, 2, 4])
    launch.require_enough(recipe, lambda: next(counts), "CPU", patience=90)
    waited = "train: training.ranks is 4, but the cluster has 1 CPUs; waiting up to 90 s for machines\n"
    assert capsys.readouterr().err == waited
    with pytest.raises(TrainingError, match=r"but the cluster has 3 CPUs\. Use --set training\.ranks=3"):
        launch.require_enough(recipe, lambda: 3, "CPU", patience=0.02)


@pytest.mark.parametrize(("nodes", "waits"), [(1, False), (2, True)])
def test_only_a_cluster_of_several_machines_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nodes: int, waits: bool
) -> None:
    """Alive or not: a machine that was lost may come back, and one alone has what it has."""
    import ray

    patience: list[float] = []
    monkeypatch.setattr(ray, "nodes", lambda: [{"Alive": number == 0} for number in range(nodes)])
    monkeypatch.setattr(launch, "require_enough", lambda *_, **told: patience.append(told["patience"]))
    monkeypatch.setattr(launch, "_group", lambda *_, **__: SimpleNamespace(fit=lambda: None))
    launch._with_ray(TrainingRecipe(ranks=2, device="cpu"), "data.zarr", tmp_path)
    assert len(patience) == 1 and (patience[0] >= 60) == waits


@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_a_section_or_a_whole_recipe_with_words(tmp_path: Path, whole: bool, suffix: str) -> None:
    section = tiny_training().model_dump(mode="json")
    values = {"description": "", "data": {}, "training": section} if whole else section
    path = tmp_path / f"recipe.{suffix}"
    path.write_text(json.dumps(values) if suffix == "json" else yaml.safe_dump(values))
    words = ["budget=9min", "training.steps=100", "network.encoder_widths=[4,4,4]", "gradient_clip=null"]
    words += ["schedule.decay=0.5", "learning_rate=1e-3"]
    found = recipe_in(path, words)
    assert (found.budget, found.steps, found.gradient_clip, found.learning_rate) == ("9min", 100, None, 0.001)
    assert found.schedule.decay == 0.5 and found.schedule.name == "one_cycle"
    assert found.network == tiny_training(network=section["network"] | {"encoder_widths": [4, 4, 4]}).network


@pytest.mark.parametrize(
    ("text", "words", "says"),
    [
        ("batch: 0\nstepz: 3", [], r"batch: .* \(given: 0\); stepz: Extra inputs.* \(given: 3\)"),
        ("batch: 4", ["ranks=3"], "batch 4 cannot be shared equally by 3 ranks"),
        ("batch: 4", ["ranks"], "'ranks' is not of the form section.key=value"),
        ("training: npt-paper", [], "names the training recipe 'npt-paper'"),
        ("- 1", [], "it holds list, not keys"),
        ("a: [", [], "cannot be read: .*line 2"),
    ],
)
def test_a_recipe_that_cannot_be_is_one_line_with_every_fault(
    tmp_path: Path, text: str, words: list[str], says: str
) -> None:
    (tmp_path / "r.yaml").write_text(text)
    with pytest.raises(RecipeError, match=says):
        recipe_in(tmp_path / "r.yaml", words)
    with pytest.raises(RecipeError, match=r"none.yaml cannot be read"):
        recipe_in(tmp_path / "none.yaml")


def test_the_command(tmp_path: Path, dataset: str) -> None:
    (tmp_path / "r.json").write_text(json.dumps({"training": tiny_training().model_dump(mode="json")}))
    words = [tmp_path / "r.json", dataset, tmp_path / "run", "steps=4", "schedule.name=constant"]
    subprocess.run([sys.executable, "-m", "training.engine", *map(str, words)], cwd=ROOT, timeout=100, check=True)
    assert require_checkpoint(tmp_path / "run").step == 4
    (tmp_path / "file").write_text("in the way")
    for recipe, run, expected in (("r.json", "file", 1), ("none.json", "run", 2)):
        words = ["training.engine", str(tmp_path / recipe), dataset, str(tmp_path / run)]
        ((status, said),) = finish([Forked(words, tmp_path / "said")])
        lines = [line for line in said.splitlines() if line.startswith("error: ")]
        assert status == expected and len(lines) == 1 and "Traceback" not in said, said


def test_transfers_are_learned_without_what_they_do_not_need(dataset: str, tmp_path: Path) -> None:
    """On a machine with a GPU and little else; warp is for clothes."""
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(yaml.safe_dump(tiny_training(steps=1).model_dump(mode="json")))
    absent = dict.fromkeys(("warp", "ray", "mlflow"))
    words = f"import sys; sys.modules.update({absent}); from training.engine.launch import main; main()"
    command = [sys.executable, "-c", words, recipe, dataset, tmp_path / "run"]
    subprocess.run(list(map(str, command)), cwd=ROOT, timeout=100, check=True)
    assert require_checkpoint(tmp_path / "run").step == 1
