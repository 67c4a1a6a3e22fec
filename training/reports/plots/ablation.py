"""Table 3 of the DSFFNet paper as a figure: what each variant of the network costs in each metric."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from training.evaluation.evaluate import POSE_TYPES, Row
from training.evaluation.statistics import mean_and_interval
from training.objectives import PMD_UNIT
from training.recipes.networks import DSFFNET
from training.viz.style import DPI, INK, PAGE, QUIET, RULE, logarithmic, method_colors, saved, style_axes

_METRICS = (("PMD (1e-4)", "pmd", 1 / PMD_UNIT), ("CD (1e-4)", "chamfer", 1e4), ("EMD (1e-3)", "earth_mover", 1e3))
_OFFSETS = {"seen": 0.17, "unseen": -0.17}
_AXES, _ROW, _TOP, _BOTTOM, _LETTER = 2.55, 0.5, 0.66, 0.34, 0.072  # inches


def ablation_figure(
    rows: Sequence[Row],
    path: str | os.PathLike[str],
) -> Path:
    """Draw PMD, CD and EMD of each method as dots with their 95 % intervals, seen (open) and unseen (filled) poses.

    Each value is written beside its dot, with its ratio to that of the full DSFFNet on the same poses; DSFFNet's on
    unseen poses (seen, where there are no others) is a line through all methods. Scales are logarithmic.

    Parameters
    ----------
    rows : sequence of Row
        One or more triples of each method; DSFFNet stands first (without it there are no ratios), the others in
        the order in which they first come.
    path : path of the PNG to write

    Raises
    ------
    ValueError
        If there are no rows, or a value is not finite and positive.
    """
    if not rows:
        raise ValueError("ablation_figure needs at least one row")
    methods = list(dict.fromkeys(row.method for row in rows))
    methods.sort(key=lambda name: name != DSFFNET)  # it comes first
    figure, panels = _page(methods)
    for axes, (label, field, factor) in zip(panels, _METRICS, strict=True):
        found = {kind: _intervals(rows, methods, field, factor, kind) for kind in POSE_TYPES}
        _draw_panel(axes, methods, {kind: table for kind, table in found.items() if table})
        axes.set_title(label, fontsize=8.5, color=INK, weight="bold", loc="left", pad=5)
    for place, method in enumerate(methods):
        panels[0].text(
            -0.04, place, method, transform=panels[0].get_yaxis_transform(), fontsize=8, ha="right", va="center",
            color=INK, weight="bold" if method == DSFFNET else "normal", parse_math=False,
        )  # fmt: skip
    _legend(figure)
    return saved(figure, path)


_Table = dict[str, tuple[float, float, float]]


def _intervals(rows: Sequence[Row], methods: Sequence[str], field: str, factor: float, pose_type: str) -> _Table:
    """Return mean, low and high of each method that has rows of a pose type."""
    found = {}
    for method in methods:
        values = [factor * getattr(row, field) for row in rows if (row.method, row.pose_type) == (method, pose_type)]
        if values and not (np.isfinite(values).all() and np.mean(values) > 0):
            raise ValueError(f"{field} of {method} on {pose_type} poses must be finite and positive: {np.mean(values)}")
        if values:
            found[method] = mean_and_interval(values)
    return found


def _page(methods: Sequence[str]) -> tuple[Figure, list[Axes]]:
    names = 0.25 + max(map(len, methods)) * _LETTER
    width, height = names + 3 * (_AXES + 0.95) + 0.1, _TOP + len(methods) * _ROW + _BOTTOM
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAGE)
    panels: list[Axes] = []
    for place in range(3):
        left = names + place * (_AXES + 0.95)
        box = (left / width, _BOTTOM / height, _AXES / width, len(methods) * _ROW / height)
        panels.append(figure.add_axes(box, sharey=panels[0] if panels else None))
    return figure, panels


def _draw_panel(axes: Axes, methods: Sequence[str], tables: dict[str, _Table]) -> None:
    colors = method_colors(methods)
    main = tables.get("unseen") or next(iter(tables.values()))
    if DSFFNET in main:
        axes.axvline(main[DSFFNET][0], color=colors[DSFFNET], linewidth=0.8, linestyle=(0, (4, 2.5)), zorder=0)
    for kind, table in tables.items():
        for method, interval in table.items():
            y = methods.index(method) - (_OFFSETS[kind] if len(tables) > 1 else 0)
            _draw_interval(axes, y, interval, color=colors[method], fill=PAGE if kind == "seen" else colors[method])
            _write_value(axes, y, interval[0], table.get(DSFFNET, interval)[0], prominent=table is main)
    _styled(axes, len(methods))


def _draw_interval(axes: Axes, y: float, interval: tuple[float, float, float], *, color: str, fill: Any) -> None:
    mean, low, high = interval
    axes.plot([low, high], [y, y], color=color, linewidth=1.5, solid_capstyle="butt")
    axes.plot(mean, y, marker="o", markersize=5.5, color=color, markerfacecolor=fill)


def _write_value(axes: Axes, y: float, mean: float, reference: float, *, prominent: bool) -> None:
    """Write a mean beside the axes, and how many times the reference's it is."""
    words = f"{mean:.3g}" if mean == reference else f"{mean:.3g}  ×{mean / reference:.2f}"
    color, size = (INK, 7.5) if prominent else (QUIET, 6.5)
    axes.text(1.03, y, words, transform=axes.get_yaxis_transform(), va="center", color=color, fontsize=size)


def _styled(axes: Axes, count: int) -> None:
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low / 1.06, high * 1.06)
    logarithmic(axes.xaxis, _places(high / low))
    axes.set_ylim(count - 0.5, -0.5)
    style_axes(axes, grid="x", sides=("bottom",))
    axes.tick_params(axis="y", length=0, labelleft=False)
    for row in range(1, count):
        axes.axhline(row - 0.5, color=RULE, linewidth=0.6, zorder=0)


def _places(ratio: float) -> Sequence[float]:
    """Return where a logarithmic axis over that ratio has its numbers: about three to six of them."""
    steps = ((3.0, (1, 1.5, 2, 3, 4, 5, 6, 8)), (20.0, (1, 2, 5)), (100.0, (1, 3)))
    return next((places for most, places in steps if ratio < most), (1,))


def _legend(figure: Figure) -> None:
    style: dict[str, Any] = {"color": INK, "linewidth": 1.5, "marker": "o", "markersize": 5}
    handles = [
        Line2D([], [], markerfacecolor=PAGE if kind == "seen" else INK, label=f"{kind} poses", **style)
        for kind in POSE_TYPES
    ]
    figure.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(0.995, 0.995), ncols=2, fontsize=7, frameon=False,
        labelcolor=INK, title="mean and 95 % interval over triples", title_fontsize=6.5, alignment="right",
    )  # fmt: skip
