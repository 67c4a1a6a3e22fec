"""The modules on the way of a command: those of which a function is called, beyond being imported.

python -m benchmarks.ways transfer --model dsffnet-people a.obj b.obj -o c.obj
python -m benchmarks.ways train --data DATA.zarr --out RUN --set training.launcher=inline training.ranks=1
"""

import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

from workflows.cli.main import main

_PACKAGES = ("datagen.", "training.", "workflows.")


def modules_called(work: Callable[[], None]) -> list[str]:
    """Return the names of the project's modules of which a function is called, in the order of their first calls."""
    found: dict[str, None] = {}

    def note(frame: FrameType, event: str, _: Any) -> None:
        name = frame.f_globals.get("__name__", "")
        if event == "call" and name.startswith(_PACKAGES) and name not in found and not _imports(frame):
            found[name] = None

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return list(found)


def _imports(frame: FrameType | None) -> bool:
    """Whether a call is part of an import: decorators, fields of classes, tables that are made once."""
    while frame:
        if frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__") != "__main__":
            return True
        frame = frame.f_back
    return False


def _run() -> None:
    with suppress(SystemExit):
        main(sys.argv[1:])


if __name__ == "__main__":
    modules = modules_called(_run)
    print(f"{len(modules)} modules:", *modules, sep="\n  ")
