"""The wheel: built, installed away from the source tree, it has all that commands read."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.mesh.files import load_mesh, save_mesh
from datagen.mesh.geometry import Mesh
from tests.support.commands import ROOT

PACKAGES = ("datagen", "dsffnet", "training", "workflows")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which the wheel was installed."""
    folder = tmp_path_factory.mktemp("wheel")
    source, site = folder / "source", folder / "site"
    for name in PACKAGES:  # a build writes into its source tree
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "node_modules"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    alone = ("--no-deps", "--no-index")
    subprocess.run([*PIP, "wheel", *alone, "--no-build-isolation", "--wheel-dir", folder, source], check=True)
    (wheel,) = folder.glob("dsffnet-*.whl")
    subprocess.run([*PIP, "install", *alone, "--no-compile", "--target", site, wheel], check=True)
    return site


def dsffnet(site: Path, *words: object) -> str:
    """What a command of the installed wheel prints."""
    code = "import workflows; print(workflows.__file__); from workflows.cli.main import main; main()"
    place, _, said = python(site, code, *words).partition("\n")
    assert Path(place).is_relative_to(site)
    return said


def python(site: Path, code: str, *words: object) -> str:
    """What a program prints that imports the installed wheel, in a folder from which no source can be imported."""
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=site.parent,
        env=os.environ | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_everything_that_is_read_is_in_it(site: Path) -> None:
    source = site.parent / "source"
    files = [path.relative_to(source) for name in PACKAGES for path in (source / name).rglob("*") if path.is_file()]
    assert not [path for path in files if not (site / path).is_file()]


def test_commands_find_their_recipes(site: Path) -> None:
    assert "one of animals-paper, animals-small, paper, small" in " ".join(dsffnet(site, "compare", "--help").split())
    assert "data:\n  body:\n" in dsffnet(site, "recipe", "--recipe", "quickstart")


def test_two_meshes_with_the_weights_that_come_with_the_project(site: Path, tmp_path: Path) -> None:
    vertices = [[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 1]]
    save_mesh(Mesh(vertices, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), tmp_path / "a.obj")
    dsffnet(site, "transfer", tmp_path / "a.obj", tmp_path / "a.obj", "-o", tmp_path / "b.obj")
    assert load_mesh(tmp_path / "b.obj").vertices.shape == (4, 3)
    code = "import sys, dsffnet; dsffnet.transfer(*sys.argv[1:3]).export(sys.argv[3]); print(dsffnet.__file__)"
    said = python(site, code, *(tmp_path / name for name in ("a.obj", "a.obj", "c.obj")))
    assert Path(said.strip()).is_relative_to(site)
    assert (tmp_path / "c.obj").read_bytes() == (tmp_path / "b.obj").read_bytes()
