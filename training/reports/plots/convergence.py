"""Figure 4 of the DSFFNet paper: PMD of several methods while they learn, over iterations and over time."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from datagen.common.errors import CheckpointError
from datagen.common.files import resolve_within
from training.evaluation.run_curves import RunCurve, run_curve
from training.objectives import PMD_UNIT
from training.recipes.files import recipe_in
from training.tracking.journal import read_journal
from training.viz.style import DPI, INK, PAGE, EndLabel, label_ends, method_colors, saved, style_learning

_LEFT, _AXES, _HEIGHT, _TOP, _BOTTOM, _LETTER = 0.62, 3.7, 3.1, 0.52, 0.5, 0.068  # inches
_LABEL_POINTS = 11.0
_STYLES: Mapping[str, dict[str, Any]] = {
    "training": {"linewidth": 0.5, "alpha": 0.4},
    "seen": {"linewidth": 1.3, "linestyle": (0, (2.2, 1.4))},
    "unseen": {"linewidth": 2.3, "solid_capstyle": "round"},
}
_MEANING = {"training": "training batches", "seen": "evaluation, seen poses", "unseen": "evaluation, unseen poses"}


@dataclass(frozen=True)
class Learning:
    """How a method learned: PMD (box^2) of training batches and of the evaluation's seen and unseen poses."""

    name: str
    training: RunCurve
    seen: RunCurve
    unseen: RunCurve

    @property
    def final(self) -> RunCurve:
        """The curve that is named at its end: unseen poses or, where the data has none, what there is."""
        return next((curve for curve in (self.unseen, self.seen) if len(curve)), self.training)


def learning_of(name: str, run: Path) -> Learning:
    """Read how a run learned from its journal.

    The training's PMD is its reconstruction loss over 3: that is a sum over coordinates and PMD a mean
    (:func:`training.objectives.losses.reconstruction_loss`, :func:`training.objectives.metrics.point_mesh_distance`).
    The journal has the loss before it is weighted.

    Raises
    ------
    CheckpointError
        The folder has no journal or no recipe.
    RecipeError
        Its recipe cannot be read.
    """
    rows = read_journal(run / "metrics.jsonl")
    if not rows or not (run / "recipe.yaml").is_file():
        raise CheckpointError(
            f"{run} ({name}) is no folder of a run: it lacks metrics.jsonl or recipe.yaml. Train it first"
        )
    batch = recipe_in(resolve_within(run, "recipe.yaml")).batch
    loss, seen, unseen = (
        run_curve(rows, key, batch=batch, name=name).drawable
        for key in ("loss/reconstruction", "evaluation/pmd_seen", "evaluation/pmd_unseen")
    )
    return Learning(name, replace(loss, pmd=loss.pmd / 3), seen, unseen)


def convergence_figure(
    runs: Mapping[str, Path],
    path: str | os.PathLike[str],
) -> Path:
    """Draw PMD over iterations and over seconds of training: thin of each logged batch, thick of the evaluations.

    Parameters
    ----------
    runs : dict
        Name of a method -> folder of its run. Names of `METHOD_COLORS` have a fixed colour.
    path : path of the PNG to write

    Raises
    ------
    ValueError
        If no run has a value to draw.
    CheckpointError
        If a folder is none of a run.
    """
    learned = [learning_of(name, folder) for name, folder in runs.items()]
    learned = [one for one in learned if len(one.final)]
    if not learned:
        raise ValueError(f"no run has a PMD to draw: {', '.join(map(str, runs.values())) or 'none was given'}")
    figure, panels = _page(max(len(_label(one)) for one in learned))
    for axes, over in zip(panels, ("steps", "seconds"), strict=True):
        _draw_panel(axes, learned, over)
    _legend(figure, panels[0], learned)
    for axes, over in zip(panels, ("steps", "seconds"), strict=True):  # the shared limits are known only now
        _name_ends(axes, learned, over)
    return saved(figure, path)


def _page(letters: int) -> tuple[Figure, list[Axes]]:
    """Two panels beside each other, each with room for names of so many letters at its right."""
    names = 0.3 + letters * _LETTER
    width, height = _LEFT + 2 * (_AXES + names) + 0.25, _TOP + _HEIGHT + _BOTTOM
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAGE)
    lefts = (_LEFT, _LEFT + _AXES + names + 0.25)
    panels: list[Axes] = []
    for left in lefts:
        box = (left / width, _BOTTOM / height, _AXES / width, _HEIGHT / height)
        panels.append(figure.add_axes(box, sharey=panels[0] if panels else None))
    return figure, panels


def _draw_panel(axes: Axes, learned: Sequence[Learning], over: str) -> None:
    colors = method_colors([one.name for one in learned])
    for kind, style in _STYLES.items():
        for one in learned:
            curve: RunCurve = getattr(one, kind)
            axes.plot(getattr(curve, over), curve.pmd / PMD_UNIT, color=colors[one.name], **style)
    style_learning(axes, steps=over == "steps")
    axes.set_xlabel("iteration" if over == "steps" else "seconds of training", fontsize=8, color=INK, labelpad=2)
    axes.set_ylabel("PMD (1e-4)" if over == "steps" else "", fontsize=8, color=INK, labelpad=2)


def _legend(figure: Figure, axes: Axes, learned: Sequence[Learning]) -> None:
    """Say above the panels what thin, dashed and thick lines are, where there are any."""
    kinds = [kind for kind in _STYLES if any(len(getattr(one, kind)) for one in learned)]
    handles = [Line2D([], [], color=INK, label=_MEANING[kind], **_STYLES[kind]) for kind in kinds]
    place = (axes.get_position().x0, 1 - 0.27 / figure.get_figheight())
    figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=place, ncols=3, fontsize=7, frameon=False, labelcolor=INK,
        borderaxespad=0, borderpad=0, handlelength=2.6,
    )  # fmt: skip


def _label(one: Learning) -> str:
    return f"{one.final.final / PMD_UNIT:.3g}  {one.name}"


def _name_ends(axes: Axes, learned: Sequence[Learning], over: str) -> None:
    """Write value and name of each method beside the axes, the lowest in bold."""
    ranked, colors = sorted(learned, key=lambda one: one.final.final), method_colors([one.name for one in learned])
    labels = [
        EndLabel(
            _label(one), (getattr(one.final, over)[-1], one.final.final / PMD_UNIT), colors[one.name],
            ink=colors[one.name], bold=not rank,
        )
        for rank, one in enumerate(ranked)
    ]  # fmt: skip
    label_ends(axes, labels, gap=_LABEL_POINTS / 72 / _HEIGHT, column=1.045, letters=7.5)
