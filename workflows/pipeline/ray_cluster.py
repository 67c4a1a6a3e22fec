"""One script, two ways to run: inside a Ray job (or with RAY_ADDRESS set) connect; otherwise a Ray of our own."""

import logging
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from datagen.common.errors import ClusterError, RecipeError
from datagen.common.printable import printable
from workflows.pipeline.own_ray import own_ray, sigterm_kept


def on_cluster() -> bool:
    """Whether this process belongs to a Ray cluster that it did not start."""
    return bool(os.environ.get("RAY_ADDRESS") or os.environ.get("RAY_JOB_CONFIG_JSON_ENV_VAR"))


def require_reachable(place: str, *, option: str, urls: bool = False) -> str:
    """A place that other machines and later processes can find; relative ones are made absolute on one machine only.

    Raises
    ------
    RecipeError
        A relative path while running on a cluster, where the working directory is a throw-away copy; a URL where
        only a folder will do; a name that no page, log or server could show; or --data that is a workflow's folder.
    """
    if printable(place) != place:
        raise RecipeError(
            f"{option} '{printable(place)}' holds control characters or bytes that are not UTF-8. Choose another name"
        )
    if "://" in place:
        if urls:
            return place
        raise RecipeError(f"{option} {place!r} is a URL; runs are kept in a folder, on a disk that all machines share")
    if option == "--data" and os.path.isdir(os.path.join(place, "dataset.zarr")):
        raise RecipeError(f"{option} {place} is a workflow's folder. Name the dataset in it: {place}/dataset.zarr")
    if os.path.isabs(place):
        return place
    if on_cluster():
        raise RecipeError(
            f"{option} {place!r} is a relative path, but this runs on a Ray cluster, where the working directory is a "
            f"throw-away copy that is removed after the job. Give an absolute path that all machines share, e.g. "
            f"{option} /data/{place}"
        )
    return os.path.abspath(place)


@contextmanager
def ray_cluster() -> Iterator[None]:
    """A connected Ray; one that was started here is stopped at the end."""
    _set_defaults()
    import ray

    if ray.is_initialized():
        yield
        return
    with _joined() if on_cluster() else own_ray():
        yield


def worker_count() -> int:
    """Tasks that a Ray of our own runs at a time: the CPUs of this machine, or of the container that it runs in."""
    _set_defaults()
    from ray._private.utils import get_num_cpus

    return max(1, int(get_num_cpus(override_docker_cpu_warning=True)))


def _set_defaults() -> None:
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    if not on_cluster() and "ray" not in sys.modules:  # its default here; it reads it at its import, and warns without
        os.environ.setdefault("RAY_AUTH_MODE", "token")


@contextmanager
def _joined() -> Iterator[None]:
    """The cluster that this process belongs to."""
    import ray

    _require_head()
    with sigterm_kept():
        ray.init(logging_level=logging.WARNING)
    try:
        _wait_for_cpus()
        yield
    finally:
        ray.shutdown()


def _require_head() -> None:
    """Ask whether anybody listens where RAY_ADDRESS points; Ray itself would try for minutes without a word."""
    host, _, port = os.environ.get("RAY_ADDRESS", "").rpartition(":")
    if not port.isdigit() or "/" in host:
        return
    try:
        socket.create_connection((host, int(port)), timeout=10).close()
    except OSError as error:
        raise ClusterError(
            f"no Ray head answers at RAY_ADDRESS {host}:{port} ({error}). Start it (ray start --head), or unset "
            "RAY_ADDRESS to run on this machine alone"
        ) from error


def _wait_for_cpus(seconds: float = 60.0) -> None:
    """Wait a while for workers to join a cluster whose head has no CPUs of its own."""
    import ray

    until = time.monotonic() + seconds
    while not ray.cluster_resources().get("CPU"):
        if time.monotonic() > until:
            raise ClusterError(f"the Ray cluster has had no CPUs for {seconds:.0f} s. Add one: ray start --address")
        time.sleep(1.0)
