"""The grid of kinds as a heat map with numbers, and a picture of transfers between kinds (paper, Figure 8)."""

import os
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from datagen.mesh.geometry import Mesh, bounding_box
from training.evaluation.generalisation import GeneralisationRow, grid_of, no_op_line
from training.evaluation.measure import LoadedMethod
from training.evaluation.robustness import NO_OP, Case, methods_in
from training.objectives import PMD_UNIT
from training.reports.plots.robustness import TAKES_EQUAL, count_of, output_panel
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing
from training.viz.style import DPI, INK, PAGE, ROLE_COLORS, saved, short

_COLORS = colormaps["YlGnBu"]
_NO_TRUTH = "#eceef1"
_INCHES = 0.62  # a cell of the grid
_LETTER = 0.068  # inches of a letter of the title


@dataclass(frozen=True)
class Shown:
    """A transfer to draw; ``truth_known`` is false where the case's truth is not one."""

    label: str
    case: Case
    truth_known: bool = True


def heat_map(
    rows: Sequence[GeneralisationRow],
    kinds: Sequence[str],
    path: str | os.PathLike[str],
    *,
    title: str,
    trained: Sequence[str] = (),
) -> Path:
    """Draw PMD (1e-4) from each kind of source (down) to each kind of target (across), one panel a method.

    The last line is the no-op, the target unchanged. Grey: no ground truth is known, or the method takes no other
    vertex count. ``trained`` names the kind that each method was trained on (empty: none of these), which is framed;
    colours are logarithmic and shared.

    Raises
    ------
    ValueError
        There is nothing to draw.
    """
    names = methods_in(rows)
    grids = [np.vstack([grid_of(rows, kinds, name), no_op_line(rows, kinds)]) / PMD_UNIT for name in names]
    if not grids or not np.isfinite(grids).any():
        raise ValueError("there are no numbers to draw")
    norm = LogNorm(float(np.nanmin(grids)), float(np.nanmax(grids)))
    width, height = len(names) * (len(kinds) * _INCHES) + 2.1, (len(kinds) + 1) * _INCHES + 1.8
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAGE, layout="constrained")
    every = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for number, (axes, name, grid) in enumerate(zip(every, names, grids, strict=True)):
        _draw_grid(axes, grid, kinds, norm, own=trained[number] if number < len(trained) else "")
        axes.set_title(short(name), fontsize=8.5, weight="bold", color=INK, pad=5, parse_math=False)
        axes.set_xlabel("target", fontsize=8, color=INK)
    every[0].set_ylabel("source", fontsize=8, color=INK)
    lines = textwrap.fill(title, int(width / _LETTER))
    figure.suptitle(lines, fontsize=8.5, color=INK, x=0.01, ha="left", parse_math=False)
    return saved(figure, path)


def _draw_grid(axes: Axes, grid: NDArray[np.float64], kinds: Sequence[str], norm: LogNorm, *, own: str) -> None:
    axes.set_facecolor(_NO_TRUTH)
    axes.imshow(np.ma.masked_invalid(grid), cmap=_COLORS, norm=norm, aspect="equal")
    for (line, column), value in np.ndenumerate(grid):
        dark = np.isfinite(value) and norm(value) > 0.55
        words = "–" if not np.isfinite(value) else f"{value:.0f}" if value >= 99.5 else f"{value:.1f}"
        axes.text(column, line, words, ha="center", va="center", fontsize=7, color="white" if dark else INK)
    axes.axhline(len(kinds) - 0.5, color=PAGE, linewidth=3)
    style: dict[str, Any] = {"fontsize": 6.5, "parse_math": False}  # kinds are called after folders
    axes.set_xticks(range(len(kinds)), [_broken(kind) for kind in kinds], **style)
    axes.set_yticks(range(len(kinds) + 1), [*map(_broken, kinds), _broken(NO_OP)], **style)
    axes.tick_params(length=0, colors=INK)
    for spine in axes.spines.values():
        spine.set_visible(False)
    if own in kinds:
        place = kinds.index(own)
        axes.add_patch(Rectangle((place - 0.5, place - 0.5), 1, 1, fill=False, edgecolor="#d1462f", linewidth=1.8))
        for labels in (axes.get_xticklabels(), axes.get_yticklabels()):  # a second grid has none of the latter
            for label in labels[place : place + 1]:
                label.set_fontweight("bold")


def _broken(name: str) -> str:
    """A name with its last word on a line of its own."""
    return "\n".join(short(name, 24).rsplit(" ", 1))


def generalisation_picture(
    shown: Sequence[Shown], methods: Sequence[LoadedMethod], path: str | os.PathLike[str], *, title: str
) -> Path:
    """Draw source, target, each method's output and the ground truth (where known) of transfers, one a row."""
    columns = [
        "source\ngives the pose",
        "target\ngives the identity",
        *(f"{method.name}\noutput" for method in methods),
    ]
    page = [Row(one.label, _panels(one, methods)) for one in shown]
    return mesh_grid(page, path, columns=[*columns, "ground truth\n"], title=title, one_scale=False)


def _panels(shown: Shown, methods: Sequence[LoadedMethod]) -> list[Panel | str]:
    case = shown.case
    size = float(bounding_box(case.target.vertices).half)  # a horse beside a person: each drawn as large as the other
    source = case.source.vertices * size / float(bounding_box(case.source.vertices).half)
    found: list[Panel | str] = [
        Panel(Mesh(standing(source), case.source.faces), ROLE_COLORS["source"], count_of(case.source)),
        Panel(Mesh(standing(case.target.vertices), case.target.faces), ROLE_COLORS["target"], count_of(case.target)),
    ]
    found += [_output(shown, method) for method in methods]
    truth = Panel(Mesh(standing(case.truth.vertices), case.truth.faces), ROLE_COLORS["truth"])
    return [*found, truth if shown.truth_known else ""]


def _output(shown: Shown, method: LoadedMethod) -> Panel | str:
    case = shown.case
    if method.equal_counts and len(case.source.vertices) != len(case.target.vertices):
        return TAKES_EQUAL
    return output_panel(method, case, case.source, truth_known=shown.truth_known)
