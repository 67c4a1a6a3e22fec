"""Where tasks run: one after another in this process, or on a Ray cluster."""

import logging
from collections.abc import Callable, Generator, Iterator
from typing import Any

from datagen.common.errors import ClusterError, first_line_of

log = logging.getLogger(__name__)
_SILENCE = 120.0  # seconds without a finished task before a person is told

Progress = Callable[..., Iterator[Any]]
"""Shows results as they come: of pairs (amount, result) it yields the results. Named arguments: ``unit``, ``total`` and
``done``, the amount that was there before."""
Task = Callable[..., Any]
"""A function of a dataset's URL, its recipe, and what of it is to be made."""
Runner = Callable[[Task, list[tuple[Any, ...]]], Iterator[Any]]
"""Runs a function over argument tuples, yields results as they come: :func:`inline` or :func:`ray_runner`."""


def unseen(results: Iterator[tuple[int, Any]], **amounts: Any) -> Iterator[Any]:
    """Show nothing."""
    return (result for _, result in results)


def inline(task: Task, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
    """Run tasks one after another in this process."""
    return (task(*each) for each in arguments)


def closable(results: Iterator[Any]) -> Generator[Any]:
    """The results of a runner; closing them ends its tasks."""
    yield from results


def ray_runner(task: Task, arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
    """Run tasks on the connected Ray cluster, a few for each CPU in flight, and yield results as they come.

    A worker or node that dies is Ray's to retry; repeating a task is harmless because a shard is written whole.
    """
    import ray

    remote = ray.remote(num_cpus=1, max_retries=5)(task)
    waiting = list(reversed(arguments))
    running: set[Any] = set()
    window = max(4, 3 * int(ray.cluster_resources().get("CPU", 1)))
    try:
        while waiting or running:
            while waiting and len(running) < window:
                running.add(remote.remote(*waiting.pop()))
            done, running = map(set, ray.wait(list(running), num_returns=1, timeout=_SILENCE))
            if done:
                yield ray.get(done.pop())
            else:
                log.warning("no task has finished for %.0f s; are all CPUs of the Ray cluster in use?", _SILENCE)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise ClusterError(
            f"Ray gave up on a task ({type(error).__name__}: {first_line_of(error)}). "
            "Run the same command again to resume"
        ) from error
    finally:
        for reference in running:
            ray.cancel(reference)
        if running:  # whoever writes next must be alone
            ray.wait(list(running), num_returns=len(running), timeout=_SILENCE)
