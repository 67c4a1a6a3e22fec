"""A contact sheet of meshes: identities down, poses across; written atomically as PNG."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from training.camera import frame
from training.comparison import Solid, standing_point
from training.figure_style import PAGE, saved
from training.page import Page
from training.palette import ROLE_COLORS
from training.rasteriser import Floats, Integers
from training.rendering import render_mesh

__all__ = ["ROLE_COLORS", "contact_sheet"]

_SHEET_HUES = ("#5B8CD1", "#E8995A", "#55A98F", "#B98BC6", "#D0AE48", "#CE7474")


def contact_sheet(
    grid: Sequence[Sequence[Floats]],
    faces_per_row: Sequence[Integers],
    row_labels: Sequence[str],
    column_labels: Sequence[str],
    path: str | os.PathLike[str],
    *,
    panel: tuple[int, int] = (210, 250),
) -> Path:
    """Draw a grid of meshes, identities down and poses across, all on one scale.

    Parameters
    ----------
    grid : rows of arrays [v, 3]
        Vertices, Y up, facing +Z; rows may differ in vertex count.
    faces_per_row : arrays [f, 3]
        The triangles of each row.
    row_labels, column_labels : sequence of str
    path : path of the PNG to write
    panel : (int, int)
        Width and height of a panel in pixels.
    """
    if not len(grid) == len(faces_per_row) == len(row_labels) or any(len(row) != len(column_labels) for row in grid):
        raise ValueError("grid, faces_per_row, row_labels and column_labels differ in length")
    standing = [[np.asarray(one, float) - standing_point(np.asarray(one, float)) for one in row] for row in grid]
    camera = frame(
        [Solid(one, faces) for row, faces in zip(standing, faces_per_row, strict=True) for one in row], size=panel
    )
    page = Page(width=90 + len(column_labels) * panel[0], height=70 + len(grid) * panel[1] + 20)
    for column, label in enumerate(column_labels):
        page.text(70 + (column + 0.5) * panel[0], 40, label, size=7.5, anchor="center", weight="bold")
    for index, (row, faces) in enumerate(zip(standing, faces_per_row, strict=True)):
        top = 70 + index * panel[1]
        page.text(38, top + panel[1] / 2, row_labels[index], size=7.5, anchor="center", rotation=90, weight="bold")
        hue = _hex(_SHEET_HUES[index % len(_SHEET_HUES)])
        for column, vertices in enumerate(row):
            picture = render_mesh(vertices, faces, colors=hue, camera=camera, size=panel, background=PAGE)
            page.picture(picture, 70 + column * panel[0], top)
    return saved(page.figure, path)


def _hex(color: str) -> tuple[float, ...]:
    return tuple(int(color[start : start + 2], 16) / 255 for start in (1, 3, 5))
