"""Anny's first load of a rig: its blend shapes read in bulk, to the same bits in a sixth of the time."""

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor


@contextlib.contextmanager
def read_in_bulk() -> Iterator[None]:
    """While the block runs, Anny's files of blend shapes (gzipped text) are read by :func:`blend_shape`.

    Anny's own loader makes a tensor of every line. With the first file a line says what is being done; nothing is said,
    or read, where Anny finds all in its cache.
    """
    from anny.models import full_model

    own, said = getattr(full_model, "load_blend_shape", None), False
    if own is None:  # another version of Anny: it reads as it reads
        yield
        return

    def load(filename: str, vertices_count: int, world_transformation: Any, dtype: torch.dtype) -> Tensor:
        nonlocal said
        if not said:
            said = True
            print("anny: reading the body's files, once for each rig (some ten seconds)", file=sys.stderr, flush=True)
        found: Tensor = world_transformation.apply(blend_shape(filename, vertices_count, dtype))
        return found

    full_model.load_blend_shape = load
    try:
        yield
    finally:
        full_model.load_blend_shape = own


def blend_shape(filename: str, vertices: int, dtype: torch.dtype) -> Tensor:
    """Offsets [vertex, 3] in decimetres of a file that has a line for each vertex that moves: number, x, y, z.

    Raises
    ------
    ValueError
        It holds other than that, or the number of a vertex that there is not.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file without a line
        rows = np.loadtxt(filename, ndmin=2)  # rounded as float() does it
    offsets = torch.zeros((vertices, 3), dtype=dtype)
    if not rows.size:
        return offsets
    if rows.shape[1] != 4:
        raise ValueError(f"{filename} has lines of {rows.shape[1]} numbers, not of a vertex and three coordinates")
    moved = rows[:, 0].astype(np.int64)
    wrong = (moved != rows[:, 0]) | (moved < 0) | (moved >= vertices)
    if wrong.any():
        raise ValueError(f"{filename} moves vertex {rows[wrong][0, 0]:g}, but there are {vertices}")
    offsets[torch.from_numpy(moved)] = torch.from_numpy(rows[:, 1:]).to(dtype)
    return offsets
