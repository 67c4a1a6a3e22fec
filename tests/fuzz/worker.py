"""A process that runs cases, so that one that ends its process, or never ends, is a finding like any other."""

import multiprocessing
from multiprocessing.connection import Connection
from pathlib import Path

from tests.fuzz.runner import Finding, Runner
from tests.fuzz.specimens import Specimens
from tests.fuzz.watch import WALL_SECONDS

Case = tuple[str, int]
"""Family and seed."""
Answer = list[tuple[Finding, str]]
"""What was found in a case, each with the words for it."""


class Worker:
    """A process that runs cases."""

    def __init__(self, home: Path) -> None:
        self._cases, theirs = multiprocessing.Pipe()
        self._process = multiprocessing.get_context("spawn").Process(target=_work, args=(theirs, home))
        self._process.start()
        theirs.close()

    def ask(self, case: Case) -> Answer | None:
        try:
            self._cases.send(case)
            return self._cases.recv() if self._cases.poll(2 * WALL_SECONDS) else None
        except (EOFError, OSError):
            return None

    def end(self) -> int | None:
        """The process's status; None where it had to be ended."""
        self._process.join(1)
        status = self._process.exitcode
        self._process.kill()
        return status


def _work(cases: Connection, home: Path) -> None:
    runner = Runner(home / "cases", Specimens(home))
    while True:
        verdict = runner.run(*cases.recv())
        cases.send([(finding, str(verdict)) for finding in verdict.findings])
