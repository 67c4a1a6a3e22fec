"""The ``dsffnet`` command and the workflow script as a person types them: output, one clear error, exit status."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from datagen.mesh.files import save_mesh
from datagen.mesh.geometry import Mesh
from datagen.store import open_dataset
from tests.support.commands import ROOT, command, fails, process
from tests.support.disk import grow, small_disk
from tests.support.files import flip_bit, tree_hash
from tests.support.recipes import tiny_training
from tests.support.three_networks import to_released
from training.engine.trainer import train
from training.inference.predict import load_trained
from training.networks.npt import NPT
from workflows.pipeline.run_folder import SingleRunFolder


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A tiny dataset and a run trained on it."""
    from datagen.generate import generate
    from tests.support.recipes import tiny_dataset

    folder = tmp_path_factory.mktemp("trained")
    generate(tiny_dataset(), str(folder / "leg.zarr"))
    train(tiny_training(), data=str(folder / "leg.zarr"), run=folder / "run")
    return folder / "leg.zarr", folder / "run"


NAMES = (
    "generate", "append", "inspect", "verify", "import", "export", "convert-body", "stand-in", "train", "evaluate",
    "sync", "import-weights", "recipe", "sweep", "compare", "ablation", "robustness", "generalisation", "transfer",
    "skin", "submit", "ui", "demo",
)  # fmt: skip


def test_every_subcommand_has_help_with_an_example() -> None:
    overview = command("--help").stdout.split()
    for name in NAMES:
        assert name in overview and f"dsffnet {name}" in command(name, "--help").stdout.partition("examples:")[2]


def test_the_overview_begins_with_what_somebody_new_does_first() -> None:
    overview = command("--help").stdout
    places = [overview.index(f"\n  {name} ") for name in ("transfer", "demo", "generate", "train", "evaluate", "sweep")]
    assert places == sorted(places) and overview.startswith("usage: dsffnet [-h] COMMAND ...\n")
    assert command("transfer", "--help").stdout.startswith("usage: dsffnet transfer [-h]")
    for line in overview.splitlines():
        assert len(line) <= 120


def help_of(*words: str) -> str:
    return command("recipe", *words).stdout.partition("keys for --set")[2]


def test_help_shows_the_keys_of_what_is_chosen_and_all_of_them_on_request() -> None:
    quickstart, human, every = help_of("--help"), help_of("--recipe", "human", "-h"), help_of("--help-all")
    assert "training.steps = 2500" in quickstart and "--recipe quickstart" in quickstart
    for text, there, missing in (
        (quickstart, ("training.network.encoder_widths", "data.body.phenotypes"), ("token_width", "data.body.model")),
        (human, ("training.network.token_width",), ("training.network.encoder_widths",)),
        (every, ("training.network.token_width", "training.network.encoder_widths", "data.body.model"), ()),
    ):
        assert all(key in text for key in there) and not any(key in text for key in missing)
    changed = help_of("--help", "--set", "training.network.name=npt", "training.steps=7")
    assert "training.network.variant" in changed and "training.steps = 7" in changed
    for name, section in (("generate", "data"), ("train", "training"), ("evaluate", "evaluation")):
        keys = command(name, "--help").stdout.partition("keys for --set")[2].splitlines()[1:]
        assert keys and all(key.startswith((f"  {section}", "      ")) for key in keys), "those that it takes"


def test_parsers_import_nothing_heavy() -> None:
    """By what they import, not by their time, which another program's load would change."""
    code = (
        "import sys; from workflows.cli.main import parsed\n"
        "for name in sys.argv[1:]:\n"
        "    try: parsed([name, '--help'] if name else ['--help'])\n"
        "    except SystemExit: pass\n"
        "heavy = {'torch', 'anny', 'ray', 'mlflow', 'trimesh', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(f'imported: {heavy}' if heavy else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "", *NAMES], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_generate_inspect_verify_repair(tmp_path: Path) -> None:
    data = tmp_path / "leg.zarr"
    made = command("generate", "--recipe", "smoke", "--local", "--out", data)
    assert made.returncode == 0 and "status              complete" in made.stdout
    picture = tmp_path / "sheet.png"
    assert (
        "176 of 96 vertices" in command("inspect", data, "--picture", picture).stdout
        and picture.stat().st_size > 10_000
    )
    assert command("verify", data).stdout.endswith("is whole\n")
    flip_bit(data / "grid/training/0/vertices/c/2/1/0/0")
    fails(command("verify", data), 1, "has 1 fault. ", f"dsffnet verify {data} --repair")
    assert "grid/training/0/vertices/c/2/1/0/0: its hash" in command("verify", data).stdout
    assert "is whole again" in command("verify", data, "--repair").stdout
    assert command("verify", data).returncode == 0


def test_training_in_this_process_needs_neither_ray_nor_mlflow(trained: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['ray'] = sys.modules['mlflow'] = None\n")
    recipe = ("--recipe", "smoke", "--set", "training.launcher=inline", "training.ranks=1", "training.steps=2")
    place = ("--data", trained[0], "--out", tmp_path / "run")
    done = process("train", *recipe, *place, PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}")
    assert done.returncode == 0 and "trained: " in done.stdout, done.stderr
    assert done.stderr.count("MLflow is not installed here") == 1 and "Traceback" not in done.stderr


def test_published_weights_become_ours(trained: tuple[Path, Path], tmp_path: Path) -> None:
    dataset, source = open_dataset(str(trained[0])), NPT(variant="maxpool")
    save_mesh(Mesh(dataset.vertices(3, 7), dataset.faces(3)), tmp_path / "a.obj")
    torch.save(to_released(source), tmp_path / "npt.model")
    done = command("import-weights", "npt", tmp_path / "npt.model", "--out", tmp_path / "ours")
    assert done.returncode == 0, done.stderr
    loaded = load_trained(tmp_path / "ours")[0].state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in source.state_dict().items())
    meshes = (tmp_path / "a.obj", tmp_path / "a.obj", "-o", tmp_path / "b.obj")
    assert command("transfer", *meshes, "--model", tmp_path / "ours").returncode == 0
    for words, says in (
        (("dsffnet", tmp_path / "npt.model"), "48 more"),
        (("corenet3d", tmp_path / "npt.model"), "of corenet3d two"),
        (("npt", tmp_path / "none.model"), "none.model"),
    ):
        refused = command("import-weights", *words, "--out", tmp_path / "not")
        fails(refused, 2 if "two" in says else 1, says)
    assert not (tmp_path / "not").exists()


def test_a_checkpoint_is_chosen(trained: tuple[Path, Path], tmp_path: Path) -> None:
    opened = open_dataset(str(trained[0]))
    save_mesh(Mesh(opened.vertices(3, 7), opened.faces(3)), tmp_path / "a.obj")
    meshes = ("--source", tmp_path / "a.obj", "--target", tmp_path / "a.obj", "--out", tmp_path / "b.obj")
    done = command("transfer", "--model", trained[1], "--checkpoint", "4", *meshes)
    assert done.returncode == 0, done.stderr
    missing = command("transfer", "--model", trained[1], "--checkpoint", "5", *meshes)
    fails(missing, 1, "step-00000005 is not there. Name another step: 4, 8")
    assert command("transfer", "--model", trained[1], "--checkpoint", "newest", *meshes).returncode == 2


def test_a_full_disk_is_one_error_and_going_on_ends_with_the_same_bytes(tmp_path: Path) -> None:
    arguments = ("generate", "--recipe", "smoke", "--local", "--set", "data.poses.seen=100")
    undisturbed = tmp_path / "undisturbed.zarr"
    assert command(*arguments, "--out", undisturbed).returncode == 0
    with small_disk(tmp_path / "disk", kibibytes=600) as disk:
        data = disk / "leg.zarr"
        fails(
            command(*arguments, "--out", data, "--yes"), 1, "No space left on device", "What was complete is untouched"
        )
        assert "building" in command("inspect", data).stdout
        grow(disk, kibibytes=16_000)
        assert command(*arguments, "--out", data).returncode == 0
        assert tree_hash(data) == tree_hash(undisturbed)


def test_two_workflows_in_one_folder(tmp_path: Path) -> None:
    with SingleRunFolder(tmp_path / "w").alone():
        fails(
            command("--recipe", "smoke", "--out", tmp_path / "w", script="full.py"), 1, "another command is at work in"
        )


def test_fresh_training_removes_nothing_but_a_training(tmp_path: Path, trained: tuple[Path, Path]) -> None:
    from training.tracking.record import begin_record

    begin_record(tmp_path / "workflow", name="w", kind="workflow", parent=None, parameters={})
    (tmp_path / "workflow" / "dataset.txt").write_text("precious")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("precious")
    for place, says in (
        ("workflow", "is the folder of another kind of work: workflow 'w'"),
        ("other", "is not the folder of a training, so --fresh leaves it alone"),
    ):
        result = command("train", "--recipe", "smoke", "--data", trained[0], "--out", tmp_path / place, "--fresh")
        fails(result, 2, says)
    assert (tmp_path / "workflow" / "dataset.txt").exists() and (tmp_path / "other" / "thesis.txt").exists()


def test_printed_recipe_can_be_used_as_a_file(tmp_path: Path) -> None:
    printed = command("recipe", "--recipe", "smoke", "--set", "training.seed=4").stdout
    (tmp_path / "mine.yaml").write_text(printed)
    assert command("recipe", "--recipe", tmp_path / "mine.yaml").stdout == printed


ON_CLUSTER = {"RAY_ADDRESS": "127.0.0.1:1"}
REFUSED: list[tuple[int, str, str, dict[str, str]]] = [
    (2, "did you mean 'quickstart'", "generate --recipe quickstrat --out new", {}),
    (2, "unknown key 'training.stepz', did you mean 'training.steps'?", "full --out new --set training.stepz=3", {}),
    (2, "or is empty", "recipe --recipe empty.yaml", {}),
    (2, "encoder_widths.0", "recipe --set training.network.encoder_widths=[0,8,8]", {}),
    (2, "training.learning_rate", "recipe --set training.learning_rate=.inf", {}),
    (2, "interpolation is not supported", "recipe --set training.steps=${nothing}", {}),
    (2, "is a URL", "train --data leg.zarr --out s3://bucket/run", {}),
    (2, "--out 'runs/x' is a relative path", "full --recipe smoke --out runs/x", ON_CLUSTER),
    (2, "throw-away copy", "full --recipe smoke --out runs/x", ON_CLUSTER),
    (2, "--out /data/runs/smoke", "full --recipe smoke", ON_CLUSTER),
    (1, "no Ray head answers at RAY_ADDRESS 127.0.0.1:1", "generate --recipe smoke --out {here}/new", ON_CLUSTER),
    (2, "leaves it alone", "full --recipe smoke --out . --fresh", {}),
    (2, "is the file", "full --recipe smoke --out file", {}),
    (2, "is the dataset", "train --data leg.zarr --out leg.zarr", {}),
    (2, "is the dataset", "train --data leg.zarr --out leg.zarr/run --fresh", {}),
    (1, "file", "generate --recipe smoke --local --out file/x.zarr", {}),
    (1, "is a file", "generate --recipe smoke --local --out file --fresh", {}),
    (1, "no dataset at", "inspect no.zarr", {}),
    (1, "dsffnet generate", "inspect no.zarr", {}),
    (1, "no dataset at", "train --data no.zarr --out new", {}),
    (2, "Name the dataset in it: whole/dataset.zarr", "train --data whole --out new", {}),
    (1, "holds no record of a run", "sync .", {}),
    (1, "norun has no usable checkpoint", "evaluate norun --data leg.zarr", {}),
    (2, "nothing to append", "append leg.zarr", {}),
    (1, "has 3 training, more than 1", "append leg.zarr --training-identities 1 --local", {}),
    (1, "no dataset at", "append no.zarr --training-identities 1 --local", {}),
    (1, "no folder of meshes", "import faust none --out new --local", {}),
    (2, "unknown key 'upp'", "import npt . --out new --local --set data.body.upp=z", {}),
    (2, "a whole section", "import npt . --out new --local --set data=5", {}),
    (2, "a whole section", "import npt . --out new --local --set data.body=5", {}),
    (2, "is said by the command itself", "import npt . --out new --local --set data.body.path=x", {}),
    (2, "is said by the command itself", "import npt . --out new --local --set data.body.layout=faust", {}),
    (1, "https://smpl.is.tue.mpg.de", "generate --recipe smpl-paper --out new --local", {}),
    (1, "anny-paper", "generate --recipe smpl-paper --out new --local", {}),
    (1, "stand-in", "generate --recipe smpl-paper --out new --local", {}),
    (1, "after the layout: dsffnet import npt FOLDER", "import npt none --out new --local", {}),
    (2, "--set data.poses.seen changes nothing here", "train --data leg.zarr --out new --set data.poses.seen=3", {}),
    (2, "--set training.steps changes nothing here", "evaluate new --data leg.zarr --set training.steps=3", {}),
    (2, "--set beside.steps changes nothing", "generate --recipe smoke --out new --local --set beside.steps=3", {}),
    (2, "holds recipe.yaml, which one would replace", "train --recipe smoke --data leg.zarr --out mine", {}),
    (1, "Copy the weights of that name, which come along", "evaluate human --data leg.zarr", {}),
    (2, "which smal is not made from", "stand-in smal --topology soma --out new.npz", {}),
    (2, "'--out' is followed by an empty text", "generate --recipe smoke --local --out=", {}),
    (1, "which is a file", "inspect file", {}),
    (1, "which holds 'empty.yaml'", "train --data . --out new", {}),
    (2, "ends in .png", "inspect leg.zarr --picture notes.md", {}),
    (2, "outside the dataset", "inspect leg.zarr --picture leg.zarr/sheet.png", {}),
]
"""Status, what the one line on standard error holds, the command, and its variables."""


@pytest.mark.parametrize(("status", "says", "words", "environment"), REFUSED, ids=[case[2] for case in REFUSED])
def test_what_cannot_be_done_is_one_line_and_changes_nothing(
    spoilable: Path, status: int, says: str, words: str, environment: dict[str, str]
) -> None:
    here = spoilable.parent
    (here / "file").write_text("in the way")
    (here / "empty.yaml").write_text("")
    (here / "whole" / "dataset.zarr").mkdir(parents=True, exist_ok=True)
    (here / "mine").mkdir(exist_ok=True)
    (here / "mine" / "recipe.yaml").write_text("mine")
    before = tree_hash(here)
    name, *rest = words.format(here=here, nothing="{nothing}").split()
    given = rest if name == "full" else [name, *rest]
    done = command(*given, script="full.py" if name == "full" else "dsffnet", folder=here, **environment)
    fails(done, status, says)
    for lock in here.rglob("*.lock"):
        lock.unlink()
    assert tree_hash(here) == before


def test_an_empty_word_is_refused() -> None:
    fails(command("generate", "--local", "--out", ""), 2, "'--out' is followed by an empty text")


def test_a_command_without_what_it_needs_is_a_usage_error() -> None:
    assert command("generate").returncode == 2
