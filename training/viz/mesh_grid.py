"""A page of meshes in rows and columns, each under a caption, drawn with one camera a page or one a row."""

import os
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, standing_point
from training.viz.page import Page
from training.viz.render.camera import Camera, frame
from training.viz.render.renderer import render_mesh
from training.viz.style import PAGE, QUIET, saved

_LABELS, _HEADINGS, _LINE, _CAPTION, _EDGE = 156, 56, 30, 26, 16  # pixels
_LETTER = 11.2  # width of a letter of the title
_POINT_SIZE = 0.022  # of half the extent: what a vertex without faces is drawn as
_OCTAHEDRON = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
_OCTAHEDRON_FACES = np.array([(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)])


@dataclass(frozen=True)
class Panel:
    """A mesh (any unit, Y up) where it is to stand, its colours (sRGB [3] or [v, 3]) and the words under it."""

    mesh: Mesh
    colors: npt.ArrayLike
    caption: str = ""


@dataclass(frozen=True)
class Row:
    """Panels from left to right and the words at their left; words in a panel's place say why there is none."""

    label: str
    panels: Sequence[Panel | str]


def mesh_grid(
    rows: Sequence[Row],
    path: str | os.PathLike[str],
    *,
    columns: Sequence[str],
    title: str,
    one_scale: bool = True,
    size: tuple[int, int] = (210, 240),
) -> Path:
    """Draw rows of panels.

    Parameters
    ----------
    columns
        A heading for each column.
    one_scale
        Whether all panels share camera and scale; else those of a row do.
    size
        Width and height of a panel in pixels.

    Raises
    ------
    ValueError
        There are no rows, or a row has more panels than there are headings.
    """
    if not rows or any(len(row.panels) > len(columns) for row in rows):
        raise ValueError(f"need rows of at most {len(columns)} panels, got {[len(row.panels) for row in rows]}")
    width = _LABELS + len(columns) * size[0] + _EDGE
    lines = textwrap.wrap(title, int((width - 2 * _EDGE) / _LETTER))
    more = _CAPTION * (max([1, *(heading.count("\n") for heading in columns)]) - 1)  # than two lines
    header = 10 + len(lines) * _LINE + _HEADINGS + more
    page = Page(width=width, height=header + len(rows) * (size[1] + _CAPTION) + _EDGE)
    page.text(_EDGE, 10, "\n".join(lines), size=8, va="top", linespacing=1.35)
    for place, heading in enumerate(columns):
        page.text(
            _LABELS + (place + 0.5) * size[0], header - 30 - more / 2, heading, size=7.5, anchor="center", weight="bold"
        )
    whole = _camera(rows, size) if one_scale else None
    for number, row in enumerate(rows):
        top = header + number * (size[1] + _CAPTION)
        page.rule(top - 2)
        page.text(_EDGE, top + size[1] / 2, row.label, size=7.5, weight="bold", linespacing=1.5)
        _draw_row(page, row, whole or _camera([row], size), top, size)
    return saved(page.figure, path)


def standing(vertices: Floats, anchor: Floats | None = None) -> Floats:
    """Vertices [v, 3] moved so that ``anchor`` (by default they themselves) stands on the ground at the origin."""
    return np.asarray(vertices - standing_point(vertices if anchor is None else anchor), np.float64)


def drawable(mesh: Mesh) -> Mesh:
    """The mesh, or, where it has no faces, a small octahedron at each of its vertices."""
    if len(mesh.faces):
        return mesh
    vertices = np.asarray(mesh.vertices, np.float64)
    corners = vertices[:, None] + _POINT_SIZE * np.ptp(vertices, axis=0).max() / 2 * _OCTAHEDRON
    faces = len(_OCTAHEDRON) * np.arange(len(vertices))[:, None, None] + _OCTAHEDRON_FACES
    return Mesh(corners.reshape(-1, 3), faces.reshape(-1, 3))


def _camera(rows: Sequence[Row], size: tuple[int, int]) -> Camera:
    return frame(
        [panel.mesh for row in rows for panel in row.panels if isinstance(panel, Panel)], size=size, margin=0.05
    )


def _draw_row(page: Page, row: Row, camera: Camera, top: float, size: tuple[int, int]) -> None:
    for place, panel in enumerate(row.panels):
        left = _LABELS + place * size[0]
        if isinstance(panel, str):
            page.text(left + size[0] / 2, top + size[1] / 2, panel, size=6.5, color=QUIET, anchor="center")
            continue
        mesh = panel.mesh
        look: dict[str, Any] = {"colors": panel.colors, "camera": camera, "size": size, "background": PAGE}
        page.picture(render_mesh(mesh.vertices, mesh.faces, **look), left, top)
        page.text(left + size[0] / 2, top + size[1] + 8, panel.caption, size=6.5, color=QUIET, anchor="center")
