"""A figure laid out in pixels from its top left corner, so that pictures are placed pixel for pixel."""

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from datagen.common.printable import printable_lines
from training.viz.style import DPI, ERROR_MAP, INK, PAGE, RULE

_SMALLEST = 4.0  # points of a letter that can still be read
_TOLERANCE = 2.0  # how far beyond their room such words may reach; longer ones are cut


class Page:
    """White paper of `width` x `height` pixels."""

    def __init__(self, *, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=PAGE)

    def box(self, left: float, top: float, width: float, height: float) -> tuple[float, float, float, float]:
        """Return a rectangle as matplotlib counts it."""
        return left / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Return axes in a rectangle."""
        return self.figure.add_axes(self.box(left, top, width, height))

    def text(
        self, x: float, y: float, words: str, *, size: float, anchor: str = "left", room: float = np.inf, **style: Any
    ) -> None:
        """Write words, in smaller letters where `room` pixels are too few, cut where they still are; y is their middle,
        or what `va` says.
        """
        words = printable_lines(words)
        per_letter = (0.68 if style.get("weight") == "bold" else 0.6) * DPI / 72  # of a point, in this font
        size = min(size, max(room / (per_letter * max(len(words), 1)), _SMALLEST))
        if per_letter * size * len(words) > room * _TOLERANCE:
            words = f"{words[: int(room / (per_letter * size)) - 1]}…"
        style = {"color": INK, "parse_math": False, "va": "center", **style}  # names may hold dollar signs
        where = x / self.width, 1 - y / self.height
        self.figure.text(*where, words, fontsize=size, ha=anchor, **style)

    def rule(self, y: float) -> None:
        """Draw a hairline across the page."""
        self.block(20, y, self.width - 40, 1, RULE)

    def block(self, left: float, top: float, width: float, height: float, color: str) -> None:
        """Fill a rectangle."""
        x, y, across, up = self.box(left, top, width, height)
        where = self.figure.transFigure
        self.figure.add_artist(Rectangle((x, y), across, up, facecolor=color, edgecolor="none", transform=where))

    def picture(self, pixels: npt.NDArray[np.uint8], left: float, top: float) -> Axes:
        """Place a picture pixel for pixel; its axes count its pixels."""
        axes = self.axes(left, top, pixels.shape[1], pixels.shape[0])
        axes.imshow(pixels, interpolation="none", aspect="auto")
        axes.axis("off")
        return axes

    def error_bar(self, left: float, top: float, width: float, *, limit: float, label: str) -> None:
        """Draw the colours of errors from 0 to `limit`, with ticks and a label below: about 75 pixels high."""
        bar = self.figure.colorbar(
            ScalarMappable(Normalize(0, limit), ERROR_MAP),
            cax=self.axes(left, top, width, 18),
            orientation="horizontal",
            extend="max",
        )
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=6.5, colors=INK, length=2, width=0.5, pad=2)
        bar.ax.locator_params(nbins=4)
        bar.set_label(label, fontsize=7, color=INK, labelpad=2)
