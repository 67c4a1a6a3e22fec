"""``python -m tests.fuzz``: thousands of cases, what they found grouped, and one case again.

A worker process runs the cases; should one of them end the process itself, that is a finding, and a new worker goes on.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.fuzz.runner import Runner
from tests.fuzz.specimens import Specimens
from tests.fuzz.targets import FAMILIES
from tests.fuzz.watch import WALL_SECONDS


def main() -> None:
    """Run what the command line asks for; status 1 where a case ended as it must not."""
    options = _options()
    with tempfile.TemporaryDirectory(prefix="dsffnet-fuzz-") as folder:
        home = Path(folder)
        if options.case:
            sys.exit(_one(options.case, home))
        if options.worker:
            sys.exit(_work(options, Path(options.worker)))
        sys.exit(_all(options, home))


def _options() -> argparse.Namespace:
    made = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    made.add_argument("--cases", type=int, default=2000, help="how many (2,000)")
    made.add_argument("--minutes", type=float, default=30.0, help="stop after so long (30)")
    made.add_argument("--start", type=int, default=0, help="the first seed (0)")
    made.add_argument("--family", action="append", choices=tuple(FAMILIES), help="only these; can be repeated")
    made.add_argument("--case", metavar="FAMILY:SEED", help="one case again, with its traceback")
    made.add_argument("--worker", metavar="FOLDER", help=argparse.SUPPRESS)
    return made.parse_args()


def _one(case: str, home: Path) -> int:
    family, seed = case.split(":")
    verdict = Runner(home / "cases", Specimens(home)).run(family, int(seed))
    print(verdict)
    for finding in verdict.findings:
        print(finding.traceback)
    return bool(verdict.findings)


def _cases(options: argparse.Namespace) -> list[tuple[str, int]]:
    """Families in turn, each with seeds from ``--start`` on."""
    families = options.family or list(FAMILIES)
    return [(families[n % len(families)], options.start + n // len(families)) for n in range(options.cases)]


def _work(options: argparse.Namespace, home: Path) -> int:
    """Run the cases whose numbers come by standard input; one line of JSON before and after each."""
    runner, cases = Runner(home / "cases", Specimens(home)), _cases(options)
    answers = sys.stdout
    for line in sys.stdin:
        family, seed = cases[int(line)]
        verdict = runner.run(family, seed)
        about = [[each.what, each.where, str(verdict)] for each in verdict.findings]
        print(
            json.dumps({"end": verdict.end[:40], "seconds": verdict.seconds, "findings": about}),
            file=answers,
            flush=True,
        )
    return 0


def _all(options: argparse.Namespace, home: Path) -> int:
    began, groups, counts = time.monotonic(), {}, {"cases": 0, "failed": 0}
    cases = _cases(options)
    for number, answer in _answers(options, home, len(cases)):
        counts["cases"] += 1
        counts["failed"] += bool(answer["findings"])
        for what, where, words in answer["findings"]:
            print(words, flush=True)
            groups.setdefault((cases[number][0], where or what[:60], what.split(":")[0]), []).append(words)
        if time.monotonic() - began > 60 * options.minutes:
            break
    print("\nby family, place and kind:")
    for (family, where, what), found in sorted(groups.items(), key=lambda each: -len(each[1])):
        print(f"{len(found):4} x {family}: {what} in {where}: {found[0].splitlines()[0].split(' (')[0]}")
    seconds = time.monotonic() - began
    failed = f"{counts['failed']} ended as they must not ({len(groups)} groups)"
    print(f"\n{counts['cases']} cases in {seconds:.0f} s, {failed}")
    return bool(groups)


def _answers(options: argparse.Namespace, home: Path, count: int) -> Iterator[tuple[int, dict[str, Any]]]:
    """The worker's answer to each case; one that ended it, or never answered, is a finding."""
    worker = None
    for number in range(count):
        if worker is None:
            worker = _worker(options, home)
        answer = _ask(worker, number)
        if answer is None:
            worker.kill()
            if worker.wait() == 1:
                sys.exit("the fuzzer itself failed, see above")
            family, seed = _cases(options)[number]
            words = f"--case '{family}:{seed}': the process ended with status {worker.wait()}, or did not answer"
            answer, worker = {"findings": [["the process ended", "", words]]}, None
            shutil.rmtree(home / "cases", ignore_errors=True)
        yield number, answer
    if worker is not None:
        worker.stdin.close()
        worker.wait()


def _worker(options: argparse.Namespace, home: Path) -> "subprocess.Popen[str]":
    words = [
        sys.executable,
        "-m",
        "tests.fuzz",
        "--worker",
        str(home),
        f"--cases={options.cases}",
        f"--start={options.start}",
    ]
    families = [f"--family={family}" for family in options.family or ()]
    return subprocess.Popen([*words, *families], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _ask(worker: "subprocess.Popen[str]", number: int) -> dict[str, Any] | None:
    import select

    assert worker.stdin is not None and worker.stdout is not None
    try:
        worker.stdin.write(f"{number}\n")
        worker.stdin.flush()
    except OSError:
        return None
    ready, _, _ = select.select([worker.stdout], [], [], 2 * WALL_SECONDS)
    line = worker.stdout.readline() if ready else ""
    return json.loads(line) if line else None


if __name__ == "__main__":
    main()
