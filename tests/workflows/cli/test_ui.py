"""``dsffnet ui``: whatever ends it, nothing of MLflow's server is left, and its port is free."""

import os
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import psutil
import pytest

from tests.support.commands import wait_for
from tests.support.ranks import free_port
from workflows.cli.main import main

ROOT = Path(__file__).parents[3]
SERVER = """
import pathlib, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"])
pathlib.Path(sys.argv[1]).write_text(str(child.pid))
time.sleep(float(sys.argv[2])); sys.exit(3)
"""


def keep(tmp_path: Path, seconds: float) -> tuple["subprocess.Popen[bytes]", psutil.Process]:
    """A keeper of a server, and the server's own child."""
    told = tmp_path / "pid"
    words = [sys.executable, "-m", "workflows.cli.keeper", sys.executable, "-c", SERVER, str(told), str(seconds)]
    keeper = subprocess.Popen(words, cwd=ROOT, stdin=subprocess.PIPE, start_new_session=True)
    wait_for(lambda: told.exists() and told.read_text() != "")
    return keeper, psutil.Process(int(told.read_text()))


def gone(process: psutil.Process) -> bool:
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


def test_the_end_of_its_input_ends_a_server_with_its_children(tmp_path: Path) -> None:
    keeper, child = keep(tmp_path, 100)
    assert not gone(child) and keeper.stdin is not None
    keeper.stdin.close()
    keeper.wait(20)
    wait_for(lambda: gone(child), 5)


def test_a_server_that_ends_by_itself_leaves_no_child_and_its_status(tmp_path: Path) -> None:
    keeper, child = keep(tmp_path, 1)
    assert keeper.wait(20) == 3
    wait_for(lambda: gone(child), 5)


def test_a_folder_without_a_store_and_a_port_that_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["ui", str(tmp_path)])
    assert "mlflow.db is not there yet" in capsys.readouterr().err
    (tmp_path / "mlflow.db").touch()
    with socket.socket() as taken, pytest.raises(SystemExit, match="1"):
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        main(["ui", str(tmp_path), "--port", str(port)])
    assert f"port {port} of 127.0.0.1 cannot be used" in capsys.readouterr().err


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import mlflow

    folder = tmp_path_factory.mktemp("store")
    client = mlflow.MlflowClient(f"sqlite:///{folder / 'mlflow.db'}")
    client.create_experiment("dsffnet", artifact_location=(folder / "mlartifacts").as_uri())
    return folder


def answers(port: int) -> bool:
    try:
        urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5).close()
    except OSError:
        return False
    return True


@pytest.mark.cluster
@pytest.mark.parametrize(
    ("number", "whom"),
    [
        (signal.SIGTERM, "it"),
        (signal.SIGINT, "it"),
        (signal.SIGHUP, "it"),
        (signal.SIGKILL, "it"),
        (signal.SIGKILL, "make"),
    ],
)
def test_nothing_is_left_of_mlflow(store: Path, number: signal.Signals, whom: str) -> None:
    port = free_port()
    words = [sys.executable, "-m", "workflows", "ui", str(store), "--port", str(port)]
    makefile = f"ui:\n\t@{' '.join(words)}\n"
    make = subprocess.Popen(
        ["make", "--file=-", "ui"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True,
        start_new_session=True,
    )
    assert make.stdin is not None
    make.stdin.write(makefile)
    make.stdin.close()
    wait_for(lambda: answers(port), 120)
    family = psutil.Process(make.pid).children(recursive=True)
    command = next(process for process in family if "workflows" in process.cmdline())
    assert len(family) > 2
    (command if whom == "it" else psutil.Process(make.pid)).send_signal(number)
    make.wait(30)
    wait_for(lambda: all(gone(process) for process in family), 15)
    with socket.socket() as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", port))
