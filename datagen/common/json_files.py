"""The small JSON files of a run: read inside their folder and checked; an unreadable one is reported and set aside.

A power failure, a full disk or a stranger may leave anything in their place. What can be made again is taken as missing
and made again; the unreadable file stays beside it as NAME.unreadable.
"""

import logging
import os
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from datagen.common.errors import DamagedFileError, UnsafeFileError
from datagen.common.files import read_within

log = logging.getLogger(__name__)
Value = TypeVar("Value")
SET_ASIDE = ".unreadable"


def read_json(folder: Path, name: str, kind: TypeAdapter[Value]) -> Value:
    """Return what a JSON file in a folder holds.

    Raises
    ------
    DamagedFileError
        It is no JSON in UTF-8, nested too deep, or of another form than ``kind``.
    UnsafeFileError
        It leads out of the folder, is not a regular file, or is far too long.
    FileNotFoundError, OSError
        It is not there, or cannot be read.
    """
    content = read_within(folder, name)
    try:
        return kind.validate_json(content)
    except ValidationError as error:
        raise DamagedFileError(f"{folder / name} is unreadable ({fault_in(error)})") from error


def read_json_if_whole(folder: Path, name: str, kind: TypeAdapter[Value]) -> Value | None:
    """Return what a JSON file in a folder holds; None where there is none or, with a warning, an unreadable one."""
    try:
        return read_json(folder, name, kind)
    except FileNotFoundError:
        return None
    except (DamagedFileError, UnsafeFileError) as error:
        warn_once(f"{error}. It is taken as missing and made again")
        return None


def set_aside(path: Path) -> None:
    """Rename an unreadable file, if it is there, to NAME.unreadable, so that another can be written in its place."""
    with suppress(FileNotFoundError):
        os.replace(path, path.with_name(f"{path.name}{SET_ASIDE}"))


def fault_in(error: ValidationError) -> str:
    """Return the first fault of values that pydantic refused, in a line: where, and what."""
    fault = error.errors(include_url=False, include_input=False)[0]
    return ": ".join(filter(None, (".".join(map(str, fault["loc"]))[:200], fault["msg"])))


@lru_cache(maxsize=4096)
def warn_once(line: str) -> None:
    """Warn, unless this process has given the same warning before: a mirror looks every few seconds."""
    log.warning("%s", line)
