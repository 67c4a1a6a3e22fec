"""Warp, begun here and nowhere else: without its greeting, and without its line about a machine that has no GPU.

Its code is compiled for any CPU, so that what it computes does not depend on this one.
"""

import contextlib
import os
import sys
from collections.abc import Iterator

import warp as wp

__all__ = ["wp"]


@contextlib.contextmanager
def _native_errors_unheard() -> Iterator[None]:
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # closed, as under some daemons
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


wp.config.cpu_compiler_flags = ""
wp.config.log_level = 40  # errors only
with _native_errors_unheard():  # all that is computed by it is computed on the CPU
    wp.init()
