"""The look of all plots: axes, logarithmic scales, dashed levels, names at the ends of curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from datagen.common.arrays import Floats
from training.viz.style import PAGE, QUIET, RULE


def style_axes(
    axes: Axes, *, grid: Literal["both", "x"] = "both", sides: Sequence[str] = ("left", "bottom"), letters: float = 7
) -> None:
    """Give axes the look of all plots: a pale grid behind the curves, small quiet numbers, spines at some sides."""
    axes.tick_params(labelsize=letters, colors=QUIET, which="both", width=0.5)
    axes.grid(True, axis=grid, which="major", color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in sides)
        spine.set_color("#b9c0c9")


def logarithmic(axis: Axis, places: Sequence[float]) -> None:
    """Number a logarithmic axis at these multiples of the powers of ten."""
    axis.set_major_locator(LogLocator(subs=places))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def style_learning(axes: Axes) -> None:
    """PMD on a logarithmic scale over steps or seconds from 0."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    logarithmic(axes.yaxis, range(1, 10) if high / low < 8 else (1, 2, 5) if high / low < 1000 else (1,))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.set_xlim(left=0)
    axes.margins(x=0.01)
    style_axes(axes)


def dashed_level(axes: Axes, name: str, level: float, *, right: bool = True) -> None:
    """A horizontal line with its name at one end."""
    axes.axhline(level, color=QUIET, linewidth=0.8, linestyle=(0, (5, 3)), zorder=0)
    axes.annotate(
        name, (1 if right else 0, level), xycoords=("axes fraction", "data"), xytext=(-3 if right else 3, 2.5),
        textcoords="offset points", ha="right" if right else "left", fontsize=6.5, color=QUIET, parse_math=False,
        bbox={"facecolor": PAGE, "edgecolor": "none", "alpha": 0.75, "pad": 0.4},
    )  # fmt: skip


def apart(heights: Floats, gap: float, *, least: float = -np.inf) -> Floats:
    """Heights [n], ascending, moved apart to at least ``gap`` with their order kept, as near as that allows.

    Neighbours that would overlap are placed as one block about their common mean, again and again until none do; all
    are raised where the lowest would come below ``least``.
    """
    blocks: list[tuple[float, int]] = []  # middle, members
    for height in heights:
        blocks.append((float(height), 1))
        while len(blocks) > 1 and _overlap(blocks[-2], blocks[-1], gap):
            (upper, more), (lower, fewer) = blocks.pop(), blocks.pop()
            blocks.append(((upper * more + lower * fewer) / (more + fewer), more + fewer))
    placed = [middle + gap * (place - (count - 1) / 2) for middle, count in blocks for place in range(count)]
    found = np.array(placed)
    return np.asarray(found + max(0.0, least - float(found[0])))


def _overlap(lower: tuple[float, int], upper: tuple[float, int], gap: float) -> bool:
    return upper[0] - lower[0] < gap * (lower[1] + upper[1]) / 2 - 1e-12


@dataclass(frozen=True)
class EndLabel:
    """What is written beside the axes at the height of a curve's end (x, y)."""

    words: str
    end: tuple[float, float]
    color: str
    ink: str
    bold: bool = False


def label_ends(axes: Axes, labels: Sequence[EndLabel], *, gap: float, column: float, letters: float) -> None:
    """Write labels, ascending by their ends, right of axes with a logarithmic scale, never one over another.

    Parameters
    ----------
    gap
        Height of a line of letters, as a share of the axes' height.
    column
        Where the words begin, as a share of the axes' width.
    letters
        Size in points.
    """
    low, high = np.log(axes.get_ylim())
    ends = np.array([(np.log(label.end[1]) - low) / (high - low) for label in labels])
    for label, height in zip(labels, apart(ends, gap, least=0.0), strict=True):
        axes.annotate(
            "", label.end, xycoords="data", xytext=(column - 0.008, height), textcoords="axes fraction",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": label.color, "linewidth": 0.6, "linestyle": ":", "shrinkA": 0},
        )  # fmt: skip
        axes.text(
            column, height, label.words, transform=axes.transAxes, fontsize=letters, va="center", color=label.ink,
            weight="bold" if label.bold else "normal", parse_math=False,
        )  # fmt: skip
