"""Curves of several runs in one picture: PMD over steps and over seconds, each line named at its end."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from training.evaluation.run_curves import RunCurve
from training.objectives import PMD_UNIT
from training.viz.style import DPI, INK, PAGE, QUIET, EndLabel, dashed_level, label_ends, saved, style_learning

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
    level: tuple[str, float] | None = None,
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
    level : (str, float), optional
        Name and PMD, drawn as a dashed line unless all values lie below.
    """
    drawable = [curve.drawable for curve in curves if len(curve.drawable)]
    drawn = sorted(drawable, key=lambda curve: (not curve.finished, curve.final))
    if not drawn:
        raise ValueError("no run has a PMD to draw")
    figure, axes = _page(len(drawn), max(len(_label(curve)) for curve in drawn), title)
    for panel, over, label in zip(axes, ("steps", "seconds"), ("step", "seconds of training"), strict=True):
        _draw_panel(panel, drawn, over, level)
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


def _draw_panel(axes: Axes, curves: Sequence[RunCurve], over: str, level: tuple[str, float] | None) -> None:
    for rank, curve in reversed(list(enumerate(curves))):
        line: dict[str, Any] = {"color": _color(rank), "linewidth": 1.1 if rank else 2.4, "solid_capstyle": "round"}
        axes.plot(getattr(curve, over), curve.pmd / PMD_UNIT, marker="o", markersize=1.8 if rank else 3, **line)
    if level and level[1] <= max(curve.pmd.max() for curve in curves):
        dashed_level(axes, level[0], level[1] / PMD_UNIT, right=False)
    style_learning(axes, steps=over == "steps")
    axes.set_ylabel("PMD on unseen poses (1e-4)", fontsize=8, color=INK)


def _name_lines(axes: Axes, curves: Sequence[RunCurve], over: str) -> None:
    """Write names in a column beside the axes, in the order of the lines' ends."""
    labels = [
        EndLabel(
            _label(curve), (getattr(curve, over)[-1], curve.final / PMD_UNIT), _color(rank),
            ink=QUIET if _color(rank) == _REST else _color(rank), bold=not rank,
        )
        for rank, curve in sorted(enumerate(curves), key=lambda one: one[1].final)
    ]  # fmt: skip
    gap = _LABEL_POINTS / 72 / (axes.get_window_extent().height / DPI)
    label_ends(axes, labels, gap=gap, column=1 + _GAP / _AXES, letters=7)


def _label(curve: RunCurve) -> str:
    name = curve.name if len(curve.name) <= _LONGEST_NAME else f"{curve.name[: _LONGEST_NAME - 1]}…"
    return f"{curve.final / PMD_UNIT:.1f}  {name}{'' if curve.finished else ' (unfinished)'}"
