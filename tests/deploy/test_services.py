"""The cluster of docker-compose.yml for real: MLflow over HTTP, a Ray head, one more node, submitted jobs."""

import json
import re
import shutil
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from composefile import ROOT
from processes import Stack, can_run_postgres, services_running

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(1200)]

JOB_SECONDS = 900


@pytest.fixture(scope="module")
def stack() -> Iterator[Stack]:
    with services_running() as running:
        yield running


def ask(url: str, *, body: object = None, method: str | None = None, **headers: str) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data, {"Content-Type": "application/json", **headers}, method=method)
    with urllib.request.urlopen(request, timeout=20) as answer:
        return json.loads(answer.read() or "null")


def submit(stack: Stack, *entrypoint: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Submit a job with the client's own command up to ``--``, from this checkout or another folder."""
    command = stack.command("client")
    return subprocess.run(
        [*command[: command.index("--") + 1], *entrypoint],
        cwd=folder,
        env=stack.environment("client"),
        timeout=JOB_SECONDS,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )


def workflow(stack: Stack, *extra: str) -> list[str]:
    """The client's entry point, with further arguments."""
    command = stack.command("client")
    return [*command[command.index("--") + 1 :], *extra]


def runs(stack: Stack) -> list[dict[str, Any]]:
    experiments = ask(f"{stack.mlflow}/api/2.0/mlflow/experiments/search", body={"max_results": 100})["experiments"]
    identifiers = [experiment["experiment_id"] for experiment in experiments]
    found = ask(f"{stack.mlflow}/api/2.0/mlflow/runs/search", body={"experiment_ids": identifiers, "max_results": 100})
    return list(found.get("runs", []))


def parent_of(run: dict[str, Any]) -> str | None:
    tags = {tag["key"]: tag["value"] for tag in run["data"].get("tags", [])}
    return tags.get("mlflow.parentRunId")


@pytest.mark.parametrize(
    ("host", "status"), [("mlflow:5000", 200), ("localhost:5001", 200), ("elsewhere.example", 403)]
)
def test_mlflow_answers_to_its_own_names_only(stack: Stack, host: str, status: int) -> None:
    # The Compose file names mlflow:5000, which this run has exchanged for 127.0.0.1 and a port.
    host = f"127.0.0.1:{stack.ports['5000']}" if host.startswith("mlflow") else host
    url = f"{stack.mlflow}/api/2.0/mlflow/experiments/search?max_results=1"
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers={"Host": host}), timeout=20) as answer:
            assert answer.status == status
    except urllib.error.HTTPError as error:
        assert error.code == status


def test_mlflow_stores_artifacts_in_the_volume(stack: Stack) -> None:
    url = f"{stack.mlflow}/api/2.0/mlflow-artifacts/artifacts/probe/hello.json"
    ask(url, body={"hello": "world"}, method="PUT")
    assert json.loads((stack.folder / "artifacts" / "probe" / "hello.json").read_text()) == {"hello": "world"}


@pytest.mark.skipif(not can_run_postgres(), reason="needs PostgreSQL's programs")
def test_the_documented_backup_of_the_database_can_be_restored(stack: Stack) -> None:
    ask(f"{stack.mlflow}/api/2.0/mlflow/experiments/create", body={"name": "to be kept"})
    guide = (ROOT / "docs" / "cluster.md").read_text()
    dump, restore = (re.search(rf"-T postgres ({name} [^<>]*)[<>]", guide) for name in ("pg_dump", "pg_restore"))
    assert dump and restore

    def postgres(command: str, **streams: Any) -> str:
        program, *options = command.split()
        words = [
            str(Path(shutil.which("initdb") or "").resolve().with_name(program)),
            "--host=127.0.0.1",
            f"--port={stack.ports['5432']}",
            *options,
        ]
        environment = stack.environment("mlflow")
        return subprocess.run(words, env=environment, check=True, text=True, stdout=subprocess.PIPE, **streams).stdout

    kept = stack.folder / "mlflow.dump"
    dumped = dump[1].split()
    postgres(" ".join([*dumped[:-1], f"--file={kept}", dumped[-1]]))
    postgres("createdb --username=mlflow restored")
    with kept.open("rb") as file:
        postgres(restore[1].replace("--dbname=mlflow", "--dbname=restored"), stdin=file)
    query = "SELECT name FROM experiments ORDER BY name"
    both = [
        postgres(f"psql --username=mlflow --dbname={name} --tuples-only --no-align --file=-", input=query)
        for name in ("mlflow", "restored")
    ]
    assert both[0] == both[1] and "to be kept" in both[0].splitlines()


def test_ray_job_submit_runs_the_same_job(stack: Stack) -> None:
    """What people of Ray are used to."""
    command = ["ray", "job", "submit", f"--address={stack.dashboard}", "--working-dir", ".", "--"]
    done = subprocess.run(
        [*command, "python", "workflows/full.py", "--help"],
        cwd=ROOT, env=stack.environment("client"), capture_output=True, text=True, timeout=JOB_SECONDS, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "keys for --set" in done.stdout, done.stdout[-4000:] + done.stderr[-2000:]


def test_ray_refuses_whoever_has_no_token(stack: Stack) -> None:
    with pytest.raises(urllib.error.HTTPError) as refused:
        ask(f"{stack.dashboard}/api/jobs/")
    assert refused.value.code == 401


def test_two_nodes_are_alive_and_only_the_worker_gives_cpus(stack: Stack) -> None:
    answer = ask(f"{stack.dashboard}/api/v0/nodes", Authorization=f"Bearer {stack.token}")
    nodes = answer["data"]["result"]["result"]
    cpus = [node["resources_total"].get("CPU", 0) for node in nodes if node["state"] == "ALIVE"]
    assert sorted(cpus) == [0, 2]


TASK_SAYS_WHERE = """
import os, pathlib, ray, datagen
ray.init()
@ray.remote
def where(): return os.getpid(), datagen.__file__, sorted(path.name for path in pathlib.Path("deploy").rglob("*"))
pid, source, files = ray.get(where.remote())
assert pid != os.getpid()
print("source", source, "files", files)
"""


def test_a_job_runs_the_code_of_its_working_directory_without_the_secrets(stack: Stack, tmp_path: Path) -> None:
    (tmp_path / "datagen").mkdir()
    (tmp_path / "datagen" / "__init__.py").touch()
    (tmp_path / "deploy" / "secrets").mkdir(parents=True)
    (tmp_path / "deploy" / "secrets" / "ray.env").write_text("RAY_AUTH_TOKEN=of-the-host")
    shutil.copy(ROOT / "deploy" / ".gitignore", tmp_path / "deploy")
    shutil.copy(ROOT / "deploy" / "healthy.py", tmp_path / "deploy")
    done = submit(stack, "python", "-c", TASK_SAYS_WHERE, folder=tmp_path)
    assert done.returncode == 0, done.stdout[-4000:]
    assert re.search(r"source \S+/working_dir_files/\S+/datagen/__init__.py", done.stdout)
    assert "healthy.py" in done.stdout and "ray.env" not in done.stdout


def test_a_relative_output_folder_is_refused(stack: Stack) -> None:
    """A job's working directory is a copy that is thrown away."""
    done = submit(stack, "python", "workflows/full.py", "--recipe", "smoke", "--out", "runs/lost")
    assert done.returncode != 0
    assert "absolute" in done.stdout, done.stdout[-4000:]


def test_the_whole_workflow_as_a_job(stack: Stack) -> None:
    done = submit(stack, *workflow(stack, "--recipe", "smoke"))
    assert done.returncode == 0, done.stdout[-8000:]
    found = runs(stack)
    parents = [run for run in found if parent_of(run) is None]
    assert len(parents) == 1
    children = [run for run in found if parent_of(run) == parents[0]["info"]["run_id"]]
    assert sorted(run["info"]["run_name"] for run in children) == ["evaluate", "generate", "train"]
    assert {run["info"]["status"] for run in found} == {"FINISHED"}
    assert (stack.folder / "data" / "runs" / "quickstart").is_dir()
