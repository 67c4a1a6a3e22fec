"""A thread that prepares what will be needed next."""

import queue
import threading
from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

from training.data.batch import Batch
from training.data.triples import Triples

Share = list[Triples]
"""A rank's part of a batch of triples, in the parts that it accumulates over."""

_PATIENCE = 0.2  # seconds between looks at whether anybody still wants the results


class Lookahead:
    """Shares with their batches, in order, prepared by a thread a bounded number of steps ahead.

    Parameters
    ----------
    prepare
        Gives the batches of some shares.
    together
        How many shares to prepare at a time, once one share is known. It begins with one and doubles, so that the first
        step need not wait for many. While some are used up, the next are ready and those after them are prepared.
    """

    def __init__(
        self,
        shares: Iterator[Share],
        prepare: Callable[[list[Share]], list[list[Batch]]],
        together: Callable[[Share], int],
    ) -> None:
        self._shares, self._prepare, self._together = shares, prepare, together
        self._ready: queue.Queue[Any] = queue.Queue(maxsize=1)
        self._unwanted = threading.Event()
        self._thread = threading.Thread(target=self._work, name="lookahead", daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[tuple[Share, list[Batch]]]:
        while True:
            found = self._ready.get()
            if found is None:
                return
            if isinstance(found, BaseException):
                raise found
            yield from found

    def close(self) -> None:
        """End the thread, after what it is at."""
        self._unwanted.set()
        self._thread.join()

    def _work(self) -> None:
        """Prepare until the shares end, something fails, or nobody wants more; the end is told by None."""
        last: BaseException | None = None
        try:
            for shares in self._windows():
                if not self._hand_over(list(zip(shares, self._prepare(shares), strict=True))):
                    return
        except BaseException as error:
            last = error
        self._hand_over(last)

    def _windows(self) -> Iterator[list[Share]]:
        size = 1
        while window := list(islice(self._shares, size)):
            yield window
            size = min(2 * size, self._together(window[0]))

    def _hand_over(self, result: Any) -> bool:
        while not self._unwanted.is_set():
            try:
                self._ready.put(result, timeout=_PATIENCE)
                return True
            except queue.Full:
                continue
        return False
