"""Batches of the steps to come, prepared by a thread."""

from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

from training.data.batch import Batch
from training.data.triples import Triples

Share = list[Triples]
"""A rank's part of a batch of triples, in the parts that it accumulates over."""
Prepared = tuple[Share, list[Batch]]


def prepared_ahead(
    shares: Iterator[Share], prepare: Callable[[list[Share]], list[list[Batch]]], together: Callable[[Share], int]
) -> Generator[Prepared]:
    """Yield shares with their batches, in order, prepared by a thread a bounded number of steps ahead.

    Closing the generator ends the thread, after what it is at.

    Parameters
    ----------
    prepare
        Gives the batches of some shares.
    together
        How many shares to prepare at a time, once one share is known. It begins with one and doubles, so that the first
        step need not wait for many. While some are used up, the next are ready and those after them are prepared.
    """
    windows, pending = _windows(shares, together), deque[Future[list[Prepared]]]()

    def work() -> list[Prepared]:
        window = next(windows, [])
        return list(zip(window, prepare(window), strict=True)) if window else []

    with ThreadPoolExecutor(1, thread_name_prefix="lookahead") as pool:
        try:
            pending.extend(pool.submit(work) for _ in range(2))
            while prepared := pending.popleft().result():
                pending.append(pool.submit(work))
                yield from prepared
        finally:
            for future in pending:
                future.cancel()


def _windows(shares: Iterator[Share], together: Callable[[Share], int]) -> Iterator[list[Share]]:
    size = 1
    while window := list(islice(shares, size)):
        yield window
        size = min(2 * size, together(window[0]))
