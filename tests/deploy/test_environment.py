"""Making the environment: which installer, from where, what it says meanwhile, what it leaves when it fails."""

import importlib.metadata
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest
from packaging.specifiers import SpecifierSet

from tests.support.commands import ROOT

PYTHON = Path(".venv/bin/python")


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """deploy/environment.py in an empty folder, where there is no uv, no GPU, and pip was told of nothing."""
    spec = spec_from_file_location("environment", ROOT / "deploy" / "environment.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TORCH_INDEX", raising=False)
    monkeypatch.setattr(module.shutil, "which", lambda name: None)
    monkeypatch.setattr(module, "has_own_indexes", lambda python: False)
    monkeypatch.setattr(module, "cpu_index", lambda: "https://cpu.example")
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    return module


def test_pip_takes_the_cpu_builds_only_where_it_was_told_of_no_others(
    environment: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "https://cpu.example" in environment.installer(PYTHON)
    monkeypatch.setattr(environment, "has_own_indexes", lambda python: True)
    assert "--extra-index-url" not in environment.installer(PYTHON)
    monkeypatch.setenv("TORCH_INDEX", "https://asked.example")
    assert "https://asked.example" in environment.installer(PYTHON)


def test_uv_is_taken_where_pip_was_told_of_nothing_that_it_would_not_know(
    environment: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environment.shutil, "which", lambda name: "/bin/uv" if name == "uv" else None)
    command = environment.installer(PYTHON)
    assert command[:3] == ["/bin/uv", "pip", "install"] and command[command.index("--torch-backend") + 1] == "cpu"
    monkeypatch.setattr(environment, "cpu_index", lambda: "")
    assert "--torch-backend" not in environment.installer(PYTHON)
    monkeypatch.setattr(environment, "has_own_indexes", lambda python: True)
    assert environment.installer(PYTHON)[0] == str(PYTHON)


@pytest.mark.parametrize(("name", "own"), [("PIP_INDEX_URL", True), ("PIP_FIND_LINKS", True), ("PIP_TIMEOUT", False)])
def test_what_pip_was_told_is_read_from_pip(name: str, own: bool, tmp_path: Path) -> None:
    clean = {key: value for key, value in os.environ.items() if not key.startswith("PIP_")}
    code = "import sys; sys.path[:0] = ['deploy']; import environment as e; print(e.has_own_indexes(sys.executable))"
    told = clean | {name: "20", "PIP_CONFIG_FILE": os.devnull}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=told, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(own)]


def test_what_is_fetched_is_said_every_few_seconds(environment: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [
        "  Downloading https://x.example/a-1.whl.metadata (3 kB)\n",
        "  Downloading https://x.example/a-1-py3.whl (1.5 MB)\n",
        "Downloading b (512.0KiB)\n",
    ]
    progress = environment.Progress(every=0.05)

    def slowly() -> Iterator[str]:
        for line in [*lines, "Installing collected packages: a, b, c\n"]:
            yield line
            progress._ended.wait(0.15)

    assert [line for line in progress.of(slowly()) if "Installing" not in line] == lines
    progress.end()
    said = capsys.readouterr().out
    assert "1 files of 2 MB fetched, 0 installed: fetching a-1-py3.whl (1.5 MB)" in said
    assert "2 files of 2 MB fetched, 0 installed: installing 3 packages" in said


@pytest.mark.parametrize("keeps_nothing", [False, True])
@pytest.mark.parametrize("status", [0, 3])
def test_an_environment_is_ready_only_when_all_was_installed(
    status: int,
    keeps_nothing: bool,
    environment: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    command = [sys.executable, "-c", f"print('No matching distribution'); raise SystemExit({status})"]
    monkeypatch.setattr(
        environment.subprocess, "run", lambda *_, **__: subprocess.CompletedProcess([], 0)
    )  # no venv is made
    monkeypatch.setattr(environment, "installer", lambda python: command)
    monkeypatch.setattr(environment, "by_pip", lambda python: command)
    compiled: list[Path] = []
    monkeypatch.setattr(sys, "dont_write_bytecode", keeps_nothing)
    monkeypatch.setattr(environment, "compile_packages", compiled.append)
    Path(".venv").mkdir()
    assert environment.main() == status
    assert compiled == ([PYTHON] if keeps_nothing and status == 0 else [])
    assert (Path(".venv") / ".ready").exists() is (status == 0)
    shown = capfd.readouterr()
    assert ("No matching distribution" in shown.err) is (status == 3)


def test_every_package_that_is_installed_runs_on_the_oldest_python_that_is_promised() -> None:
    """pip refuses all of them where one asks for more: Debian 12 has Python 3.11.2."""
    for package in importlib.metadata.distributions():
        needed = SpecifierSet(*(package.metadata.get_all("Requires-Python") or []))
        assert needed.contains("3.11.0"), f"{package.name} {package.version} needs Python {needed}: pin an older one"


def test_packages_are_compiled_once_where_nothing_is_kept_later(
    environment: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    packages = Path(".venv/lib/python3.11/site-packages")
    packages.mkdir(parents=True)
    (packages / "sound.py").write_text("A = 1")
    (packages / "template.py").write_text("{{ no Python }}")
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    environment.compile_packages(Path(sys.executable))
    assert [path.name.split(".")[0] for path in packages.glob("__pycache__/*")] == ["sound"]
    assert "compiling the packages" in capsys.readouterr().out
