"""Work of which only the newest counts: what waits gives way to what comes after it."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Asked = TypeVar("Asked")


class Newest(Generic[Asked]):
    """A thread that does the newest of what it is asked; a slider that moves asks far more often than it can do.

    ``work`` is given what was asked and a function that says whether something newer waits, so that long work can end.
    """

    def __init__(self, work: Callable[[Asked, Callable[[], bool]], None]) -> None:
        self._work = work
        self._waiting: list[Asked] = []
        self._changed = threading.Condition()
        self._is_open = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def ask(self, asked: Asked) -> None:
        """Do this next, and nothing of what waited."""
        with self._changed:
            self._waiting[:] = [asked]
            self._changed.notify()

    def close(self) -> None:
        """Wait for what is being done; nothing more is done."""
        with self._changed:
            self._is_open = False
            self._changed.notify()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _is_stale(self) -> bool:
        return bool(self._waiting) or not self._is_open

    def _run(self) -> None:
        while (asked := self._next()) is not None:
            self._work(asked, self._is_stale)

    def _next(self) -> Asked | None:
        with self._changed:
            self._changed.wait_for(self._is_stale)
            return self._waiting.pop() if self._is_open else None
