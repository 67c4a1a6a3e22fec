"""Figures 5, 6 and 7 of the DSFFNet paper: several methods on the same transfers, side by side, with their errors."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from training.viz.comparison_panels import SIDE, Columns, ShownRow, Strip, panel_size
from training.viz.page import Page
from training.viz.style import INK, QUIET, RULE, method_colors, saved
from training.viz.transfer_example import ERROR_UNIT, Comparison, best_of, error_limit, errors_of, methods_in, placed

_HEAD, _TITLE, _UNDER, _FOOT = 100, 46, 30, 112  # pixels: heading, title, metrics, colour bar
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
    panel: tuple[int, int] | None = None,
) -> Path:
    """Draw source, target, each method's output and the ground truth of each transfer as one row, with the errors.

    The panels of a row share one camera; the source is drawn at the truth's size. Errors have one scale of colours in
    the whole figure: below each output or, of a single method, in a last column. Of several methods, bars compare the
    mean errors of a row, the least in bold; the words under the one with the least PMD are bold, and outputs and truth
    are shown near by too, where the methods differ most. Without a truth there are no errors.

    Parameters
    ----------
    rows : sequence of Comparison
        A row that lacks one of the methods leaves its panels empty.
    path : path of the PNG to write
    panel : (int, int), optional
        Width and height of a panel in pixels; by default 312 wide and as high as the meshes need.

    Raises
    ------
    ValueError
        If there is no row, a vertex is not finite, or an output and its truth differ in shape.
    """
    if not rows:
        raise ValueError("comparison_figure needs at least one example")
    solid = [ShownRow(row, placed(row), errors_of(row)) for row in rows]
    columns = Columns(methods_in(rows), panel or panel_size(solid), any(row.errors for row in solid))
    about = _Errors(error_limit(rows), max(row.largest_mean for row in solid))
    drawn = [row.strips(columns, about.limit) for row in solid]
    under = _UNDER if len(columns.methods) > 1 else 0
    heights = [_TITLE + sum(strip.height for strip in strips) + under for strips in drawn]
    foot = _FOOT if columns.errors else 12
    page = Page(width=columns.left(len(columns.names)) + SIDE, height=_HEAD + sum(heights) + foot)
    _draw_headings(page, columns)
    for row, strips, top in zip(solid, drawn, np.cumsum([_HEAD, *heights]).tolist(), strict=False):
        _draw_row(page, columns, top, row, strips, about)
    if columns.errors:
        _draw_foot(page, columns, about)
    return saved(page.figure, path)


@dataclass(frozen=True)
class _Errors:
    """Where the colours of errors end, and the largest mean error of a method in a row."""

    limit: float
    largest_mean: float


def _draw_headings(page: Page, columns: Columns) -> None:
    colors, several = method_colors(columns.methods), len(columns.methods) > 1
    for column, name in enumerate(columns.names):
        method = name.removeprefix("output ")
        heading, meaning = _MEANING.get(name, (method, "no-op" if method.endswith(" unchanged") else "transferred"))
        middle, room = columns.middle(column), columns.panel[0] - 16
        page.text(middle, 34, heading, size=10, weight="bold", anchor="center", room=room)
        page.text(middle, 68, meaning, size=7, color=QUIET, anchor="center", room=room)
        if several and name not in _MEANING:
            page.block(columns.left(column) + 16, _HEAD - 14, columns.panel[0] - 32, 6, colors[method])


def _draw_row(page: Page, columns: Columns, top: int, row: ShownRow, strips: Sequence[Strip], about: _Errors) -> None:
    words = row.comparison.metrics.get(columns.methods[0], "") if len(columns.methods) == 1 else ""
    page.rule(top)
    page.text(SIDE + 4, top + 26, row.comparison.title, size=7.5, room=page.width - 48)
    page.text(page.width - 24, top + 26, words, size=7.5, color=QUIET, anchor="right")
    begin = top = top + _TITLE
    for strip in strips:
        for column, picture in strip.pictures.items():
            page.picture(picture, columns.left(column), top)
        top += strip.height
    if columns.stacked and row.errors:
        _draw_bars(page, columns, begin + strips[0].height + strips[1].height / 2, row, about)
    if len(columns.methods) > 1:
        _draw_metrics(page, columns, top + 8, row)


def _draw_bars(page: Page, columns: Columns, middle: float, row: ShownRow, about: _Errors) -> None:
    """Draw the mean error of each method as a bar beside the heat maps; bars have one scale in the whole figure."""
    colors, least = method_colors(columns.methods), min(float(errors.mean()) for errors in row.errors.values())
    start, reach, step = SIDE + 0.78 * columns.panel[0], 0.9 * columns.panel[0], 42.0
    top = middle - step * len(row.errors) / 2 + 14
    page.text(start, top - 20, f"mean error of a vertex ({ERROR_UNIT})", size=6.5, color=QUIET)
    for place, (method, errors) in enumerate(row.errors.items()):
        mean, y = float(errors.mean()), top + (place + 0.5) * step
        length, weight = reach * mean / max(about.largest_mean, 1e-12), "bold" if mean == least else "normal"
        page.text(start - 10, y, method, size=7, anchor="right", weight=weight, room=start - SIDE - 12)
        page.block(start, y - 0.3 * step, max(length, 1.5), 0.6 * step, colors[method])
        page.text(start + length + 8, y, f"{mean:.2f}", size=7, weight=weight)
    page.block(start - 1, top, 1, step * len(row.errors), RULE)


def _draw_metrics(page: Page, columns: Columns, y: float, row: ShownRow) -> None:
    """Write each method's numbers under its panels."""
    best = best_of(row.errors)
    for column, method in enumerate(columns.methods, start=2):
        words, room = row.comparison.metrics.get(method, ""), columns.panel[0] - 12
        weight, color = ("bold", INK) if method == best else ("normal", QUIET)
        page.text(columns.middle(column), y, words, size=7, anchor="center", weight=weight, color=color, room=room)


def _draw_foot(page: Page, columns: Columns, about: _Errors) -> None:
    """Draw the colour bar below the last heat map."""
    page.rule(page.height - _FOOT + 8)
    column = 1 + len(columns.methods) if columns.stacked else len(columns.names) - 1
    page.error_bar(
        columns.left(column) + 18, page.height - 86, columns.panel[0] - 36,
        limit=about.limit, label=f"per-vertex error ({ERROR_UNIT})",
    )  # fmt: skip
