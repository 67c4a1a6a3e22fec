"""Curves of metrics over disturbances as small multiples, and pictures of disturbed sources and their outputs."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from datagen.mesh.geometry import Mesh, bounding_box
from training.evaluation.disturbances import DISTURBANCES, Disturbance
from training.evaluation.measure import LoadedMethod, in_words, transfer_each
from training.evaluation.robustness import Case, RobustnessRow, curve, disturbed, methods_in, no_op, refusal
from training.objectives import PMD_UNIT
from training.viz.mesh_grid import Panel, Row, drawable, mesh_grid, standing
from training.viz.style import DPI, INK, PAGE, QUIET, ROLE_COLORS, logarithmic, method_colors, saved, short, style_axes

_ABREAST = 5
_HANDLE, _LETTER = 0.55, 0.06  # inches in the legend
_BODY_METRES = 1.7
TAKES_EQUAL = "needs as many\nvertices as the target"


def robustness_curves(rows: Sequence[RobustnessRow], path: str | os.PathLike[str], *, title: str) -> Path:
    """Draw mean PMD over the amount of each disturbance, a panel each, with 95 % intervals, on one log scale.

    The dashed line is the no-op: the target returned unchanged.

    Raises
    ------
    ValueError
        The rows hold no disturbance.
    """
    shown = [disturbance for disturbance in DISTURBANCES if any(row.disturbance == disturbance.name for row in rows)]
    if not shown:
        raise ValueError("there are no rows of a disturbance to draw")
    across, down = min(_ABREAST, len(shown)), -(-len(shown) // _ABREAST)
    figure = Figure(figsize=(2.3 * max(across, 2), 1.95 * down + 0.75), dpi=DPI, facecolor=PAGE, layout="constrained")
    grid = figure.subplots(down, across, sharey=True, squeeze=False)
    for axes, disturbance in zip(grid.ravel(), shown, strict=False):
        _draw_curves(axes, rows, disturbance)
    for axes in grid.ravel()[len(shown) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel("PMD (1e-4)", fontsize=7.5, color=INK)
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.suptitle(title, fontsize=9, weight="bold", color=INK, x=0.01, ha="left", parse_math=False)
    names = [short(name) for name in names]
    abreast = int(figure.get_figwidth() / (_HANDLE + _LETTER * max(map(len, names))))
    place = {"loc": "outside lower left", "ncols": max(1, abreast), "frameon": False}
    legend = figure.legend(handles, names, fontsize=7.5, labelcolor=INK, **place)
    for text in legend.get_texts():
        text.set_parse_math(False)  # methods are called after folders
    return saved(figure, path)


def _draw_curves(axes: Axes, rows: Sequence[RobustnessRow], disturbance: Disturbance) -> None:
    for name, color in method_colors(methods_in(rows)).items():
        levels = curve(rows, name, disturbance.name)
        at = [_place(disturbance, level.amount) for level in levels]
        mean, low, high = (
            np.array([getattr(level, key) for level in levels]) / PMD_UNIT for key in ("mean", "low", "high")
        )
        axes.plot(at, mean, color=color, linewidth=1.6, marker="o", markersize=2.6, label=name)
        axes.fill_between(at, low, high, color=color, alpha=0.18, linewidth=0)
    if np.isfinite(no_op(rows)):
        axes.axhline(
            no_op(rows) / PMD_UNIT, color=QUIET, linewidth=0.9, linestyle=(0, (5, 3)), label="target unchanged"
        )
    axes.set_title(disturbance.heading, fontsize=8, color=INK, loc="left", weight="bold", pad=4)
    axes.set_xlabel(_unit(disturbance), fontsize=7, color=INK, labelpad=1)
    axes.set_xticks([_place(disturbance, amount) for amount in _ticks(disturbance)])
    axes.set_xticklabels([f"{amount:g}" for amount in _ticks(disturbance)])
    axes.set_yscale("log")
    logarithmic(axes.yaxis, (1, 2, 5))
    style_axes(axes, letters=6.5)


def _place(disturbance: Disturbance, amount: float) -> float:
    return disturbance.amounts.index(amount) if disturbance.even else amount


def _ticks(disturbance: Disturbance) -> tuple[float, ...]:
    """The amounts that are named along the axis: all at equal steps, else those far enough apart."""
    if disturbance.even:
        return disturbance.amounts
    return tuple(_spaced(disturbance.amounts, 0.14 * disturbance.amounts[-1]))


def _spaced(amounts: Sequence[float], apart: float) -> list[float]:
    kept = [amounts[-1]]
    for amount in reversed(amounts[:-1]):
        if kept[-1] - amount >= apart:
            kept.append(amount)
    return kept[::-1]


def _unit(disturbance: Disturbance) -> str:
    if disturbance.name != "noise":
        return disturbance.unit
    return f"std (0.01 = {millimetres(0.01):.1f} mm on a body of {_BODY_METRES:g} m)"


def millimetres(amount: float) -> float:
    """Half box edges as millimetres on a body that is 1.7 m along its longest box edge."""
    return 1000 * amount * _BODY_METRES / 2


def disturbance_picture(
    case: Case,
    methods: Sequence[LoadedMethod],
    chosen: Sequence[tuple[Disturbance, float]],
    path: str | os.PathLike[str],
    *,
    title: str,
) -> Path:
    """Draw the disturbed sources and, under them, each method's outputs; the target and the truth stand at the left.

    The panels of a row share camera and scale. A source without faces is drawn as points.
    """
    truth = case.truth.vertices
    sources = [disturbed(case, disturbance, amount) for disturbance, amount in chosen]
    reference = Panel(Mesh(standing(case.target.vertices), case.target.faces), ROLE_COLORS["target"], "target")
    changed = [Panel(_stood(source), ROLE_COLORS["source"], count_of(source)) for source in sources]
    page = [Row("source", [reference, *changed])]
    for number, method in enumerate(methods):
        whole = Panel(Mesh(standing(truth), case.truth.faces), ROLE_COLORS["truth"], "ground truth")
        panels: list[Panel | str] = ["" if number else whole]
        for (disturbance, _), source in zip(chosen, sources, strict=True):
            taken = not refusal(method, disturbance)
            panels.append(output_panel(method, case, source) if taken else TAKES_EQUAL)
        page.append(Row(method.name.replace(" ", "\n", 1), panels))
    headings = ["", *(_heading(disturbance, amount) for disturbance, amount in chosen)]
    return mesh_grid(page, path, columns=headings, title=title, one_scale=False)


def _heading(disturbance: Disturbance, amount: float) -> str:
    words = disturbance.words.format(amount)
    if disturbance.name == "noise":
        return f"{words}\n{millimetres(amount):.0f} mm at {_BODY_METRES:g} m" if amount else "no noise\n"
    return f"{disturbance.heading}\n{words}"


def output_panel(method: LoadedMethod, case: Case, source: Mesh, *, truth_known: bool = True) -> Panel:
    """What a method makes of a case with this source, standing where the truth does; its error, where that is known."""
    (output,) = transfer_each(method.network, [(source, case.target)])
    truth = case.truth.vertices
    vertices = standing(bounding_box(truth).restore(output), truth if truth_known else None)
    caption = in_words(case.score(output)) if truth_known else "no ground truth"
    return Panel(Mesh(vertices, case.target.faces), ROLE_COLORS["output"], caption)


def _stood(mesh: Mesh) -> Mesh:
    shown = drawable(mesh)
    return Mesh(standing(shown.vertices), shown.faces)


def count_of(mesh: Mesh) -> str:
    """How many vertices a mesh has, in words."""
    return f"{len(mesh.vertices):,} {'vertices' if len(mesh.faces) else 'points'}"


def noise_levels() -> list[tuple[Disturbance, float]]:
    """What the picture like the paper's Figure 9 shows: noise of growing amplitude."""
    noise = next(disturbance for disturbance in DISTURBANCES if disturbance.name == "noise")
    return [(noise, amount) for amount in noise.amounts if amount != 0.01]


def one_of_each() -> list[tuple[Disturbance, float]]:
    """A telling amount of every disturbance that changes the source's shape or stance."""
    amounts = {
        "patch": 0.3, "side": 0.6, "subset": 0.75, "cells": 0.15, "area": 4, "face": 4, "turn-x": 30, "turn-y": 45,
        "turn-z": 30,
    }  # fmt: skip
    return [(disturbance, amounts[disturbance.name]) for disturbance in DISTURBANCES if disturbance.name in amounts]
