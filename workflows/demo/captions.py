"""What is said of a result: numbers, warnings in the page's words, the error map's bar, and the colours of clothes."""

import re
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.common.printable import printable
from datagen.mesh.geometries import CHOOSE
from training.objectives import PMD_UNIT
from training.viz.style import ERROR_COLORS, ROLE_COLORS
from workflows.demo.transfers import Outcome, Posed

_DARKER = 0.8
_UNKNOWN = "The truth is known, and an error map, where source and target are made-up bodies of one kind."
_DRAPED = (
    "The truth of a person in clothes is the outfit draped over them in the source's pose. It takes a second or "
    "two, and is not made of what is played."
)
_OF_THE_PAGE = {
    f"Choose with {CHOOSE}": "Choose among them",
    "choose it by --source-geometry or --target-geometry": "choose its geometries",
    "look at --picture": "look at it",
    "add --": "choose --",
}
"""What messages say that a command line is to do, and what is done here."""
_OPTION = re.compile(r"(?<!\S)--([a-z]+)(=?)")
_PMD = "PMD: mean square of {} in the truth's box, boxes centred alike"
_MISREAD = (
    "*misread*: the weights say how each part of a mesh is turned; turned back by that and read again, all should "
    "stand as at rest. By how many degrees they do not. Bodies like those of training have some 4."
)
_BAR = ",".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in 255 * ERROR_COLORS[::51])


def plain(message: object, folder: Path) -> str:
    """A message in which files below ``folder`` are called by their names, and options as the controls are."""
    text = re.sub(rf"{re.escape(str(folder))}/([\w-]+/)*", "", str(message))
    for words, ours in _OF_THE_PAGE.items():
        text = text.replace(words, ours)
    return printable(_OPTION.sub(lambda option: f"{option[1].capitalize()}{' ' if option[2] else ''}", text))


def dressed_colors(role: str, garments: NDArray[np.integer] | None) -> Floats | None:
    """Colours [v, 3] of a person in clothes: skin pale, each garment darker than the one below; None of a bare body."""
    if garments is None:
        return None
    own = np.array(ROLE_COLORS[role])
    return np.stack([(1 + 2 * own) / 3, *(own * _DARKER**layer for layer in range(garments.max()))])[garments]


def label(outcome: Outcome, frame: Posed) -> str:
    """What stands behind the result's label."""
    if frame.pmd is not None:
        return f"PMD {frame.pmd / PMD_UNIT:.2f}e-4"
    return "draping the truth …" if outcome.asked.draped and outcome.waits_for_draping else ""


def about(outcome: Outcome, folder: Path) -> str:
    """How much was posed and how fast, and what is to be known of the meshes, which lie below ``folder``."""
    vertices = f"{len(outcome.file.mesh.vertices):,} vertices"
    frames = f"{len(outcome.frames)} of {outcome.count} frames, " if outcome.count > 1 else ""
    lines = [f"{frames}{vertices} in **{outcome.seconds:.2f} s** by the weights `{outcome.weights}`"]
    warnings = [f"⚠ {plain(warning, folder)}" for warning in outcome.warnings]
    words = [_MISREAD] if any("misread by" in warning for warning in warnings) else []
    return "\n\n".join([*lines, *warnings, *words])


def legend(outcome: Outcome, frame: Posed, worst: float, *, shown: bool) -> str:
    """The bar of colours, if it is ``shown``, and what PMD is."""
    if frame.pmd is None:
        words = outcome.no_truth or (_DRAPED if outcome.asked.needs_draping else _UNKNOWN)
        return _small(words) if shown else ""
    if not shown:
        return _small(_PMD.format("the distance of each vertex to the truth"))
    ticks = "".join(f"<span>{100 * worst * share:.1f}</span>" for share in (0, 0.5, 1))
    return (
        '<div style="margin:4px 14px 10px;font-size:12px;color:#5d6676">'
        f'<div style="height:9px;border-radius:3px;background:linear-gradient(90deg,{_BAR})"></div>'
        f'<div style="display:flex;justify-content:space-between">{ticks}</div>'
        "<div>distance of each vertex to the truth, in cm (the last: 99th percentile and above); "
        f"{_PMD.format('it')}</div></div>"
    )


def _small(words: str) -> str:
    return f'<p style="margin:4px 14px 8px;font-size:12px;color:#5d6676">{escape(words)}</p>'
