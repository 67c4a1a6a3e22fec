"""What a person sees while a sweep runs: one bar on a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from training.objectives import PMD_UNIT
from training.tracking.journal import journal_from
from workflows.pipeline.progress import bar
from workflows.pipeline.stage import say
from workflows.studies.sweep.plan import Trial
from workflows.studies.sweep.ray_trials import Outcome

_QUIET_SECONDS = 20.0


class SweepProgress:
    """Follows the journals of trials, each of which has so many ``steps`` to make."""

    def __init__(self, trials: Sequence[Trial], steps: Mapping[str, int], out: Path) -> None:
        self._journals = {trial.name: trial.folder(out) / "metrics.jsonl" for trial in trials}
        self._steps = steps
        self._offsets = dict.fromkeys(self._journals, 0)
        self._latest: dict[str, dict[str, Any]] = {name: {} for name in self._journals}
        self._ended: set[str] = set()
        self._read()
        self._at_first = self._made()
        self._ended |= {name for name, row in self._latest.items() if row.get("step", 0) >= steps[name]}
        self._said = time.monotonic()
        self._bar: Any = None

    def __enter__(self) -> "SweepProgress":
        if sys.stderr.isatty():
            total = sum(self._steps.values())
            self._bar = bar(total=total, what="sweep", unit="step", initial=sum(self._made().values()))
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def look(self) -> None:
        """Bring the bar up to date, or say a line if the last one is old."""
        self._read()
        if self._bar is not None:
            self._bar.set_postfix_str(self.summary(), refresh=False)
            self._bar.update(sum(self._made().values()) - self._bar.n)
        elif time.monotonic() - self._said > _QUIET_SECONDS:
            self._said = time.monotonic()
            say(f"sweep: {self.summary()}")

    def report(self, outcome: Outcome) -> None:
        """Say in a line how a trial ended."""
        self._read()
        self._ended.add(outcome.name)
        row = self._latest[outcome.name]
        pmd = f", PMD unseen {_pmd(row)}e-4" if _UNSEEN in row else ""
        reason = f": {outcome.reason}" if outcome.reason else ""
        with tqdm.external_write_mode():
            say(f"trial {outcome.name}: {outcome.state} at step {row.get('step', 0):,}{pmd}{reason}")

    def summary(self) -> str:
        """How many trials have ended, and where each of the running ones is."""
        moving = (name for name, row in self._latest.items() if row.get("step", 0) > self._at_first[name])
        running = [name for name in moving if name not in self._ended]
        places = [f"{name} step {self._latest[name]['step']:,}{_shown(self._latest[name])}" for name in running]
        counts = f"{len(self._ended)}/{len(self._journals)} trials, {len(running)} running"
        return "; ".join([counts, *places])

    def _made(self) -> dict[str, int]:
        return {name: int(row.get("step", 0)) for name, row in self._latest.items()}

    def _read(self) -> None:
        for name, path in self._journals.items():
            for after, row in journal_from(path, self._offsets[name]):
                self._offsets[name] = after
                self._latest[name] |= row


_UNSEEN = "evaluation/pmd_unseen"


def _pmd(row: Mapping[str, float]) -> str:
    return f"{row[_UNSEEN] / PMD_UNIT:.1f}"


def _shown(row: Mapping[str, float]) -> str:
    return f" PMD {_pmd(row)}e-4" if _UNSEEN in row else ""
