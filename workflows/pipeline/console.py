"""How the commands report: text, errors in one line with an exit status; and the MLflow server they mirror to."""

import argparse
import errno
import gc
import io
import logging
import os
import re
import select
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TextIO

from datagen.common.errors import DsffnetError, RecipeError, reason_of
from datagen.common.printable import printable, printable_lines
from datagen.common.resources import ran_out_of_memory
from training.tracking.mlflow_store import sqlite_file, sqlite_server
from training.tracking.record import Server, read_record
from workflows.pipeline.ray_cluster import require_reachable

if TYPE_CHECKING:
    from datagen.recipe import DatasetRecipe
    from workflows.pipeline.run_folder import WorkflowFolder

log = logging.getLogger(__name__)
_SPINS = "20000"
"""Rounds that a waiting thread of torch's (libgomp) stays awake; its own choice is 300,000."""
_GARBAGE = 10_000, 20, 50
"""Of ``gc.set_threshold``: at its own, 700, 10 and 10, a tenth of a command's time goes into looking for garbage among
what imports and bodies have made.
"""
_EMPTY = re.compile("--[a-z-]+=")
_LESS = "lower counts, vertices, training.batch or widths"


def guarded(main: Callable[[], None]) -> None:
    """Run a command; what a person can repair becomes one line on standard error and an exit status.

    What the terminal's encoding lacks is written with escapes.
    Status 0: done, 1: failed, 2: usage or invalid recipe, 75: time budget spent, 130: interrupted, 143: told to stop,
    129: the terminal was closed, 141: nobody reads what it prints any more, as after ``| head``.
    """
    gc.set_threshold(*_GARBAGE)
    _prepare_output()
    _let_others_work()
    told = _heed_signals()
    try:
        _require_text(sys.argv[1:])
        _flushed(main)
    except DsffnetError as error:
        if told:  # so was what failed, as Ray's processes by `timeout`
            _stop(told, str(error))
        _fail(str(error), error.exit_status)
    except KeyboardInterrupt as interrupt:
        _stop(told, str(interrupt) or "run the same command again to resume")
    except UnicodeEncodeError as error:
        log.debug("as raised", exc_info=True)
        _fail(f"{error.object[:300]!r} is not UTF-8 text, which a name must be here. Rename it")
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _is_closed(sys.stdout):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left at exit goes nowhere
            sys.exit(128 + signal.SIGPIPE)
        log.debug("as raised", exc_info=True)
        advice = "choose a shorter one" if error.errno == errno.ENAMETOOLONG else "repair this"
        _fail(f"{error}. Nothing that was complete is lost; {advice} and run again")
    except Exception as error:
        if not ran_out_of_memory(error):
            raise
        log.debug("as raised", exc_info=True)
        _fail(f"memory ran out ({reason_of(error)}). Nothing that was complete is lost; {_LESS}, and run again")


def _stop(told: Sequence[int], what_next: str) -> NoReturn:
    print(f"{'stopped' if told else 'interrupted'}; {what_next}", file=sys.stderr)
    sys.exit(128 + (told[0] if told else signal.SIGINT))


def _flushed(main: Callable[[], None]) -> None:
    """Run a command and write out what it printed, be it help, here where a closed pipe can be told."""
    try:
        main()
    except SystemExit:
        print(end="", flush=True)
        raise
    print(end="", flush=True)


def _is_closed(stream: TextIO) -> bool:
    """Whether a stream is a pipe that nobody reads from."""
    poll = select.poll()
    try:
        poll.register(stream, 0)  # errors are always told
    except (TypeError, ValueError):  # no stream, or none of the system's
        return False
    return bool(poll.poll(0))


def _prepare_output() -> None:
    """Let messages hold nothing that a terminal obeys, and print what its encoding lacks as escapes."""
    logging.basicConfig(level=logging.WARNING)
    for handler in logging.getLogger().handlers:
        handler.setFormatter(_Printable("%(levelname)s: %(message)s"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _let_others_work() -> None:
    """Let torch's threads that wait for each other fall asleep soon: awake, they hold the cores that others need.

    Read when torch is imported, here or in a child.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPINS)


def _heed_signals() -> list[int]:
    """End at SIGTERM and SIGHUP as at Ctrl-C; return the list that the number of such a signal comes into."""
    told: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: _interrupt(told, number))
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup
        signal.signal(signal.SIGHUP, lambda number, _: _interrupt(told, number))
    return told


def _require_text(words: Sequence[str]) -> None:
    """Refuse empty words, which would mean this folder, and names that this shell's encoding lacks.

    Ray, MLflow and records would write others.
    """
    for option, word in pairwise(("the first word", *words)):
        if (not word and option != "--prefix") or (word != "--prefix=" and _EMPTY.fullmatch(word)):
            where = word.rstrip("=") or option
            raise RecipeError(f"{where!r} is followed by an empty text, as of an unset variable. Name a file or folder")
    encoding = sys.getfilesystemencoding()
    unreadable = [word for word in (*words, os.getcwd()) if any("\udc80" <= letter <= "\udcff" for letter in word)]
    if unreadable and encoding != "utf-8":
        name = os.fsencode(unreadable[0]).decode(errors="replace")
        raise RecipeError(
            f"{name!r} cannot be read in this shell's encoding, {encoding}. Set PYTHONUTF8=1 and run again"
        )


def _fail(message: str, status: int = 1) -> NoReturn:
    """End with one line on standard error; what no terminal should be sent is escaped."""
    print(f"error: {printable(message)}", file=sys.stderr)
    sys.exit(status)


class _Printable(logging.Formatter):
    """Messages in which names that others chose do nothing to the terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return printable_lines(super().format(record))


def _interrupt(told: list[int], number: int) -> None:
    """As Ctrl-C does: Ray's calls would turn a SystemExit into one of status 1.

    While Ray connects its own handler comes first, which has the process aborted three seconds later, by SIGALRM.
    """
    if signal.getsignal(signal.SIGALRM) == signal.SIG_DFL:
        signal.alarm(0)
    told.append(number)
    raise KeyboardInterrupt


def server_of(out: Path, uri: str | None) -> Server:
    """The MLflow server to mirror to: as asked, as the environment says, or a SQLite store in ``out``."""
    uri = uri or os.environ.get("MLFLOW_TRACKING_URI")
    database = sqlite_file(uri or "")
    if database:
        return sqlite_server(Path(require_reachable(str(database), option="--tracking-uri sqlite:///")))
    return Server(uri) if uri else sqlite_server(Path(os.path.realpath(out)) / "mlflow.db", own=True)


def server_of_record(root: Path, uri: str | None) -> Server:
    """The server for a record; a run that is no part of a workflow has its SQLite store beside it."""
    from workflows.pipeline.run_folder import workflow_kinds

    root = root.resolve()  # what is beside a link is not beside the run
    record = read_record(root)
    return server_of(root if record is not None and record.kind in workflow_kinds() else root.parent, uri)


@contextmanager
def at_work(
    options: argparse.Namespace, folder: "WorkflowFolder", data: "DatasetRecipe | None", *, local: bool = False
) -> Iterator[Server]:
    """Hold a workflow's folder, started over where ``--fresh`` is given, and mirror it to MLflow while the block runs.

    What its data take, where any are made, is said before; ``local``: they are made in this process.
    """
    from training.tracking.mlflow_mirror import Mirror
    from workflows.pipeline.forecast import announce_size

    server = server_of(folder.path, options.tracking_uri)
    if data is not None:
        announce_size(data, folder.data, anew=options.fresh, yes=options.yes, local=local)
    with folder.alone():
        if options.fresh:
            folder.remove()
        with Mirror(folder.path, server):
            yield server


def print_text(text: object) -> None:
    """Print text of one or more lines; names in it that others chose do nothing to the terminal."""
    print(printable_lines(text), flush=True)


def print_note(line: object) -> None:
    """Print one line on standard error for somebody who waits at a terminal; logs and pipes are spared it."""
    if sys.stderr.isatty():
        print(printable(line), file=sys.stderr, flush=True)


def warn(line: object) -> None:
    """Print one line on standard error."""
    print(f"warning: {printable(line)}", file=sys.stderr)


def print_facts(facts: dict[str, str]) -> None:
    """Two aligned columns."""
    width = max(map(len, facts))
    print_text("\n".join(printable(f"{name:{width}}  {value}") for name, value in facts.items()))
