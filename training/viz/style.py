"""What all figures share: ink, paper, resolution, and how they are written."""

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.text import Text

from datagen.common.arrays import Floats
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
    """Write under a temporary name and rename, so that a reader never meets half a picture."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    for text in figure.findobj(Text):
        text.set_text(printable_lines(text.get_text()))
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")  # it is drawn as a box
            figure.savefig(temporary, format="png", dpi=DPI)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path
