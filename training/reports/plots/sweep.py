"""Curves of several runs in one picture: PMD over steps and over seconds, each line named at its end."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from datagen.common.arrays import Floats
from training.evaluation.run_curves import PMD_UNIT, RunCurve
from training.viz.style import DPI, INK, PAGE, QUIET, RULE, saved

_BEST = "#d1462f"
_OTHERS = ("#3f74c8", "#2f9e83", "#a868b8", "#c98a1b", "#4aa3bf")
_REST = "#aab2be"
_LEFT, _AXES, _GAP, _LETTER = 0.7, 5.0, 0.3, 0.063  # inches: before the axes, the axes, to the names, a letter of them
_LABEL_POINTS = 10.5  # height of a line of labels
_LONGEST_NAME = 60


def sweep_figure(
    curves: Sequence[RunCurve],
    path: str | os.PathLike[str],
    *,
    title: str = "",
    levels: Mapping[str, float] | None = None,
) -> Path:
    """Draw PMD on unseen poses over steps and over seconds, with the run that ends lowest highlighted.

    The best six runs have colours of their own, the others are grey; every line is named at its end, in the order
    of the final values.

    Parameters
    ----------
    curves : sequence of RunCurve
        Runs without a drawable (positive) value are left out.
    path : path of the PNG to write
    title : str
    levels : dict, optional
        Name -> PMD, drawn as dashed lines unless all values lie below.
    """
    drawable = [curve.drawable for curve in curves if len(curve.drawable)]
    drawn = sorted(drawable, key=lambda curve: (not curve.finished, curve.final))
    if not drawn:
        raise ValueError("no run has a PMD to draw")
    figure, axes = _page(len(drawn), max(len(_label(curve)) for curve in drawn), title)
    for panel, over, label in zip(axes, ("steps", "seconds"), ("step", "seconds of training"), strict=True):
        _draw_panel(panel, drawn, over, levels or {})
        panel.set_xlabel(label, fontsize=8, color=INK, labelpad=2)
    for panel, over in zip(axes, ("steps", "seconds"), strict=True):  # the shared limits are known only now
        _name_lines(panel, drawn, over)
    return saved(figure, path)


def _page(count: int, letters: int, title: str) -> tuple[Figure, Sequence[Axes]]:
    """A figure of two panels, one above the other, with room for ``count`` names of so many letters beside each."""
    panel = max(3.0, 0.75 + count * _LABEL_POINTS / 72)
    width, height = _LEFT + _AXES + _GAP + letters * _LETTER, 2 * panel + 0.45
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAGE)
    axes = figure.subplots(2, 1, sharey=True)
    sides = {"left": _LEFT / width, "right": (_LEFT + _AXES) / width}
    figure.subplots_adjust(**sides, top=1 - 0.42 / height, bottom=0.5 / height, hspace=0.55 / panel)
    figure.text(_LEFT / width, 1 - 0.2 / height, title, fontsize=9, weight="bold", color=INK, parse_math=False)
    return figure, list(axes)


def _color(rank: int) -> str:
    return (_BEST, *_OTHERS)[rank] if rank <= len(_OTHERS) else _REST


def _draw_panel(axes: Axes, curves: Sequence[RunCurve], over: str, levels: Mapping[str, float]) -> None:
    for rank, curve in reversed(list(enumerate(curves))):
        line: dict[str, Any] = {"color": _color(rank), "linewidth": 1.1 if rank else 2.4, "solid_capstyle": "round"}
        axes.plot(getattr(curve, over), curve.pmd / PMD_UNIT, marker="o", markersize=1.8 if rank else 3, **line)
    highest = max(curve.pmd.max() for curve in curves)
    for name, level in ((name, level) for name, level in levels.items() if level <= highest):
        axes.axhline(level / PMD_UNIT, color=QUIET, linewidth=0.8, linestyle=(0, (5, 3)), zorder=0)
        axes.annotate(
            name, (0, level / PMD_UNIT), xycoords=("axes fraction", "data"), xytext=(3, 2.5),
            textcoords="offset points", fontsize=6.5, color=QUIET, parse_math=False,
            bbox={"facecolor": PAGE, "edgecolor": "none", "alpha": 0.75, "pad": 0.4},
        )  # fmt: skip
    _styled(axes)


def _styled(axes: Axes) -> None:
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    places = range(1, 10) if high / low < 8 else (1, 2, 5) if high / low < 300 else (1,)
    axes.yaxis.set_major_locator(LogLocator(subs=places))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylabel("PMD on unseen poses (1e-4)", fontsize=8, color=INK)
    axes.set_xlim(left=0)
    axes.margins(x=0.01)
    axes.tick_params(labelsize=7, colors=QUIET, which="both", width=0.5)
    axes.grid(True, which="major", color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#b9c0c9")


def _name_lines(axes: Axes, curves: Sequence[RunCurve], over: str) -> None:
    """Write names in a column beside the axes, at the heights of the lines' ends but never over each other."""
    low, high = np.log(axes.get_ylim())
    ranked = sorted(enumerate(curves), key=lambda one: one[1].final)
    ends = np.array([(np.log(curve.final / PMD_UNIT) - low) / (high - low) for _, curve in ranked])
    heights = spread(ends, _LABEL_POINTS / 72 / (axes.get_window_extent().height / DPI))
    for (rank, curve), height in zip(ranked, heights, strict=True):
        _name_line(axes, curve, rank, over, height)


def _name_line(axes: Axes, curve: RunCurve, rank: int, over: str, height: float) -> None:
    color, column = _color(rank), 1 + _GAP / _AXES
    axes.annotate(
        "", (getattr(curve, over)[-1], curve.final / PMD_UNIT), xycoords="data",
        xytext=(column - 0.006, height), textcoords="axes fraction", annotation_clip=False,
        arrowprops={"arrowstyle": "-", "color": color, "linewidth": 0.6, "linestyle": ":", "shrinkA": 0},
    )  # fmt: skip
    style: dict[str, Any] = {"weight": "normal" if rank else "bold", "color": QUIET if color == _REST else color}
    axes.text(
        column, height, _label(curve), transform=axes.transAxes, fontsize=7, va="center", parse_math=False, **style
    )


def _label(curve: RunCurve) -> str:
    name = curve.name if len(curve.name) <= _LONGEST_NAME else f"{curve.name[: _LONGEST_NAME - 1]}…"
    return f"{curve.final / PMD_UNIT:.1f}  {name}{'' if curve.finished else ' (unfinished)'}"


def spread(heights: Floats, gap: float) -> Floats:
    """Heights [n] in 0..1, ascending, moved apart to at least ``gap`` with their order kept, as near as that allows.

    Neighbours that would overlap are placed as one block about their common mean, again and again until none do.
    """
    blocks: list[tuple[float, int]] = []  # middle, members
    for height in heights:
        blocks.append((float(height), 1))
        while len(blocks) > 1 and _overlap(blocks[-2], blocks[-1], gap):
            (upper, more), (lower, fewer) = blocks.pop(), blocks.pop()
            blocks.append(((upper * more + lower * fewer) / (more + fewer), more + fewer))
    placed = [middle + gap * (place - (count - 1) / 2) for middle, count in blocks for place in range(count)]
    found = np.array(placed)
    return np.asarray(found - min(0.0, float(found[0])))


def _overlap(lower: tuple[float, int], upper: tuple[float, int], gap: float) -> bool:
    return upper[0] - lower[0] < gap * (lower[1] + upper[1]) / 2 - 1e-12
