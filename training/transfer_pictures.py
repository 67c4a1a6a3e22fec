"""What a person looks at after a transfer: source, target and output side by side, one row for each frame shown."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from datagen.mesh import Mesh, bounding_box
from training.figure_style import DPI, INK, PAGE, QUIET, saved
from training.placing import standing_point
from training.rendering import frame, render_mesh

PANEL = (460, 520)
_HEAD, _FOOT, _MARGIN = 96, 24, 20
_COLORS = {"source": (0.36, 0.55, 0.82), "target": (0.91, 0.60, 0.32), "output": (0.30, 0.66, 0.56)}
_MEANINGS = {"source": "gives the pose", "target": "gives the identity", "output": "target in the source's pose"}


@dataclass(frozen=True)
class Shown:
    """One transfer: three meshes, Y up and facing +Z, each in its own unit, and what a source's frame is called."""

    source: Mesh
    target: Mesh
    output: Mesh
    name: str = ""

    def placed(self) -> dict[str, Mesh]:
        """The meshes by role, standing on the ground at the origin; the source drawn as large as the output."""
        like = float(bounding_box(self.output.vertices).half / bounding_box(self.source.vertices).half)
        sizes = {"source": like, "target": 1.0, "output": 1.0}
        meshes = {role: getattr(self, role) for role in sizes}
        return {
            role: Mesh((mesh.vertices - standing_point(mesh.vertices)) * sizes[role], mesh.faces)
            for role, mesh in meshes.items()
        }


def write_picture(rows: Sequence[Shown], names: dict[str, str], path: Path, *, panel: tuple[int, int] = PANEL) -> Path:
    """Draw transfers as a PNG; the panels of a row share camera and scale.

    Parameters
    ----------
    rows
        One or more.
    names
        What to write below the headings: file names of the ``source``, ``target`` and ``output``.
    path
        It appears whole or not at all.
    panel
        Width and height of a picture in pixels.
    """
    width = 3 * panel[0] + 2 * _MARGIN
    height = _HEAD + len(rows) * panel[1] + _FOOT
    page = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=PAGE)
    for column, (role, meaning) in enumerate(_MEANINGS.items()):
        x = (_MARGIN + (column + 0.5) * panel[0]) / width
        _write(page, x, 1 - 30 / height, role.capitalize(), fontsize=10, weight="bold")
        _write(page, x, 1 - 58 / height, meaning, fontsize=7, color=QUIET)
        _write(page, x, 1 - 82 / height, _shortened(names.get(role, "")), fontsize=7)
    for row, shown in enumerate(rows):
        for column, pixels in enumerate(_pictures(shown, panel)):
            left, top = _MARGIN + column * panel[0], _HEAD + row * panel[1]
            box = (left / width, 1 - (top + panel[1]) / height, panel[0] / width, panel[1] / height)
            axes = page.add_axes(box)
            axes.imshow(pixels, interpolation="none", aspect="auto")
            axes.axis("off")
        top = _HEAD + row * panel[1]
        _write(page, _MARGIN / width, 1 - (top + 14) / height, shown.name, fontsize=7, color=QUIET, ha="left")
    return saved(page, path)


def _pictures(shown: Shown, panel: tuple[int, int]) -> list[NDArray[np.uint8]]:
    meshes = shown.placed()
    camera = frame(list(meshes.values()), size=panel, margin=0.06)
    return [
        render_mesh(mesh.vertices, mesh.faces, colors=_COLORS[role], camera=camera, size=panel, background=PAGE)
        for role, mesh in meshes.items()
    ]


def _write(page: Figure, x: float, y: float, words: str, **style: Any) -> None:
    """Words centred at a place; names of files may hold dollar signs, which are no formulas."""
    page.text(x, y, words, **{"ha": "center", "va": "center", "color": INK, "parse_math": False, **style})


def _shortened(name: str, longest: int = 44) -> str:
    return name if len(name) <= longest else f"{name[: longest // 2]}…{name[-longest // 2 :]}"
