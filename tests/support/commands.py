"""The ``dsffnet`` command and the workflow script: in this process, which saves seconds, or as a process of its own."""

import contextlib
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from workflows.pipeline.console import guarded

ROOT = Path(__file__).parents[2]
Done = subprocess.CompletedProcess[str]


def command(*arguments: object, script: str = "dsffnet", folder: Path | None = None, **environment: str) -> Done:
    """What a command does in this process, in a folder and with more variables, as if it were one of its own."""
    words = list(map(str, arguments))
    out, err, status = io.StringIO(), io.StringIO(), 0
    with _as_before(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        os.environ.update(environment)
        os.chdir(folder or Path.cwd())
        sys.argv = [script, *words]
        try:
            _main(script, words)
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else 0
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


def process(*arguments: object, folder: Path = ROOT, **environment: str) -> Done:
    """``dsffnet`` as a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "workflows", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=120,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        check=False,
    )


def example(name: str, *arguments: object, folder: Path) -> str:
    """What a script of examples/ prints, run in a folder."""
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / name, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def wait_for(
    happened: Callable[[], object],
    seconds: float = 200,
    *,
    process: subprocess.Popen[str] | None = None,
    what: str = "the moment",
    every: float = 0.01,
) -> None:
    """Wait until something has happened, for so many seconds at most; by a process, where one is given, that lives."""
    until = time.monotonic() + seconds
    while not happened():
        if process and process.poll() is not None:
            raise AssertionError(f"ended before {what}:\n{process.stdout.read() if process.stdout else ''}")
        assert time.monotonic() < until, f"waited {seconds:.0f} s in vain for {what}"
        time.sleep(every)


def fails(result: Done, status: int, *says: str) -> None:
    """One line on standard error that begins with ``error:``, the status, and no traceback."""
    assert result.returncode == status, result.stderr
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "Traceback" not in result.stderr, result.stderr
    for text in says:
        assert text in errors[0]


def _main(script: str, words: list[str]) -> None:
    from workflows import full
    from workflows.cli.main import main

    if script == "full.py":
        guarded(lambda: full.main(words))
    else:
        main(words)


@contextlib.contextmanager
def _as_before() -> Iterator[None]:
    """Put back what a command may change of its process: variables, folder, argument list, signals."""
    kept = dict(os.environ), os.getcwd(), sys.argv
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(kept[0])
        os.chdir(kept[1])
        sys.argv = kept[2]
        for number, handler in handlers.items():
            signal.signal(number, handler)
