"""What all figures share: ink, paper, resolution, how they are written; the axes and labels of all plots."""

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from datagen.common.arrays import Floats
from datagen.common.files import atomic_file
from datagen.common.printable import printable_lines

ROLE_COLORS: Mapping[str, tuple[float, float, float]] = {
    "source": (0.36, 0.55, 0.82),
    "target": (0.91, 0.60, 0.32),
    "output": (0.30, 0.66, 0.56),
    "truth": (0.68, 0.70, 0.74),
}
"""sRGB of a mesh by what it is; the outputs of all methods look alike, so that only their shapes differ."""

METHOD_COLORS: Mapping[str, str] = {
    "DSFFNet": "#009E73",
    "NPT": "#D55E00",
    "3D-CoreNet": "#0072B2",
    "w/o FFAdaIN": "#CC79A7",
    "w/o side target": "#56B4E9",
    "w/o L_edge": "#B58900",
    "target unchanged": "#8A93A0",
    "source unchanged": "#B3BAC4",
}
"""A method's colour in every figure: Okabe and Ito's palette (its yellow made darker, to be read on white)."""

_OTHERS = ("#7B5EA7", "#8C564B", "#4D4D4D", "#1BA1A8", "#A6761D")

ERROR_COLORS = colormaps["magma_r"](np.linspace(0.03, 0.86, 256))[:, :3]
ERROR_MAP = ListedColormap(ERROR_COLORS, name="error")


def method_colors(names: Sequence[str]) -> dict[str, str]:
    """Return a colour a method: its own of `METHOD_COLORS`, or one of the rest by its place among unknown names."""
    unknown = [name for name in names if name not in METHOD_COLORS]
    return {name: METHOD_COLORS.get(name) or _OTHERS[unknown.index(name) % len(_OTHERS)] for name in names}


def error_colors(errors: Floats, limit: float) -> npt.NDArray[np.floating]:
    """Return sRGB [v, 3] in 0..1 for errors [v], pale at 0 and dark at `limit` and above."""
    level = np.clip(np.asarray(errors, float) / limit, 0, 1)
    return np.asarray(ERROR_COLORS[np.rint(255 * level).astype(int)])


DPI = 200
INK, QUIET, RULE = "#1d2430", "#6b7483", "#e3e6ea"
PAGE = (1.0, 1.0, 1.0)


def short(name: str, letters: int = 60) -> str:
    """Return a name, cut where a figure has no room for it: a folder's may be 255 letters long."""
    return name if len(name) <= letters else f"{name[: letters - 1]}…"


def saved(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a picture that appears whole or not at all (StorageError where it cannot be written)."""
    path = Path(path)
    for text in figure.findobj(Text):
        text.set_text(printable_lines(text.get_text()))
    with atomic_file(path) as file, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")  # it is drawn as a box
        figure.savefig(file, format="png", dpi=DPI)
    return path


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


def style_learning(axes: Axes, *, steps: bool) -> None:
    """PMD on a logarithmic scale over ``steps``, numbered where they are whole, or seconds, from 0."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    logarithmic(axes.yaxis, range(1, 10) if high / low < 8 else (1, 2, 5) if high / low < 1000 else (1,))
    axes.xaxis.set_major_locator(MaxNLocator("auto", integer=steps))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
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

    Without the gaps that is an isotonic regression; all are raised where the lowest would come below ``least``.
    """
    from scipy.optimize import isotonic_regression  # half a second, which most pictures need not take

    steps = gap * np.arange(len(heights))
    found = isotonic_regression(heights - steps).x + steps
    return np.asarray(found + max(0.0, least - float(found[0])))


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
