"""``dsffnet ui``: MLflow's page of a folder. Its server is several processes; they end with this one, come what may."""

import argparse
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from datagen.common.errors import DatasetError, DsffnetError
from training.tracking.mlflow_store import experiment_in, page_addresses, prepare_store, sqlite_server
from workflows.cli.declare import Command, Parser

_LOOK_SECONDS = 0.3


class PageError(DsffnetError):
    """MLflow's page cannot be shown."""


def ui_command(options: argparse.Namespace) -> None:
    """Show a folder's MLflow store in the browser, until Ctrl-C or the end of what started this.

    examples:
      dsffnet ui
      dsffnet ui runs/custom --port 5001
    """
    database = Path(os.path.realpath(options.out)) / "mlflow.db"
    if not database.is_file():
        raise DatasetError(
            f"{database} is not there yet: python workflows/full.py makes it; for another folder: dsffnet ui FOLDER"
        )
    port = options.port
    require_free("127.0.0.1", port, another="dsffnet ui --port {0}, or make ui UI_PORT={0}")
    server = _server(database, port)
    print(_addresses(database, port), flush=True)
    status = _serve(server, ended=_parent_is_gone())
    if status:
        raise PageError(f"MLflow's server ended with status {status}; its words are above")


def _server(database: Path, port: int) -> list[str]:
    server = sqlite_server(database, own=True)
    prepare_store(server)
    return [
        *(sys.executable, "-m", "mlflow", "ui", "--host", "127.0.0.1", "--port", str(port), "--workers", "1"),
        *("--uvicorn-opts", "--log-level warning"),
        *("--backend-store-uri", server.uri, "--registry-store-uri", server.uri),
        *("--artifacts-destination", str(server.artifacts)),
    ]


def _addresses(database: Path, port: int) -> str:
    """Where the runs and the model are among MLflow's pages."""
    base = f"http://127.0.0.1:{port}"
    experiment = experiment_in(database)
    pages = page_addresses(base, experiment) if experiment else {"MLflow": base}
    lines = [f"{name:8}{address}" for name, address in pages.items()]
    return "\n".join([*lines, "Ready in some seconds; Ctrl-C ends it."])


def require_free(host: str, port: int, *, another: str) -> None:
    """Refuse a port that cannot be listened at; ``another``: what to type for the other one ``{0}``.

    Raises
    ------
    PageError
        It is taken, or not to be had.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            other = another.format(port + 1 if 0 < port < 65535 else 8080)
            raise PageError(f"port {port} of {host} cannot be used ({reason}). Another: {other}") from error


def _parent_is_gone() -> Callable[[], bool]:
    """Whether the shell or make that started this has died; one that is killed cannot tell."""
    parent = os.getppid()
    return lambda: os.getppid() != parent


def _serve(command: list[str], *, ended: Callable[[], bool]) -> int:
    """Run a server until it ends by itself (its status), or ``ended`` says so (0); a signal ends it too."""
    signal.signal(signal.SIGHUP, signal.getsignal(signal.SIGTERM))  # a closed terminal, of nohup too
    quiet = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",  # eight processes fewer
             "PYTHONWARNINGS": "ignore"}  # fmt: skip
    keeper = subprocess.Popen(
        [sys.executable, "-m", "workflows.cli.keeper", *command],
        stdin=subprocess.PIPE,
        start_new_session=True,
        env=os.environ | quiet,
    )
    assert keeper.stdin is not None
    try:
        while keeper.poll() is None and not ended():
            time.sleep(_LOOK_SECONDS)
        return keeper.poll() or 0
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt("MLflow's page is closed") from interrupt
    finally:
        keeper.stdin.close()
        keeper.wait()


def _ui_options(made: Parser) -> None:
    made.add_argument(
        "out", nargs="?", default="runs/quickstart", metavar="FOLDER", help="of a workflow (default: %(default)s)"
    )
    made.add_argument("--port", type=int, default=5000, help="of 127.0.0.1 (default: %(default)s)")


COMMAND = Command(ui_command, _ui_options)
