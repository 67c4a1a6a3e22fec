"""Colours with a meaning: what a mesh is, which method made it, how large an error is. Safe for the colour-blind."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.colors import ListedColormap

from training.rasteriser import Floats

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
