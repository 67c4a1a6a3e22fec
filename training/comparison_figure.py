"""Figures 5, 6 and 7 of the DSFFNet paper: several methods on the same transfers, side by side, with their errors."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from training.camera import Camera, frame, shape_in_view
from training.comparison import Comparison, ErrorScale, Solid, best_of, methods_in, output_of, placed, to_frame
from training.figure_style import INK, PAGE, QUIET, RULE, saved
from training.page import Page
from training.palette import ROLE_COLORS, error_colors, method_colors
from training.rasteriser import Floats
from training.rendering import render_mesh

_SIDE, _HEAD, _TITLE, _UNDER, _FOOT = 20, 100, 46, 30, 112  # pixels: margin, heading, title, metrics, colour bar
_AIR = 8  # pixels left free above and below what a strip shows
_WIDTH = 312  # of a panel by default: five of them make a figure of 1600 pixels
Picture = npt.NDArray[np.uint8]
_MEANING = {
    "source": ("Source", "gives the pose"),
    "target": ("Target", "gives the identity"),
    "truth": ("Ground truth", "target in source pose"),
    "error": ("Error", "distance to truth"),
}


def comparison_figure(
    rows: Sequence[Comparison],
    path: str | os.PathLike[str],
    *,
    error_scale: ErrorScale | None = None,
    panel: tuple[int, int] | None = None,
) -> Path:
    """Draw source, target, each method's output and the ground truth of each transfer as one row, with the errors.

    The panels of a row share one camera; the source is drawn at the truth's size. Errors have one scale of colours in
    the whole figure: below each output or, of a single method, in a last column. Of several methods, bars compare the
    mean errors of a row, and the words under the one with the least PMD are bold. Without a truth there are no errors.

    Parameters
    ----------
    rows : sequence of Comparison
        A row that lacks one of the methods leaves its panels empty.
    path : path of the PNG to write
    error_scale : ErrorScale, optional
        Unit of the colour bar; by default centimetres for vertices in metres.
    panel : (int, int), optional
        Width and height of a panel in pixels; by default 312 wide and as high as the meshes need.

    Raises
    ------
    ValueError
        If there is no row, a vertex is not finite, or an output and its truth differ in shape.
    """
    if not rows:
        raise ValueError("comparison_figure needs at least one example")
    scale = error_scale or ErrorScale()
    solid = [_Row(row, placed(row), scale.of(row)) for row in rows]
    columns = _Columns(methods_in(rows), panel or _panel(solid), any(row.errors for row in solid))
    about = _Errors(scale.unit, scale.resolved(rows), max(row.largest_mean for row in solid))
    drawn = [row.strips(columns, about.limit) for row in solid]
    heights = [_TITLE + sum(strip.height for strip in strips) + columns.under for strips in drawn]
    page = Page(width=columns.left(len(columns.names)) + _SIDE, height=_HEAD + sum(heights) + columns.foot)
    _draw_headings(page, columns)
    for row, strips, top in zip(solid, drawn, np.cumsum([_HEAD, *heights]).tolist(), strict=False):
        _draw_row(page, columns, top, row, strips, about)
    if columns.errors:
        _draw_foot(page, columns, about)
    return saved(page.figure, path)


@dataclass(frozen=True)
class _Columns:
    """Which columns there are, and their panels. Errors of several methods have a strip of their own below."""

    methods: Sequence[str]
    panel: tuple[int, int]
    errors: bool

    @property
    def stacked(self) -> bool:
        return self.errors and len(self.methods) > 1

    @property
    def names(self) -> list[str]:
        """The meshes of the first strip, from left to right; ``error`` is the error of the only method."""
        end = ["truth"] if self.errors else []
        beside = ["error"] if self.errors and not self.stacked else []
        return ["source", "target", *map(output_of, self.methods), *end, *beside]

    @property
    def under(self) -> int:
        """Height of the words below a row."""
        return _UNDER if len(self.methods) > 1 else 0

    @property
    def foot(self) -> int:
        return _FOOT if self.errors else 12

    def left(self, column: int) -> int:
        return _SIDE + column * self.panel[0]

    def middle(self, column: int) -> float:
        return self.left(column) + self.panel[0] / 2


@dataclass(frozen=True)
class _Strip:
    """Pictures by column, all cut to the rows of pixels in which any of them shows something."""

    pictures: Mapping[int, Picture]
    height: int

    @classmethod
    def of(cls, pictures: Mapping[int, Picture | None]) -> "_Strip":
        drawn = {column: picture for column, picture in pictures.items() if picture is not None}
        if not drawn:
            return cls({}, 0)
        shown = np.flatnonzero(np.any([(picture < 250).any((1, 2)) for picture in drawn.values()], axis=0))
        first, last = (int(shown[0]), int(shown[-1])) if len(shown) else (0, 0)
        rows = slice(max(first - _AIR, 0), last + 1 + _AIR)
        cut = {column: picture[rows] for column, picture in drawn.items()}
        return cls(cut, len(next(iter(cut.values()))))


@dataclass(frozen=True)
class _Row:
    """A comparison, its placed meshes, and each method's errors [v] in the unit of the colour bar."""

    comparison: Comparison
    meshes: Mapping[str, Solid]
    errors: Mapping[str, Floats]

    @property
    def largest_mean(self) -> float:
        return max((float(errors.mean()) for errors in self.errors.values()), default=0.0)

    def strips(self, columns: _Columns, limit: float) -> list[_Strip]:
        """The meshes and, where they have a strip of their own, the errors."""
        camera = frame(to_frame(self.meshes), size=columns.panel, margin=0.055)
        meshes = {place: self.picture(name, camera, columns.panel) for place, name in enumerate(columns.names)}
        heats = {
            place: self.heat(method, camera, columns.panel, limit) for place, method in enumerate(columns.methods, 2)
        }
        if columns.stacked:
            return [_Strip.of(meshes), _Strip.of(heats)]
        return [_Strip.of({**meshes, len(columns.names) - 1: heats[2]} if columns.errors else meshes)]

    def picture(self, column: str, camera: Camera, size: tuple[int, int]) -> Picture | None:
        """The mesh of a column in the colour of its role; None where there is none."""
        if column not in self.meshes:
            return None
        mesh, color = self.meshes[column], ROLE_COLORS[column.partition(" ")[0]]
        return render_mesh(mesh.vertices, mesh.faces, colors=color, camera=camera, size=size, background=PAGE)

    def heat(self, method: str, camera: Camera, size: tuple[int, int], limit: float) -> Picture | None:
        """A method's output in the colours of its errors; None where there are none."""
        if method not in self.errors:
            return None
        mesh, colors = self.meshes[output_of(method)], error_colors(self.errors[method], limit)
        return render_mesh(
            mesh.vertices, mesh.faces, colors=colors, camera=camera, size=size, background=PAGE, shading=0.55
        )


@dataclass(frozen=True)
class _Errors:
    """The unit of errors, where their colours end, and the largest mean error of a method in a row."""

    unit: str
    limit: float
    largest_mean: float


def _panel(rows: Sequence[_Row]) -> tuple[int, int]:
    """Panels as high as most rows need: tall for people, low for dogs."""
    shapes = [shape_in_view(to_frame(row.meshes)) for row in rows]
    return _WIDTH, round(_WIDTH * float(np.clip(np.median(shapes), 0.7, 1.3)))


def _draw_headings(page: Page, columns: _Columns) -> None:
    colors, several = method_colors(columns.methods), len(columns.methods) > 1
    for column, name in enumerate(columns.names):
        method = name.removeprefix("output ")
        heading, meaning = _MEANING.get(name, (method, "transferred"))
        middle, room = columns.middle(column), columns.panel[0] - 16
        page.text(middle, 34, heading, size=10, weight="bold", anchor="center", room=room)
        page.text(middle, 68, meaning, size=7, color=QUIET, anchor="center", room=room)
        if several and name not in _MEANING:
            page.block(columns.left(column) + 16, _HEAD - 14, columns.panel[0] - 32, 6, colors[method])


def _draw_row(page: Page, columns: _Columns, top: int, row: _Row, strips: Sequence[_Strip], about: _Errors) -> None:
    words = row.comparison.metrics.get(columns.methods[0], "") if len(columns.methods) == 1 else ""
    page.rule(top)
    page.text(_SIDE + 4, top + 26, row.comparison.title, size=7.5, room=page.width - 48)
    page.text(page.width - 24, top + 26, words, size=7.5, color=QUIET, anchor="right")
    top += _TITLE
    for strip in strips:
        for column, picture in strip.pictures.items():
            page.picture(picture, columns.left(column), top)
        top += strip.height
    if columns.stacked and row.errors:
        _draw_bars(page, columns, top - strips[1].height / 2, row, about)
    if len(columns.methods) > 1:
        _draw_metrics(page, columns, top + 8, row)


def _draw_bars(page: Page, columns: _Columns, middle: float, row: _Row, about: _Errors) -> None:
    """Draw the mean error of each method as a bar beside the heat maps; bars have one scale in the whole figure."""
    colors, best = method_colors(columns.methods), best_of(row.errors)
    start, reach, step = _SIDE + 0.78 * columns.panel[0], 0.9 * columns.panel[0], 42.0
    top = middle - step * len(row.errors) / 2 + 14
    page.text(start, top - 20, f"mean error of a vertex ({about.unit})", size=6.5, color=QUIET)
    for place, (method, errors) in enumerate(row.errors.items()):
        mean, y = float(errors.mean()), top + (place + 0.5) * step
        length, weight = reach * mean / max(about.largest_mean, 1e-12), "bold" if method == best else "normal"
        page.text(start - 10, y, method, size=7, anchor="right", weight=weight, room=start - _SIDE - 12)
        page.block(start, y - 0.3 * step, max(length, 1.5), 0.6 * step, colors[method])
        page.text(start + length + 8, y, f"{mean:.3g}", size=7, weight=weight)
    page.block(start - 1, top, 1, step * len(row.errors), RULE)


def _draw_metrics(page: Page, columns: _Columns, y: float, row: _Row) -> None:
    """Write each method's numbers under its panels."""
    best = best_of(row.errors)
    for column, method in enumerate(columns.methods, start=2):
        words, room = row.comparison.metrics.get(method, ""), columns.panel[0] - 12
        weight, color = ("bold", INK) if method == best else ("normal", QUIET)
        page.text(columns.middle(column), y, words, size=7, anchor="center", weight=weight, color=color, room=room)


def _draw_foot(page: Page, columns: _Columns, about: _Errors) -> None:
    """Draw the colour bar below the last heat map."""
    page.rule(page.height - _FOOT + 8)
    column = 1 + len(columns.methods) if columns.stacked else len(columns.names) - 1
    page.error_bar(
        columns.left(column) + 18, page.height - 86, columns.panel[0] - 36,
        limit=about.limit, label=f"per-vertex error ({about.unit})",
    )  # fmt: skip
