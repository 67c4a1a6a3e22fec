"""docker-compose.yml against what this project asks of it; its form is checked by ``make lint``."""

import os
import re
import stat
import subprocess
from pathlib import Path, PurePosixPath

import click
import composefile
import pytest
from composefile import RAY_SERVICES, ROOT, Service

from workflows.cli.main import parsed

SERVICES = composefile.services()
PROJECT_SERVICES = ("mlflow", *RAY_SERVICES)


@pytest.mark.parametrize("name", SERVICES)
def test_ports_are_published_on_loopback_only(name: str) -> None:
    assert all(str(port).startswith("127.0.0.1:") for port in SERVICES[name].get("ports", []))


def test_database_is_not_published() -> None:
    assert "ports" not in SERVICES["postgres"]


@pytest.mark.parametrize("name", SERVICES)
def test_every_server_has_a_health_check_and_comes_back(name: str) -> None:
    service = SERVICES[name]
    if service.get("profiles"):  # a job: it ends, so there is nothing to watch, and it must not start again by itself
        assert service["restart"] == "no"
        return
    assert service["restart"] == "unless-stopped"
    assert service["healthcheck"]["test"][0] == "CMD"
    for argument in service["healthcheck"]["test"]:
        if argument.startswith("/app/"):
            assert (ROOT / PurePosixPath(argument).relative_to("/app")).is_file()


@pytest.mark.parametrize("name", SERVICES)
def test_waits_for_the_health_of_what_it_needs(name: str) -> None:
    for needed, how in SERVICES[name].get("depends_on", {}).items():
        assert how == {"condition": "service_healthy"}
        assert "healthcheck" in SERVICES[needed]


def test_client_waits_for_all_it_talks_to() -> None:
    assert set(SERVICES["client"]["depends_on"]) == {"mlflow", "ray-head", "ray-worker"}


def size_in_bytes(text: str) -> int:
    number, unit = re.fullmatch(r"(\d+)([kmg]b)", text).groups()  # type: ignore[union-attr]
    return int(number) * int(1024 ** ("kmg".index(unit[0]) + 1))


@pytest.mark.parametrize("name", ["ray-head", "ray-worker"])
def test_object_store_fits_into_shared_memory(name: str) -> None:
    object_store = int(composefile.option(SERVICES[name]["command"], "--object-store-memory"))
    assert object_store <= size_in_bytes(SERVICES[name]["shm_size"])


@pytest.mark.parametrize("name", RAY_SERVICES)
def test_ray_asks_for_a_token(name: str) -> None:
    assert SERVICES[name]["environment"]["RAY_AUTH_MODE"] == "token"
    assert SERVICES[name]["env_file"] == ["deploy/secrets/ray.env"]


def test_mlflow_answers_under_the_name_its_clients_use() -> None:
    allowed = SERVICES["mlflow"]["environment"]["MLFLOW_SERVER_ALLOWED_HOSTS"].split(",")
    uri = composefile.option(SERVICES["client"]["command"], "--tracking-uri")
    assert uri.removeprefix("http://") in allowed
    assert all(SERVICES[name]["environment"]["MLFLOW_TRACKING_URI"] == uri for name in RAY_SERVICES)
    assert "*" not in allowed


def test_data_lies_at_the_same_path_on_every_node() -> None:
    assert all("data:/data" in SERVICES[name]["volumes"] for name in RAY_SERVICES)
    assert composefile.option(SERVICES["client"]["command"], "--out").startswith("/data/")


def test_artifacts_and_database_lie_on_volumes() -> None:
    destination = composefile.option(SERVICES["mlflow"]["command"], "--artifacts-destination")
    assert f"artifacts:{destination}" in SERVICES["mlflow"]["volumes"]
    assert SERVICES["postgres"]["volumes"] == ["postgres:/var/lib/postgresql/data"]
    assert set(composefile.load()["volumes"]) == {"artifacts", "postgres", "data"}


def test_one_project_image_and_exact_tags() -> None:
    assert len({SERVICES[name]["image"] for name in PROJECT_SERVICES}) == 1
    base = re.findall(r"^FROM (\S+)", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    for image in [*base, *(service["image"] for service in SERVICES.values())]:
        assert re.search(r":\d+\.\d+", image), f"{image} has no exact tag"


def test_image_does_not_run_as_root() -> None:
    users = re.findall(r"^USER (\S+)", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert users and users[-1] not in {"root", "0"}
    assert not any("user" in SERVICES[name] for name in PROJECT_SERVICES)
    assert SERVICES["postgres"]["user"] == "postgres"  # that image would begin as root, and need capabilities


def test_code_belongs_to_root() -> None:
    """What runs in a container, submitted jobs among it, cannot change the code of the next one."""
    text = (ROOT / "Dockerfile").read_text()
    assert re.search(r"^COPY \. \.$", text, re.MULTILINE) and "COPY --chown" not in text
    given_away = re.search(r"chown \S+ (.*)$", text, re.MULTILINE)
    assert given_away and given_away[1].split() == ["/data", "/artifacts"]
    assert text.rindex("USER ") > text.rindex("COPY . .")


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_gains_no_rights_and_writes_to_its_volumes_only(name: str) -> None:
    service = SERVICES[name]
    assert service["cap_drop"] == ["ALL"] and "cap_add" not in service and "privileged" not in service
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["read_only"] is True
    written = {volume.rpartition(":")[2] for volume in service["volumes"]} | set(service.get("tmpfs", []))
    assert "/tmp" in written and not any(path == "/app" or path.startswith("/app/") for path in written)
    assert not any("docker.sock" in volume for volume in service["volumes"])


def test_everything_the_project_writes_to_is_a_volume() -> None:
    """Ray's sessions, MLflow's spooled uploads, and the caches of Anny, warp and matplotlib in the home folder."""
    home = re.search(r"useradd .*--create-home (\w+)", (ROOT / "Dockerfile").read_text())
    assert home is not None
    for name in PROJECT_SERVICES:
        assert {"/tmp", f"/home/{home[1]}"} <= set(SERVICES[name]["volumes"])
    assert "/var/run/postgresql" in SERVICES["postgres"]["tmpfs"]


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_has_limits_that_the_environment_may_set(name: str) -> None:
    service = SERVICES[name]
    assert size_in_bytes(service["mem_limit"]) >= 1024**3 and int(service["pids_limit"]) >= 256
    prefix = {"client": "CLIENT", "postgres": "POSTGRES", "mlflow": "MLFLOW"}.get(name, name.upper().replace("-", "_"))
    assert composefile.services(**{f"{prefix}_MEMORY": "3gb"})[name]["mem_limit"] == "3gb"
    pids = "RAY_PIDS" if name in RAY_SERVICES else f"{prefix}_PIDS"
    assert str(composefile.services(**{pids: "77"})[name]["pids_limit"]) == "77"


@pytest.mark.parametrize("name", ["ray-head", "ray-worker"])
def test_shared_memory_leaves_room_within_the_limit(name: str) -> None:
    assert size_in_bytes(SERVICES[name]["shm_size"]) <= size_in_bytes(SERVICES[name]["mem_limit"]) / 2


@pytest.mark.parametrize("name", SERVICES)
def test_logs_are_rotated(name: str) -> None:
    logging = SERVICES[name]["logging"]
    assert logging["driver"] == "json-file"
    assert re.fullmatch(r"\d+m", logging["options"]["max-size"]) and int(logging["options"]["max-file"]) > 1


def test_jobs_do_not_reach_the_database() -> None:
    """Ray runs any code it is sent; only MLflow is in both networks."""
    networks = {name: set(service["networks"]) for name, service in SERVICES.items()}
    assert networks["postgres"] == {"tracking"} and networks["mlflow"] == {"tracking", "cluster"}
    assert all(networks[name] == {"cluster"} for name in RAY_SERVICES)
    assert composefile.load()["networks"] == {"tracking": {"internal": True}, "cluster": None}
    assert all("postgres.env" not in file for name in RAY_SERVICES for file in SERVICES[name]["env_file"])


def click_command(words: list[str]) -> tuple[click.Command, list[str]]:
    """The installed command line that a service calls, and the arguments that it gets."""
    if words[:2] == ["mlflow", "server"]:
        from mlflow.cli import server

        return server, words[2:]
    if words[:2] == ["ray", "start"]:
        from ray.scripts.scripts import start

        return start, words[2:]
    raise AssertionError(f"{words[:2]} is none of the command lines that services call")


def parse(service: Service) -> dict[str, object]:
    if service["command"][0] == "dsffnet":
        return dict(vars(parsed(service["command"][1:])))
    command, arguments = click_command(service["command"])
    return dict(command.make_context(str(command.name), list(arguments)).params)


@pytest.mark.parametrize("name", PROJECT_SERVICES)
def test_installed_tools_accept_the_command(name: str) -> None:
    assert parse(SERVICES[name])


def test_installed_tools_refuse_an_unknown_flag() -> None:
    command = [*SERVICES["ray-head"]["command"], "--no-such-flag"]
    with pytest.raises(click.NoSuchOption):
        parse({"command": command})


def test_client_submits_the_full_workflow() -> None:
    entrypoint = parse(SERVICES["client"])["entrypoint"]
    assert isinstance(entrypoint, list)
    assert entrypoint[:2] == ["python", "workflows/full.py"]
    assert (ROOT / "workflows" / "full.py").is_file()


def test_secrets_are_written_once_and_kept_private(tmp_path: Path) -> None:
    script = tmp_path / "deploy" / "make-secrets.sh"
    script.parent.mkdir()
    script.write_text((ROOT / "deploy" / "make-secrets.sh").read_text())
    contents = []
    for _ in range(2):
        subprocess.run(["sh", str(script)], check=True, env={"PATH": os.environ["PATH"]}, cwd=tmp_path)
        contents.append({path.name: path.read_text() for path in (script.parent / "secrets").iterdir()})
    assert contents[0] == contents[1]
    assert set(contents[0]) == {"ray.env", "postgres.env"}
    assert re.fullmatch(r"RAY_AUTH_TOKEN=[0-9a-f]{64}\n", contents[0]["ray.env"])
    assert stat.S_IMODE((script.parent / "secrets" / "ray.env").stat().st_mode) == 0o600


def test_secrets_reach_neither_the_repository_nor_an_image_nor_a_job() -> None:
    # Ray leaves out of a job's upload what a .gitignore names, in whatever folder that .gitignore lies.
    assert "secrets/" in (ROOT / "deploy" / ".gitignore").read_text().splitlines()
    assert "deploy/secrets" in (ROOT / ".dockerignore").read_text().splitlines()
    used = {file for service in SERVICES.values() for file in service.get("env_file", [])}
    assert used == {"deploy/secrets/ray.env", "deploy/secrets/postgres.env"}
