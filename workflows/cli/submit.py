"""``dsffnet submit``: a command as a Ray job, followed to its end, with an exit status that tells how it ended.

``ray job submit`` follows the log alone, and ends with status 0 when the log ends, also where the job's driver or its
node died and nobody is left to note a failure.
"""

import argparse
import asyncio
import shlex
import sys
import threading
import time
from contextlib import suppress
from typing import Any, Protocol

from datagen.common.errors import ClusterError, first_line_of
from workflows.cli.declare import Command, Parser

_LOOK_SECONDS = 2.0
_LOST_SECONDS = 60.0  # without an answer of the cluster, or without the driver's node, until the job is given up
_LOG_SECONDS = 20.0  # for the rest of the log of a job that has ended


class Job(Protocol):
    """A submitted job, as :func:`follow` sees it."""

    name: str

    def info(self) -> Any:
        """Return Ray's ``JobDetails``; raise :class:`ConnectionError` where the cluster does not answer."""

    def node_is_alive(self, node: str) -> bool:
        """Whether a node of the cluster is alive; raise :class:`ConnectionError` as above."""


def submit_command(options: argparse.Namespace) -> None:
    """Run a command as a Ray job, show its log, and end with status 0 only if the job succeeded.

    examples:
      dsffnet submit -- python workflows/full.py --out /shared/runs/quickstart
      dsffnet submit --address http://HEAD:8265 -- dsffnet train --data /shared/x.zarr --out /shared/runs/first
    """
    job = submitted(options.entrypoint, options.address, options.working_dir)
    print(f"submitted: job {job.name}", flush=True)
    try:
        _follow_with_log(job)
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(
            f"the job continues. Its log: ray job logs --follow {job.name}; its status: ray job status {job.name}; "
            f"its end: ray job stop {job.name}"
        ) from interrupt
    print(f"job {job.name} succeeded")


def follow(job: Job, *, look: float = _LOOK_SECONDS, lost: float = _LOST_SECONDS) -> None:
    """Wait for the end of a job.

    Raises
    ------
    ClusterError
        It failed or was stopped; or the cluster, or the node of its driver, has been gone for ``lost`` seconds.
    """
    seen = time.monotonic()
    while True:
        try:
            info = job.info()
            if info.status.is_terminal():
                return _require_success(job.name, info)
            if info.driver_node_id is None or job.node_is_alive(info.driver_node_id):
                seen = time.monotonic()
            trouble = "the node that its driver ran on is dead"
        except ConnectionError as error:
            trouble = f"the cluster does not answer ({error})"
        if time.monotonic() - seen > lost:
            raise ClusterError(
                f"job {job.name} is lost: {trouble}, for {lost:.0f} s now. When the cluster is well again, submit the "
                "same command: it resumes from what is complete"
            )
        time.sleep(look)


def _require_success(name: str, info: Any) -> None:
    if info.status == "SUCCEEDED":
        return
    if info.status == "STOPPED":
        raise ClusterError(f"job {name} was stopped. Submit the same command to resume")
    told = (info.message or "no reason is known").strip().splitlines()[0]
    how = f"its command ended with status {info.driver_exit_code}" if info.driver_exit_code else told
    raise ClusterError(f"job {name} failed: {how}. Its log: ray job logs {name}")


def _follow_with_log(job: "RayJob") -> None:
    """Follow a job while its log is printed."""
    over = threading.Event()
    log = threading.Thread(target=job.print_log, args=(over,), name="job-log", daemon=True)
    log.start()
    try:
        follow(job)
    finally:
        over.set()
        if not isinstance(sys.exception(), KeyboardInterrupt):  # the job goes on, and its log with it
            log.join(_LOG_SECONDS)


class RayJob:
    """A job of a Ray cluster, over HTTP."""

    def __init__(self, client: Any, name: str) -> None:
        self._client, self.name, self._shown = client, name, 0

    def info(self) -> Any:
        from requests import RequestException

        try:
            return self._client.get_job_info(self.name)
        except RequestException as error:
            raise ConnectionError(type(error).__name__) from error
        except RuntimeError as error:
            if "404" in str(error):
                raise ClusterError(
                    f"the cluster does not know job {self.name}; has its head been restarted?"
                ) from error
            raise ConnectionError(first_line_of(error)) from error

    def node_is_alive(self, node: str) -> bool:
        from ray.util.state import list_nodes

        try:
            nodes = list_nodes(address=self._client.get_address(), raise_on_missing_output=False)
        except Exception as error:  # HTTP's, Ray's own, and a RuntimeError are among them
            raise ConnectionError(first_line_of(error)) from error
        return any(each.node_id == node and each.state == "ALIVE" for each in nodes)

    def print_log(self, over: threading.Event) -> None:
        """Print the log until the job is over; where the connection breaks, resume after what was printed."""
        while True:
            last = over.is_set()
            with suppress(Exception):  # the log is a courtesy: what the job came to is asked elsewhere
                asyncio.run(self._print_rest())
            if last:
                return
            over.wait(_LOOK_SECONDS)

    async def _print_rest(self) -> None:
        """Ray tells the log from its beginning each time."""
        told = 0
        async for text in self._client.tail_job_logs(self.name):
            print(text[max(0, self._shown - told) :], end="", flush=True)
            told += len(text)
            self._shown = max(self._shown, told)


def submitted(entrypoint: list[str], address: str | None, working_dir: str) -> RayJob:
    """Submit a command.

    Raises
    ------
    ClusterError
        The cluster cannot be reached, or refused it.
    """
    from ray.exceptions import RayError
    from ray.job_submission import JobSubmissionClient
    from requests import RequestException

    try:
        client = JobSubmissionClient(address)
        name = client.submit_job(entrypoint=shlex.join(entrypoint), runtime_env={"working_dir": working_dir})
    except (RuntimeError, ValueError, OSError, RequestException, RayError) as error:
        raise ClusterError(
            f"the job could not be submitted to {address or 'the cluster of RAY_API_SERVER_ADDRESS'}: "
            f"{first_line_of(error)}"
        ) from error
    return RayJob(client, name)


def _submit_options(made: Parser) -> None:
    made.add_argument("--address", metavar="URL", help="of the cluster's dashboard (default: RAY_API_SERVER_ADDRESS)")
    made.add_argument(
        "--working-dir",
        default=".",
        metavar="DIR",
        help="whose files the job runs in a copy of, but for what .gitignore names (default: here)",
    )
    made.add_argument("entrypoint", nargs="+", metavar="COMMAND", help="after --, e.g. -- python workflows/full.py")


COMMAND = Command(submit_command, _submit_options)
