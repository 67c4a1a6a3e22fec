"""Training curves as PNG."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from training.figure_style import DPI, INK, PAGE, QUIET, RULE, saved
from training.rasteriser import Floats


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
    return saved(figure, path)


_TERM_COLORS = ("#1d2430", "#3f74c8", "#e08b3c", "#2f9e83", "#a868b8", "#c25b5b", "#8a8f3a", "#5aa9c9")


def _keys(rows: Sequence[Mapping[str, float]], prefix: str) -> list[str]:
    """Return the keys with a drawable value, totals first."""
    names = {key for row in rows for key in row if key.startswith(prefix)}
    drawable = [name for name in names if len(_series(rows, name)[0])]
    return sorted(drawable, key=lambda name: (not name.endswith("total"), name))


def _series(rows: Sequence[Mapping[str, float]], key: str) -> tuple[Floats, Floats]:
    """Return steps and values of one key, in order of step, without what a log scale cannot show."""
    pairs = np.array([(row["step"], row[key]) for row in rows if row.get(key) is not None and "step" in row], float)
    pairs = pairs.reshape(-1, 2)
    pairs = pairs[np.isfinite(pairs).all(1) & (pairs[:, 1] > 0)]
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    return pairs[:, 0], pairs[:, 1]


def _smooth(values: Floats) -> Floats:
    """Return a running geometric mean over about a fiftieth of the series, centred."""
    reach = max(len(values) // 50, 1)
    sums = np.cumsum(np.concatenate([[0.0], np.log(values)]))
    index = np.arange(len(values))
    low, high = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(values))
    return np.asarray(np.exp((sums[high] - sums[low]) / (high - low)))


def _styled(axes: Axes, label: str) -> None:
    axes.set_ylabel(label, fontsize=8, color=INK)
    axes.tick_params(labelsize=7, colors=QUIET, which="both", width=0.5)
    axes.yaxis.get_offset_text().set_fontsize(6.5)
    axes.grid(True, which="major", color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.margins(x=0.01)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#b9c0c9")


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
            axes.plot(steps, _smooth(values), linewidth=1.8, **style)


def _draw_baselines(axes: Axes, baselines: Mapping[str, float]) -> None:
    for name, value in baselines.items():
        if np.isfinite(value) and value > 0:
            axes.axhline(value, color=QUIET, linewidth=0.9, linestyle=(0, (5, 3)))
            axes.annotate(
                name, (1, value), xycoords=("axes fraction", "data"), xytext=(-2, 3), textcoords="offset points",
                ha="right", fontsize=7, color=QUIET, parse_math=False,
            )  # fmt: skip
