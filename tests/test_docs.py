"""The documentation's code: Python blocks run as printed, commands have the options that they are shown with.

A block that cannot run here has a comment before it, ``<!-- not run: REASON -->``, and is reported as skipped.
"""

import re
import runpy
import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from datagen.mesh.files import save_mesh
from datagen.mesh.geometry import Mesh
from datagen.store import open_dataset
from tests.support.commands import ROOT, command, example
from tests.support.recipes import tiny_dataset, tiny_training
from training.recipes.training import EvaluationRecipe
from workflows.cli.main import parsed
from workflows.full import run_workflow
from workflows.pipeline.tasks import TaskRunner
from workflows.recipe.loader import WorkflowRecipe

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(r"(?:<!-- not run: (?P<reason>.+?) -->\n+)?^```python\n(?P<code>.*?)^```$", re.M | re.S)
_SLOW = {"docs/tracking.md": "a store of MLflow with a registered model"}
_COMMAND = re.compile(r"^(?:    )?(?:\.venv/bin/)?dsffnet (?P<words>(?:.*\\\n)*.*)$", re.M)


@dataclass(frozen=True)
class Block:
    """Python of a page, and the reason why it is not run, if it is not."""

    page: str
    line: int
    code: str
    reason: str | None


def blocks(page: Path) -> list[Block]:
    text, name = page.read_text(), str(page.relative_to(ROOT))
    return [
        Block(name, text[: found.start("code")].count("\n"), found["code"], found["reason"])
        for found in _BLOCK.finditer(text)
    ]


RUN = {str(page.relative_to(ROOT)): [b for b in blocks(page) if not b.reason] for page in PAGES}
SKIPPED = [block for page in PAGES for block in blocks(page) if block.reason]


def execute(page: str) -> None:
    """Run a page's blocks in order, in one namespace; an error is of the page's line."""
    names: dict[str, object] = {"__name__": "__main__"}
    for block in RUN[page]:
        exec(compile("\n" * block.line + block.code, page, "exec"), names)


def put_meshes(folder: Path) -> None:
    """Files that pages name: pose.obj, person.obj, person.glb."""
    dataset = open_dataset(str(folder / "runs/quickstart/dataset.zarr"))
    evaluation = dataset.identities("evaluation")[0]
    for name, identity, pose in (("pose.obj", 0, 3), ("person.obj", evaluation, 0), ("person.glb", evaluation, 0)):
        poses = dataset.grid.poses_of(identity)
        save_mesh(Mesh(dataset.vertices(identity, int(poses[pose])), dataset.faces(identity)), folder / name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pages run: tiny meshes, and in runs/quickstart what ``make run`` leaves there, but for MLflow."""
    folder = tmp_path_factory.mktemp("docs")
    recipe = WorkflowRecipe(
        data=tiny_dataset(poses={"seen": 12, "unseen": 4}),
        training=tiny_training(),
        evaluation=EvaluationRecipe(emd_points=16, examples=1, chunk=8),
    )
    run_workflow(recipe, folder / "runs/quickstart", TaskRunner(local=True))
    put_meshes(folder)
    return folder


@pytest.mark.parametrize("page", [page for page, found in RUN.items() if found and page not in _SLOW])
def test_python_runs_as_printed(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    execute(page)


@pytest.mark.slow
@pytest.mark.parametrize("page", list(_SLOW))
def test_python_with_mlflow_runs_as_printed(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import mlflow

    done = command("--recipe", "smoke", "--local", "--out", "runs/quickstart", script="full.py", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    put_meshes(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = mlflow.get_tracking_uri()
    try:
        execute(page)
    finally:
        mlflow.set_tracking_uri(before)


@pytest.mark.parametrize("block", SKIPPED, ids=lambda block: f"{block.page}:{block.line}")
def test_python_that_does_not_run_here(block: Block) -> None:
    compile(block.code, block.page, "exec")
    pytest.skip(block.reason or "")


def test_no_python_is_left_out() -> None:
    """Python that stands as indented text, or on a page that has none collected, would be run by nobody."""
    imports = re.compile(r"^    (?:import \w+|from [\w.]+ import )", re.M)
    for page in PAGES:
        outside = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
        assert not imports.search(outside), f"{page}: Python as indented text; put it between ```python and ```"
    assert sum(map(len, RUN.values())) >= 7


def shown_commands() -> list[tuple[str, str]]:
    """Pages and the words after ``dsffnet``; a synopsis with ``[--option]`` is none."""
    found = [(page, each["words"]) for page in PAGES for each in _COMMAND.finditer(page.read_text())]
    joined = [(str(page.relative_to(ROOT)), re.sub(r"\\\n\s*", " ", words)) for page, words in found]
    return [(page, words) for page, words in joined if not re.search(r"\[[-A-Z]|\w\|\w|\.\.\.", words)]


@pytest.mark.parametrize(("page", "words"), shown_commands())
def test_commands_have_the_options_that_they_are_shown_with(page: str, words: str) -> None:
    line = shlex.split(words, comments=True)
    line = line[: next((place for place, word in enumerate(line) if word in (">", "|", "&&")), len(line))]
    try:
        parsed(line)
    except SystemExit as error:
        pytest.fail(f"{page}: dsffnet {words} ends with status {error.code}")


def test_examples_are_named_where_people_look() -> None:
    scripts = {path.name for path in (ROOT / "examples").glob("*.py")}
    for page in ("README.md", "docs/index.md"):
        assert scripts == set(re.findall(r"examples/(\w+\.py)`?\]?", (ROOT / page).read_text()))


@pytest.mark.slow
def test_example_poses_two_people(tmp_path: Path) -> None:
    said = example("pose_a_mesh.py", folder=tmp_path)
    assert (tmp_path / "posed.glb").is_file()
    change = float(said.rsplit("differ from the target's by ", 1)[1].split(" %")[0])
    assert np.isfinite(change) and change < 10


@pytest.mark.slow
def test_example_trains_and_compares_two_splits(tmp_path: Path) -> None:
    words = ("--recipe", "smoke", "--steps", "40", "--out", str(tmp_path))
    table = [line.split() for line in example("custom_split.py", *words, folder=tmp_path).splitlines()[-2:]]
    assert [line[0] for line in table] == ["four", "sixteen"] and table[0][2] == table[1][2]
    before = (tmp_path / "four/latest").stat().st_mtime_ns
    assert example("custom_split.py", *words, folder=tmp_path).splitlines()[-2:] == [
        f"{name:12}{float(ours):10.2f}{float(unchanged):20.2f}" for name, ours, unchanged in table
    ]
    assert (tmp_path / "four/latest").stat().st_mtime_ns == before, "nothing is trained twice"


def test_the_picture_of_the_packages_shows_the_contracts() -> None:
    drawn = runpy.run_path(str(ROOT / "docs" / "architecture.py"))["picture"]()
    assert drawn == (ROOT / "docs" / "images" / "architecture.svg").read_text(), "python docs/architecture.py"
