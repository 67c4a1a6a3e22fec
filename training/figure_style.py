"""What all figures share: ink, paper, resolution, and how they are written."""

import os
import warnings
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.text import Text

from datagen.printable import printable_lines

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
