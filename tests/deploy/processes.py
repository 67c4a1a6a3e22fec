"""The services of docker-compose.yml as processes on 127.0.0.1: their own commands, other hosts, ports and paths."""

import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import composefile
import psutil
from composefile import ROOT

START_SECONDS = 120
STOP_SECONDS = 8
OBJECT_STORE_BYTES = 200_000_000


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def clean_environment() -> dict[str, str]:
    """This process's environment without what would point Ray or MLflow elsewhere; this Python's commands first."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "MLFLOW_", "PG"))}
    return kept | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "RAY_USAGE_STATS_ENABLED": "0",
        "PYTHONUNBUFFERED": "1",
    }


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a process and all that came from it; Ray's nodes and MLflow's workers are processes of their own."""
    try:
        family = psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        family = []
    with_group(process, signal.SIGTERM)
    try:
        process.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        with_group(process, signal.SIGKILL)
        process.wait()
    _, alive = psutil.wait_procs(family, timeout=3)
    for child in alive:
        child.kill()
    psutil.wait_procs(alive, timeout=STOP_SECONDS)


def with_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, number)


@dataclass(frozen=True)
class Stack:
    """Where the services run: a folder, a port for each one in the Compose file, and the secrets of this run."""

    folder: Path
    password: str = field(default_factory=lambda: secrets.token_hex(16))
    token: str = field(default_factory=lambda: secrets.token_hex(32))
    ports: dict[str, int] = field(
        default_factory=lambda: {name: free_port() for name in ("5000", "5432", "6379", "8265", "52365")}
    )
    worker_agent_port: int = field(default_factory=free_port)

    @property
    def mlflow(self) -> str:
        return f"http://127.0.0.1:{self.ports['5000']}"

    @property
    def dashboard(self) -> str:
        return f"http://127.0.0.1:{self.ports['8265']}"

    def words(self, words: list[str], service: str = "") -> list[str]:
        """A command of the Compose file with this machine's hosts, ports and paths."""
        ports = self.ports | ({"52365": self.worker_agent_port} if service == "ray-worker" else {})
        return [self._word(word, ports) for word in words]

    def _word(self, word: str, ports: dict[str, int]) -> str:
        word = re.sub(r"\b(postgres|mlflow|ray-head)(?=:\d)|\b0\.0\.0\.0\b", "127.0.0.1", word)
        word = re.sub(rf"\b({'|'.join(ports)})\b", lambda match: str(ports[match[1]]), word)
        word = re.sub(r"(^|=)/(data|artifacts)\b", rf"\1{self.folder}/\2", word)
        return re.sub(r"^/app\b", str(ROOT), word)

    def environment(self, service: str) -> dict[str, str]:
        """The service's environment, and its secrets as deploy/make-secrets.sh names them."""
        given = composefile.services()[service].get("environment", {})
        secret = {"RAY_AUTH_TOKEN": self.token, "PGPASSWORD": self.password}
        return clean_environment() | secret | {name: self._word(value, self.ports) for name, value in given.items()}

    def command(self, service: str) -> list[str]:
        variables = {"RAY_OBJECT_STORE_BYTES": str(OBJECT_STORE_BYTES)}
        command = self.words(composefile.services(**variables)[service]["command"], service)
        if service == "mlflow" and not can_run_postgres():
            position = next(i for i, word in enumerate(command) if word.startswith("--backend-store-uri="))
            command[position] = f"--backend-store-uri=sqlite:///{self.folder}/mlflow.db"
        if service in {"ray-head", "ray-worker"}:
            # Two nodes of one machine need a folder each; a container has its own. On loopback, as this is a test.
            command += ["--node-ip-address=127.0.0.1", f"--temp-dir={self.folder}/{service[4]}"]
        return command

    @contextmanager
    def running(self, service: str) -> Iterator[None]:
        """Run a service until the block ends; enter it when the service's own health check says healthy."""
        with self.process(self.command(service), service, env=self.environment(service)) as process:
            check = self.words(composefile.services()[service]["healthcheck"]["test"][1:], service)
            self.wait_until_healthy(process, service, check, env=clean_environment())
            yield

    @contextmanager
    def process(
        self, command: list[str], name: str, *, env: dict[str, str], user: str | None = None
    ) -> Iterator[subprocess.Popen[bytes]]:
        with (self.folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                command,
                env=env,
                user=user,
                cwd=self.folder,
                start_new_session=True,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
            try:
                yield process
            finally:
                stop(process)

    def wait_until_healthy(
        self, process: subprocess.Popen[bytes], name: str, check: list[str], *, env: dict[str, str]
    ) -> None:
        deadline = time.monotonic() + START_SECONDS
        while subprocess.run(check, env=env, capture_output=True, check=False).returncode != 0:
            if process.poll() is not None or time.monotonic() > deadline:
                log = (self.folder / f"{name}.log").read_text(errors="replace")
                raise RuntimeError(f"{name} did not become healthy (exit status {process.poll()}):\n{log[-4000:]}")
            time.sleep(0.5)

    @contextmanager
    def postgres(self) -> Iterator[None]:
        """A real PostgreSQL, made as the image's entry point makes it: user and database ``mlflow``."""
        user = "postgres" if os.getuid() == 0 else None  # it refuses to run as root
        home, port = self.folder / "postgres", str(self.ports["5432"])
        home.mkdir()
        (home / "password").write_text(self.password)
        if user:
            for path in (home, home / "password"):
                shutil.chown(path, user)
        env = clean_environment() | {"PGPASSWORD": self.password}
        subprocess.run(
            [*INITDB, "--pgdata", str(home / "data"), "--pwfile", str(home / "password")],
            env=env,
            user=user,
            cwd=home,
            check=True,
            capture_output=True,
        )
        command = ["postgres", "-D", str(home / "data"), "-h", "127.0.0.1", "-p", port, "-k", str(home)]
        with self.process(command, "postgres.server", env=env, user=user) as process:
            self.wait_until_healthy(process, "postgres.server", [sys.executable, "-c", CREATE_DATABASE, port], env=env)
            yield

    def leftovers(self) -> list[psutil.Process]:
        """Processes that still name this run's folder; none may outlive the run."""
        return [
            process
            for process in psutil.process_iter(["cmdline"])
            if any(str(self.folder) in word for word in process.info["cmdline"] or [])
        ]


INITDB = ("initdb", "--username=mlflow", "--auth=scram-sha-256", "--no-sync")
CREATE_DATABASE = """
import sys, psycopg2
connection = psycopg2.connect(host="127.0.0.1", port=sys.argv[1], user="mlflow", dbname="postgres")
connection.autocommit = True
connection.cursor().execute("CREATE DATABASE mlflow")
"""


def can_run_postgres() -> bool:
    return shutil.which("initdb") is not None and find_spec("psycopg2") is not None


@contextmanager
def services_running(names: Sequence[str] = ("mlflow", "ray-head", "ray-worker")) -> Iterator[Stack]:
    """These services, MLflow with PostgreSQL (or SQLite where there is none); all ended with the block."""
    # Ray's socket paths have a limit of 107 characters, which pytest's folders pass; and PostgreSQL's user must get in.
    folder = Path(tempfile.mkdtemp(prefix="dsf", dir="/tmp"))
    folder.chmod(0o755)
    for name in ("data", "artifacts"):
        (folder / name).mkdir()
    stack = Stack(folder)
    try:
        with ExitStack() as running:
            if "mlflow" in names and can_run_postgres():
                running.enter_context(stack.postgres())
            for service in names:
                running.enter_context(stack.running(service))
            yield stack
    finally:
        left = stack.leftovers()
        for process in left:
            process.kill()
        shutil.rmtree(folder, ignore_errors=True)
        if left:
            raise RuntimeError(f"outlived its service: {[process.info['cmdline'][:3] for process in left]}")
