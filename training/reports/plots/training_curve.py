"""Training curves as PNG."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from datagen.common.arrays import Floats
from training.tracking.journal import read_journal
from training.viz.style import DPI, INK, PAGE, apart, dashed_level, saved, style_axes


def training_curve(
    journal_rows: Sequence[Mapping[str, float]],
    path: str | os.PathLike[str],
    *,
    baselines: Mapping[str, float] | None = None,
) -> Path:
    """Draw losses and evaluation PMD over steps on log scales, and the learning rate as a strip below.

    Parameters
    ----------
    journal_rows : sequence of dict
        ``step`` and any of ``loss/*``, ``evaluation/pmd*``, ``learning_rate``; missing, non-finite and non-positive
        values are left out.
    path : path of the PNG to write
    baselines : dict, optional
        Name -> PMD of doing nothing, drawn as dashed lines.
    """
    losses = _keys(journal_rows, "loss/")
    evaluations = _keys(journal_rows, "evaluation/pmd")
    rates = _keys(journal_rows, "learning_rate")
    panels = [("loss", losses, 3.0), ("PMD", evaluations, 2.4), ("learning\nrate", rates, 0.55)]
    panels = [panel for panel in panels if panel[1]]
    if not panels:
        raise ValueError("the journal holds no finite loss, evaluation or learning rate to draw")
    heights = [panel[2] for panel in panels]
    figure = Figure(figsize=(8, sum(heights) * 0.95 + 0.5), dpi=DPI, facecolor=PAGE, layout="constrained")
    all_axes = figure.subplots(len(panels), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for axes, (label, keys, _) in zip(all_axes, panels, strict=True):
        _styled(axes, label)
        if label.startswith("learning"):
            axes.fill_between(*_series(journal_rows, keys[0]), color="#cfd6df", linewidth=0)
            axes.set_ylim(bottom=0)
            axes.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
            continue
        _draw_terms(axes, journal_rows, keys, dots=label == "PMD")
        _draw_baselines(axes, (baselines or {}) if label == "PMD" else {})
        axes.set_yscale("log")
        place = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0.1}
        axes.legend(fontsize=7, frameon=False, ncols=6, labelcolor=INK, **place)
    all_axes[-1].set_xlabel("step", fontsize=8, color=INK)
    all_axes[-1].xaxis.set_major_locator(MaxNLocator("auto", integer=True))
    return saved(figure, path)


def draw_training_curve(run: Path, path: Path, *, baselines: dict[str, float]) -> None:
    """Loss and evaluation PMD over the steps of a run; ``baselines`` are dashed lines."""
    training_curve(read_journal(run / "metrics.jsonl"), path, baselines=baselines)


def draw_coefficients(run: Path, path: str | os.PathLike[str]) -> Path | None:
    """Draw the adaptive coefficients of a run's FFAdaINs over its steps: a panel a block, a label at each curve's end.

    0: only the target's own features modulate; 1: only those mixed with the source's pose code (``alpha`` for scales,
    ``beta`` for shifts). None where the journal has none, as for the baselines.
    """
    curves = _coefficients(read_journal(run / "metrics.jsonl"))
    blocks = sorted({curve.block for curve in curves})
    if not blocks:
        return None
    lines = -(-len(blocks) // _BLOCKS_ABREAST)
    figure = Figure(figsize=(8, 2.9 * lines), dpi=DPI, facecolor=PAGE, layout="constrained")
    grid = figure.subplots(lines, min(len(blocks), _BLOCKS_ABREAST), sharey=True, squeeze=False).ravel()
    for axes, block in zip(grid, blocks, strict=False):
        _draw_block(axes, block, [curve for curve in curves if curve.block == block])
    low, high = grid[0].get_ylim()
    for axes, block in zip(grid, blocks, strict=False):
        _label_ends(axes, [curve for curve in curves if curve.block == block], gap=0.075 * (high - low))
    for axes in grid[len(blocks) :]:
        axes.set_visible(False)
    grid[0].set_ylabel("weight of the mixed branch", fontsize=8, color=INK)
    return saved(figure, path)


_BLOCKS_ABREAST = 3
_NORM_COLORS = ("#3f74c8", "#d9772b", "#2f9e83", "#a868b8")


@dataclass(frozen=True)
class _Curve:
    block: str
    label: str
    color: str
    dashed: bool
    steps: Floats
    values: Floats


def _coefficients(rows: Sequence[Mapping[str, float]]) -> list[_Curve]:
    """Return the curves modulation/KIND/BLOCK.NORM of alpha and beta; a norm has a colour, beta is dashed."""
    keys = _keys(rows, "modulation/")
    norms = sorted({key.rpartition(".")[2] for key in keys})
    found = []
    for key in keys:
        _, kind, place = key.split("/", 2)
        block, _, norm = place.rpartition(".")
        color = _NORM_COLORS[norms.index(norm) % len(_NORM_COLORS)]
        label = f"{'α' if kind == 'alpha' else 'β'} {norm}"
        found.append(_Curve(block, label, color, kind == "beta", *_points(rows, key)))
    return [curve for curve in found if len(curve.steps)]


def _draw_block(axes: Axes, block: str, curves: Sequence[_Curve]) -> None:
    _styled(axes, "")
    axes.set_title(block, fontsize=8, color=INK, loc="left", fontweight="bold", parse_math=False)
    axes.axhline(0, color="#b9c0c9", linewidth=0.8)
    for curve in curves:
        style = (0, (3, 1.5)) if curve.dashed else "-"
        axes.plot(curve.steps, curve.values, color=curve.color, linestyle=style, linewidth=1.4)
    last = max(float(curve.steps[-1]) for curve in curves)
    axes.set_xlim(0, 1.42 * max(last, 1.0))  # room for the labels
    axes.locator_params(axis="x", nbins=4)
    axes.set_xlabel("step", fontsize=8, color=INK)


def _label_ends(axes: Axes, curves: Sequence[_Curve], *, gap: float) -> None:
    """Write each curve's name after its end, moved where ends are close, with a hairline to the curve."""
    curves = sorted(curves, key=lambda curve: float(curve.values[-1]))
    places = apart(np.array([curve.values[-1] for curve in curves]), gap)
    for curve, place in zip(curves, places, strict=True):
        last = float(curve.steps[-1])
        start = last + 0.06 * axes.get_xlim()[1]
        axes.plot([last, start], [float(curve.values[-1]), place], color=curve.color, linewidth=0.5)
        axes.annotate(
            curve.label, (start, place), xytext=(1.5, 0), textcoords="offset points",
            fontsize=7, va="center", color=curve.color, annotation_clip=False,
        )  # fmt: skip


_TERM_COLORS = ("#1d2430", "#3f74c8", "#e08b3c", "#2f9e83", "#a868b8", "#c25b5b", "#8a8f3a", "#5aa9c9")


def _keys(rows: Sequence[Mapping[str, float]], prefix: str) -> list[str]:
    """Return the keys with a drawable value, totals first."""
    names = {key for row in rows for key in row if key.startswith(prefix)}
    drawable = [name for name in names if len(_series(rows, name)[0])]
    return sorted(drawable, key=lambda name: (not name.endswith("total"), name))


def _points(rows: Sequence[Mapping[str, float]], key: str) -> tuple[Floats, Floats]:
    """Return steps and finite values of one key, in order of step."""
    pairs = np.array([(row["step"], row[key]) for row in rows if row.get(key) is not None and "step" in row], float)
    pairs = pairs.reshape(-1, 2)
    pairs = pairs[np.isfinite(pairs).all(1)]
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    return pairs[:, 0], pairs[:, 1]


def _series(rows: Sequence[Mapping[str, float]], key: str) -> tuple[Floats, Floats]:
    """Return steps and values of one key, in order of step, without what a log scale cannot show."""
    steps, values = _points(rows, key)
    return steps[values > 0], values[values > 0]


def smooth(values: Floats) -> Floats:
    """Return a running geometric mean over about a fiftieth of the series, centred."""
    reach = max(len(values) // 50, 1)
    sums = np.cumsum(np.concatenate([[0.0], np.log(values)]))
    index = np.arange(len(values))
    low, high = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(values))
    return np.asarray(np.exp((sums[high] - sums[low]) / (high - low)))


def _styled(axes: Axes, label: str) -> None:
    axes.set_ylabel(label, fontsize=8, color=INK)
    axes.yaxis.get_offset_text().set_fontsize(6.5)
    axes.margins(x=0.01)
    style_axes(axes)


def _draw_terms(axes: Axes, rows: Sequence[Mapping[str, float]], keys: Sequence[str], *, dots: bool) -> None:
    colors = _TERM_COLORS[1:] if dots else _TERM_COLORS
    for index, key in enumerate(keys):
        steps, values = _series(rows, key)
        style: dict[str, Any] = {
            "color": colors[index % len(colors)],
            "label": key.split("/", 1)[-1].removeprefix("pmd_").replace("_", " "),
        }
        if dots:
            axes.plot(steps, values, linewidth=1.6, marker="o", markersize=3, **style)
        else:
            axes.plot(steps, values, linewidth=0.5, alpha=0.28, color=style["color"])
            axes.plot(steps, smooth(values), linewidth=1.8, **style)


def _draw_baselines(axes: Axes, baselines: Mapping[str, float]) -> None:
    for name, value in baselines.items():
        if np.isfinite(value) and value > 0:
            dashed_level(axes, name, value)
