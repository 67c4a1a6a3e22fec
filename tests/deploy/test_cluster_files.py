"""The cluster configurations in deploy/ by Ray's own schema; KubeRay's, whose schema no package has, by its fields."""

import json
from pathlib import Path
from typing import Any

import composefile
import jsonschema
import pytest
import ray
import yaml
from composefile import ROOT
from ray.autoscaler._private.util import prepare_config
from ray.scripts.scripts import start

from workflows.full import _parser

CLUSTERS = ("ray-local.yaml", "ray-aws.yaml")
SCHEMA = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())
COMMANDS = ("head_start_ray_commands", "worker_start_ray_commands")

# Fields as KubeRay's reference of ray.io/v1 lists them (1.6): https://ray-project.github.io/kuberay/reference/api/
RAY_JOB: dict[str, type] = {
    "activeDeadlineSeconds": int, "backoffLimit": int, "clusterSelector": dict, "deletionStrategy": dict,
    "entrypoint": str, "entrypointNumCpus": float, "entrypointNumGpus": float, "entrypointResources": str,
    "jobId": str, "managedBy": str, "metadata": dict, "rayClusterSpec": dict, "runtimeEnvYAML": str,
    "shutdownAfterJobFinishes": bool, "submissionMode": str, "submitterConfig": dict, "submitterPodTemplate": dict,
    "suspend": bool, "ttlSecondsAfterFinished": int,
}  # fmt: skip
RAY_CLUSTER: dict[str, type] = {
    "authOptions": dict, "autoscalerOptions": dict, "enableInTreeAutoscaling": bool, "gcsFaultToleranceOptions": dict,
    "headGroupSpec": dict, "headServiceAnnotations": dict, "managedBy": str, "rayVersion": str, "suspend": bool,
    "workerGroupSpecs": list,
}  # fmt: skip
HEAD: dict[str, type] = {
    "enableIngress": bool, "headService": dict, "rayStartParams": dict, "serviceType": str, "template": dict,
}  # fmt: skip
WORKERS: dict[str, type] = {
    "groupName": str, "idleTimeoutSeconds": int, "maxReplicas": int, "minReplicas": int, "numOfHosts": int,
    "rayStartParams": dict, "replicas": int, "scaleStrategy": dict, "suspend": bool, "template": dict,
}  # fmt: skip


def load(name: str) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((ROOT / "deploy" / name).read_text())
    return content


def accepted(words: list[str]) -> dict[str, Any]:
    """The options of a ``ray start`` as the installed one reads them."""
    return dict(start.make_context("start", words).params)


def started(command: str) -> dict[str, Any]:
    return accepted(command.replace("$RAY_HEAD_IP", "head").partition(" start ")[2].split())


@pytest.mark.parametrize("name", CLUSTERS)
def test_ray_knows_every_key_and_fills_in_the_rest(name: str) -> None:
    jsonschema.validate(load(name), SCHEMA)
    jsonschema.validate(prepare_config(load(name)), SCHEMA)  # what it makes of it, with the provider's own checks
    with pytest.raises(jsonschema.ValidationError, match="no_such_key"):
        jsonschema.validate(load(name) | {"no_such_key": 1}, SCHEMA)


@pytest.mark.parametrize("name", CLUSTERS)
def test_nodes_start_with_a_token_and_the_head_gives_no_cpus(name: str) -> None:
    config = load(name)
    head, worker = (config[commands][-1] for commands in COMMANDS)
    assert all(command.startswith("RAY_AUTH_MODE=token ") for command in (head, worker))
    assert "~/.ray/auth_token" in config["file_mounts"]
    assert started(head)["head"] and started(head)["dashboard_host"] == "127.0.0.1"
    assert started(worker)["address"] == "head:6379"
    of_type = config.get("available_node_types", {}).get("head", {}).get("resources", {})
    assert started(head)["num_cpus"] == 0 or of_type == {"CPU": 0}


@pytest.mark.parametrize("name", CLUSTERS)
def test_secrets_and_the_environment_of_this_machine_stay_here(name: str) -> None:
    assert {"**/.venv/**", "**/secrets/**"} <= set(load(name)["rsync_exclude"])


def groups(job: dict[str, Any]) -> list[dict[str, Any]]:
    cluster = job["spec"]["rayClusterSpec"]
    return [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]


def fits(value: dict[str, Any], fields: dict[str, type]) -> None:
    for name, content in value.items():
        assert name in fields, f"{name} is no field; known: {', '.join(fields)}"
        assert isinstance(content, fields[name]), f"{name}: {content!r}"


def test_the_ray_job_has_fields_that_kuberay_knows() -> None:
    job = load("kuberay.yaml")
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    fits(job["spec"], RAY_JOB)
    cluster = job["spec"]["rayClusterSpec"]
    fits(cluster, RAY_CLUSTER)
    fits(cluster["headGroupSpec"], HEAD)
    for group in cluster["workerGroupSpecs"]:
        fits(group, WORKERS)
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
    with pytest.raises(AssertionError, match="entry is no field"):
        fits({"entry": ""}, RAY_JOB)


def of_parameters(parameters: dict[str, str]) -> dict[str, Any]:
    """What the operator makes of ``rayStartParams``: options of ``ray start``, a switch where the value is "true"."""
    assert all(isinstance(value, str) for value in parameters.values())
    return accepted([f"--{key}" if value == "true" else f"--{key}={value}" for key, value in parameters.items()])


def test_the_ray_job_is_the_compose_file_s_cluster() -> None:
    """Image, Ray's version and token, the head's role, shared data, health checks and rights."""
    job, services = load("kuberay.yaml"), composefile.services()
    cluster = job["spec"]["rayClusterSpec"]
    assert f"ray=={cluster['rayVersion']}" in (ROOT / "constraints.txt").read_text().splitlines()
    assert cluster["authOptions"] == {"mode": "token"}
    for group, service in zip(groups(job), (services["ray-head"], services["ray-worker"]), strict=True):
        given, own = of_parameters(group["rayStartParams"]), accepted(service["command"][2:])
        assert given["object_store_memory"] == own["object_store_memory"]
        assert group is not cluster["headGroupSpec"] or given["num_cpus"] == own["num_cpus"] == 0
        pod = group["template"]["spec"]
        (container,) = pod["containers"]
        assert container["image"] == service["image"] and pod["securityContext"]["runAsNonRoot"] is True
        assert container["securityContext"]["capabilities"] == {"drop": service["cap_drop"]}
        assert container["securityContext"]["readOnlyRootFilesystem"] is service["read_only"]
        mounts = {mount["mountPath"]: mount["name"] for mount in container["volumeMounts"]}
        assert set(mounts) == {volume.rpartition(":")[2] for volume in service["volumes"]}
        assert set(mounts.values()) == {volume["name"] for volume in pod["volumes"]}
        for probe in ("livenessProbe", "readinessProbe"):
            assert container[probe]["exec"]["command"] == service["healthcheck"]["test"][1:]


def test_the_ray_job_runs_a_command_that_there_is() -> None:
    words = load("kuberay.yaml")["spec"]["entrypoint"].split()
    assert words[:2] == ["python", "/app/workflows/full.py"]
    options = _parser(words[2:]).parse_args(words[2:])
    assert options.out.startswith("/data/") and options.tracking_uri.startswith("http")
