"""How the commands speak: options, errors in one line with an exit status, and the closing words."""

import argparse
import io
import logging
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from filelock import Timeout

from datagen.common.errors import DsffnetError, RecipeError, WorkflowError, reason_of
from datagen.common.files import lock_within, read_text_within
from datagen.common.printable import printable, printable_lines
from datagen.common.resources import ran_out_of_memory
from training.tracking.mlflow_store import sqlite_file, sqlite_server
from training.tracking.record import ALIAS, EXPERIMENT, MODEL, Server, read_record
from workflows.pipeline.ray_cluster import require_reachable
from workflows.recipe.names import known_recipes

log = logging.getLogger(__name__)
_OWN = (
    "recipe.yaml",
    "report.html",
    "report.md",
    "record.json",
    "record.json.unreadable",
    "mlflow.json",
    "mlflow.json.unreadable",
    "stages",
    "generate",
    "run",
    "dataset.zarr",
    "system.jsonl",
    ".mlflow.lock",
)
_OF_A_RUN = (
    "recipe.yaml", "provenance.json", "record.json", "mlflow.json", "metrics.jsonl", "system.jsonl", "latest", "ray",
    "record.json.unreadable", "mlflow.json.unreadable", "failure.json.unreadable",
    "checkpoints", "figures", "failure.json", "stop", ".launch", "best", "pictures", "input.json", "not-finite.json",
    ".mlflow.lock",
)  # fmt: skip

_LESS = "lower counts, vertices, training.batch or widths"


def guarded(main: Callable[[], None]) -> None:
    """Run a command; what a person can mend becomes one line on standard error and an exit status.

    What the terminal's encoding lacks is written with escapes.
    Status 0: done, 1: failed, 2: usage or invalid recipe, 75: time budget spent, 130: interrupted, 143: told to stop,
    129: the terminal was closed.
    """
    _prepare_output()
    told = _heed_signals()
    try:
        _require_text(sys.argv[1:])
        main()
    except DsffnetError as error:
        _fail(str(error), error.exit_status)
    except KeyboardInterrupt as interrupt:
        what_next = str(interrupt) or "run the same command again to go on from here"
        print(f"{'stopped' if told else 'interrupted'}; {what_next}", file=sys.stderr)
        sys.exit(128 + (told[0] if told else signal.SIGINT))
    except UnicodeEncodeError as error:
        log.debug("as raised", exc_info=True)
        _fail(f"{error.object[:300]!r} is not UTF-8 text, which a name must be here. Rename it")
    except OSError as error:
        log.debug("as raised", exc_info=True)
        _fail(f"{error}. Nothing that was complete is lost; mend this and run again")
    except Exception as error:
        if not ran_out_of_memory(error):
            raise
        log.debug("as raised", exc_info=True)
        _fail(f"memory ran out ({reason_of(error)}). Nothing that was complete is lost; {_LESS}, and run again")


def _prepare_output() -> None:
    """Let messages hold nothing that a terminal obeys, and print what its encoding lacks as escapes."""
    logging.basicConfig(level=logging.WARNING)
    for handler in logging.getLogger().handlers:
        handler.setFormatter(_Printable("%(levelname)s: %(message)s"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _heed_signals() -> list[int]:
    """End at SIGTERM and SIGHUP as at Ctrl-C; return the list that the number of such a signal comes into."""
    told: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: _interrupt(told, number))
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # nohup
        signal.signal(signal.SIGHUP, lambda number, _: _interrupt(told, number))
    return told


def _require_text(words: Sequence[str]) -> None:
    """Refuse names that a shell whose encoding is not UTF-8 cannot say: Ray, MLflow and records would write others."""
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
    """As Ctrl-C does: Ray's calls would turn a SystemExit into one of status 1."""
    told.append(number)
    raise KeyboardInterrupt


def workflow_parser(text: str) -> argparse.ArgumentParser:
    """Options shared by the workflow scripts."""
    made = parser(text)
    add_recipe_options(made)
    made.add_argument("--out", metavar="DIR", help="folder for dataset, run and MLflow store (default runs/RECIPE)")
    add_tracking_option(made)
    made.add_argument("--fresh", action="store_true", help="remove what DIR holds of this workflow and start over")
    add_yes_option(made)
    return made


def parser(text: str) -> argparse.ArgumentParser:
    """A parser whose help is ``text`` as written and, at its end, every key of a recipe."""
    from workflows.recipe.loader import describe_fields  # it brings all body models

    keys = "\n".join(describe_fields())
    return argparse.ArgumentParser(
        description=text,
        epilog=f"keys for --set, with their defaults:\n{keys}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_recipe_options(made: argparse.ArgumentParser) -> None:
    """--recipe and --set."""
    names = ", ".join(known_recipes())
    made.add_argument(
        "--recipe",
        default="quickstart",
        metavar="NAME|FILE|X.zarr",
        help=f"a YAML file, or the recipe that a dataset was made by, or one of {names}",
    )
    add_set_option(made)


def add_set_option(made: argparse.ArgumentParser) -> None:
    """--set."""
    made.add_argument(
        "--set",
        action="extend",
        nargs="+",
        default=[],
        metavar="section.key=value",
        help="change keys of the recipe, in any order",
    )


def add_local_option(made: argparse.ArgumentParser) -> None:
    """--local."""
    made.add_argument("--local", action="store_true", help="all in this process, without Ray, however much it is")


def add_yes_option(made: argparse.ArgumentParser) -> None:
    """--yes."""
    made.add_argument("--yes", action="store_true", help="make the dataset though its disk looks too small for it")


def add_tracking_option(made: argparse.ArgumentParser) -> None:
    """--tracking-uri."""
    made.add_argument(
        "--tracking-uri", metavar="URI", help="MLflow server (default: MLFLOW_TRACKING_URI, else SQLite in the folder)"
    )


def server_of(out: Path, uri: str | None) -> Server:
    """The MLflow server to mirror to: as asked, as the environment says, or a SQLite store in ``out``."""
    uri = uri or os.environ.get("MLFLOW_TRACKING_URI")
    database = sqlite_file(uri or "")
    if database:
        return sqlite_server(Path(require_reachable(str(database), option="--tracking-uri sqlite:///")))
    return Server(uri) if uri else sqlite_server(out.absolute() / "mlflow.db", own=True)


def server_of_record(root: Path, uri: str | None) -> Server:
    """The server for a record; a run that is no part of a workflow has its SQLite store beside it."""
    record = read_record(root)
    is_workflow = record is not None and record.kind in ("workflow", "sweep", "comparison", "ablation")
    return server_of(root if is_workflow else root.parent, uri)


def remove_run(run: Path) -> None:
    """Remove what a training keeps in its folder.

    Raises
    ------
    RecipeError
        The folder is not a training run's.
    """
    if run.exists() and any(run.iterdir()) and not _is_training(run):
        raise RecipeError(f"{run} is not the folder of a training, so --fresh leaves it alone. Choose another --out")
    _remove(run, _OF_A_RUN)
    _remove(run, [folder.name for folder in run.glob("evaluation*")])


def _is_training(run: Path) -> bool:
    """By its record, or, where torchrun trained without a workflow, by what every training writes."""
    record = read_record(run)
    if record is not None:
        return record.kind == "train"
    return (run / "checkpoints").is_dir() and (run / "metrics.jsonl").is_file()


def _remove(folder: Path, names: Iterable[str]) -> None:
    for path in (folder / name for name in names):
        if path.is_dir() and not path.is_symlink():  # of a link, only the link
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


@contextmanager
def alone_in(out: Path, name: str = ".lock") -> Iterator[None]:
    """Hold the folder of a workflow or a run; the operating system gives it back if this process dies.

    Raises
    ------
    WorkflowError
        Another process has it.
    """
    out.mkdir(parents=True, exist_ok=True)
    try:
        with lock_within(out, name).acquire(timeout=0):
            yield
    except Timeout as error:
        raise WorkflowError(f"another command is at work in {out}. Wait for it, or stop it, then run again") from error


def start_over(out: Path) -> None:
    """Remove what a workflow keeps in ``out``, and nothing else; the MLflow store stays.

    Raises
    ------
    RecipeError
        The folder does not look like a workflow's.
    """
    from datagen.store.location import remove

    strangers = {path.name for path in out.iterdir() if not path.name.startswith("mlflow.db")}
    strangers -= {".lock", "mlartifacts", *_OWN}
    if strangers and not (out / "recipe.yaml").exists():
        raise RecipeError(
            f"{out} holds files but no workflow of ours, so --fresh leaves it alone. Choose another --out"
        )
    remove(str(out / "dataset.zarr"))
    _remove(out, (name for name in _OWN if name != "dataset.zarr"))


def _programs() -> str:
    """Folder of this environment's programs with a slash behind it, or nothing where the shell finds them anyway."""
    here = Path(sys.executable).parent
    if shutil.which("dsffnet") == str(here / "dsffnet"):
        return ""
    return f"{os.path.relpath(here) if here.is_relative_to(Path.cwd()) else here}/"


def closing_words(out: Path, server: Server) -> str:
    """The table, where everything lies, and what to try next."""
    evaluation = out / "run" / "evaluation"
    table = read_text_within(evaluation, "tables.md")
    shown = Path(os.path.relpath(out)) if out.is_relative_to(Path.cwd()) else out
    run = shlex.quote(str(shown / "run"))
    here = shown / "run" / "evaluation"
    meshes = shlex.quote(str(here / "meshes"))
    programs = _programs()
    dsffnet = f"{programs}dsffnet"
    ui = (
        f"make ui OUT={shlex.quote(str(shown).replace('$', '$$'))}"
        if sqlite_file(server.uri) == out / "mlflow.db"
        else f"look at MLflow ({server.uri}), experiment {EXPERIMENT!r}"
    )
    return f"""
{table}
Where everything lies
  report        {shown}/report.html, report.md  (all of this on one page, with cards of data and model)
  pictures      {here}/figures/examples.png, training-curve.png
  viewer        {here}/viewer.html  (turn and zoom; open it in a browser)
  meshes        {here}/meshes/*.glb
  table, rows   {here}/tables.md, rows.csv
  run           {run}  (weights in checkpoints/, metrics.jsonl)
  dataset       {shown}/dataset.zarr
  MLflow        {server.uri}, experiment {EXPERIMENT!r}, model 'models:/{MODEL}@{ALIAS}'

Try next
  {ui}
  {dsffnet} transfer --model {run} --source {meshes}/00-source.glb --target {meshes}/01-target.glb --out posed.glb
  {programs}python workflows/full.py --out runs/custom --set data.identities.seed=7 data.identities.training=24
"""


def print_text(text: object) -> None:
    """Print text of one or more lines; names in it that others chose do nothing to the terminal."""
    print(printable_lines(text), flush=True)


def print_facts(facts: dict[str, str]) -> None:
    """Two aligned columns."""
    width = max(map(len, facts))
    print_text("\n".join(printable(f"{name:{width}}  {value}") for name, value in facts.items()))
