"""``python -m tests.fuzz``: thousands of cases, what they found grouped, and one case again.

A worker process runs the cases; should one of them end the process itself, that is a finding, and a new one continues.
"""

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz.runner import Finding, Runner
from tests.fuzz.specimens import Specimens
from tests.fuzz.targets import FAMILIES
from tests.fuzz.worker import Answer, Case, Worker


def main() -> None:
    """Run what the command line asks for; status 1 where a case ended as it must not."""
    options = _options()
    with tempfile.TemporaryDirectory(prefix="dsffnet-fuzz-") as folder:
        sys.exit(_one(options.case, Path(folder)) if options.case else _all(options, Path(folder)))


def _options() -> argparse.Namespace:
    made = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    made.add_argument("--cases", type=int, default=2000, help="how many (2,000)")
    made.add_argument("--minutes", type=float, default=30.0, help="stop after so long (30)")
    made.add_argument("--start", type=int, default=0, help="the first seed (0)")
    made.add_argument("--family", action="append", choices=tuple(FAMILIES), help="only these; can be repeated")
    made.add_argument("--case", metavar="FAMILY:SEED", help="one case again, with its traceback")
    return made.parse_args()


def _one(case: str, home: Path) -> int:
    family, seed = case.split(":")
    verdict = Runner(home / "cases", Specimens(home)).run(family, int(seed))
    print(verdict)
    for finding in verdict.findings:
        print(finding.traceback)
    return bool(verdict.findings)


def _cases(options: argparse.Namespace) -> list[Case]:
    """Families in turn, each with seeds from ``--start`` on."""
    families = options.family or list(FAMILIES)
    return [(families[n % len(families)], options.start + n // len(families)) for n in range(options.cases)]


def _all(options: argparse.Namespace, home: Path) -> int:
    began, groups, run, failed = time.monotonic(), dict[tuple[str, str, str], list[str]](), 0, 0
    for (family, _), answer in _answers(_cases(options), home):
        run, failed = run + 1, failed + bool(answer)
        for finding, words in answer:
            print(words, flush=True)
            groups.setdefault((family, finding.where or finding.what[:60], finding.what.split(":")[0]), []).append(
                words
            )
        if time.monotonic() - began > 60 * options.minutes:
            break
    print("\nby family, place and kind:")
    for (family, where, what), found in sorted(groups.items(), key=lambda each: -len(each[1])):
        print(f"{len(found):4} x {family}: {what} in {where}: {found[0].splitlines()[0].split(' (')[0]}")
    seconds = time.monotonic() - began
    print(f"\n{run} cases in {seconds:.0f} s, {failed} ended as they must not ({len(groups)} groups)")
    return bool(groups)


def _answers(cases: list[Case], home: Path) -> Iterator[tuple[Case, Answer]]:
    """What a worker found in each case; that it ended, or never answered, is a finding."""
    worker = None
    for family, seed in cases:
        worker = worker or Worker(home)
        answer = worker.ask((family, seed))
        if answer is None:
            status, worker = worker.end(), None
            if status == 1:
                sys.exit("the fuzzer itself failed, see above")
            words = f"--case '{family}:{seed}': the process ended with status {status}, or did not answer"
            answer = [(Finding("the process ended"), words)]
            shutil.rmtree(home / "cases", ignore_errors=True)
        yield (family, seed), answer
    if worker is not None:
        worker.end()


if __name__ == "__main__":
    main()
